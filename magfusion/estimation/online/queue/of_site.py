"""Input queue of a platform with one or several magnetometers."""

from magfusion.estimation.online.queue.arrivals import Arrivals
from magfusion.estimation.online.queue.several_magnetometers import SeveralArrivals
from magfusion.estimation.online.queue.single_magnetometer import SingleArrivals
from magfusion.model.site import Site
from magfusion.receiver.windows import LockinSettings


def arrivals_of(site: Site, lockin: LockinSettings | None, *, short: bool) -> Arrivals:
    """Return the input queue of a site's platform.

    `short`: whether close tones are measured together, in short windows, by one magnetometer.
    """
    if site.platform.further:
        return SeveralArrivals(site, lockin)
    return SingleArrivals(site, lockin, short=short)
