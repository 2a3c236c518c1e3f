"""Input queue of a platform with one or several magnetometers."""

from magfusion.estimation.online.input_queue import Arrivals
from magfusion.estimation.online.several_arrivals import SeveralArrivals
from magfusion.model.site import Site
from magfusion.receiver.receivers import receiver_of
from magfusion.receiver.windows import LockinSettings


def arrivals_of(site: Site, lockin: LockinSettings | None) -> Arrivals:
    """Return the input queue of a site's platform."""
    offset = site.platform.imu.time_offset
    if site.platform.further:
        return SeveralArrivals(site, lockin, offset)
    return Arrivals(receiver_of(site, lockin), offset)
