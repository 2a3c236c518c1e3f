"""Selection of the receiver for a site's drives, and demodulation of a whole waveform."""

from collections import Counter

from magfusion.errors import InputError
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.site import Site
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.receiver.marked import MarkedReceiver
from magfusion.receiver.receiver import Receiver
from magfusion.receiver.slot_receiver import SlotReceiver
from magfusion.receiver.slots import SlotSettings, has_schedule, is_marked, slot_lockin
from magfusion.receiver.windows import LockinSettings, default_settings


def receiver_of(site: Site, settings: LockinSettings | SlotSettings | None = None) -> Receiver:
    """Return the receiver for the drives of a site.

    `settings`: none derives them from the tones or the time slots.
    """
    if is_marked(site):
        return MarkedReceiver(site, settings)
    if isinstance(settings, SlotSettings) or has_schedule(site):
        return SlotReceiver(site, settings)
    return LockinReceiver(site, settings)


def windowed(receiver: Receiver) -> LockinReceiver:
    """Return a receiver whose windows include a static field, the Earth's.

    Raises InputError where it is of time slots.
    """
    if isinstance(receiver, LockinReceiver):
        return receiver
    raise InputError(
        "with coils in time slots the silent slots remove the Earth field; leave --earth out"
    )


def usual_lockin(site: Site, mains_hz: float = 50.0) -> LockinSettings:
    """Return the default window and step of a site; of time slots, theirs.

    Raises InputError where its drives cannot be separated.
    """
    return (slot_lockin if has_schedule(site) else default_settings)(site, mains_hz)


def received(
    waveform: Waveform,
    imu: ImuSamples,
    site: Site,
    settings: LockinSettings | SlotSettings | None = None,
) -> tuple[FieldSamples, Counter[str]]:
    """Return the phasors of a whole waveform, and how many windows were dropped for which reason.

    `settings`: as of `receiver_of`. Raises InputError where no window is usable.
    """
    receiver = receiver_of(site, settings)
    _, result = receiver.whole(waveform, imu)
    return result, receiver.dropped
