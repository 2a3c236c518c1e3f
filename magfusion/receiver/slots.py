"""Time division: the schedule of coils that are driven in turn, and its settings."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from magfusion.errors import InputError
from magfusion.model.once import once_a_site
from magfusion.model.site import MarkedSlots, Site, Slots
from magfusion.receiver.ambient import STRETCH, Removal
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray, IntArray

MIN_SAMPLES = 8  # in a slot; its noise is measured three cycles a slot from the carrier
MIN_CYCLES = 1.0  # of a carrier in a slot
NOISE_CYCLES = 16  # over which the noise is averaged


@dataclass(frozen=True)
class SlotSettings:
    """Settings for the demodulation of time slots."""

    # how the silent slots remove the ambient field from the others, see
    # `magfusion.receiver.ambient.ambient_weights`
    removal: Removal
    taper: Literal["rectangular", "hann"]  # weight of the samples within a slot
    cycles: int = 8  # length of the ambient state
    # mains frequency in the ambient state of pulsed direct current; 0 for none
    mains_hz: float = 50.0


def has_schedule(site: Site) -> bool:
    """Return whether a beacon of the site declares time slots."""
    return any(beacon.slots is not None for beacon in site.beacons)


@once_a_site
def is_marked(site: Site) -> bool:
    """Return whether the log marks the driven coils."""
    return any(isinstance(beacon.slots, MarkedSlots) for beacon in site.beacons)


def schedule(site: Site) -> Slots:
    """Return the schedule that all beacons of the site keep."""
    slots = check_kept(site)
    assert isinstance(slots, Slots)
    return slots


@once_a_site
def places(site: Site) -> int:
    """Return the number of slots of a cycle; of marked ones the last is the silence."""
    slots = check_kept(site)
    if isinstance(slots, Slots):
        return slots.count
    return 2 + max(slot for beacon in site.beacons for _, slot in beacon.tones if slot is not None)


@once_a_site
def check_kept(site: Site) -> Slots | MarkedSlots:
    """Return the schedule of all beacons of the site.

    Raises InputError where a beacon has none or another one, or two coils that do not belong
    together are driven in one slot.
    """
    first = next(beacon for beacon in site.beacons if beacon.slots is not None)
    assert first.slots is not None
    for beacon in site.beacons:
        if beacon.slots != first.slots:
            kept = "none" if beacon.slots is None else "another one"
            raise InputError(
                f"beacon {first.name} keeps a schedule of time slots and beacon {beacon.name}"
                f" {kept}; give both the same slots, in which each coil has its own"
            )
    selected: dict[int, str] = {}
    for beacon in site.beacons:
        for _, slot in beacon.tones:
            if slot is None:
                raise InputError(
                    f"beacon {beacon.name} keeps a schedule of time slots and has a coil without"
                    " one; give every coil its slot"
                )
            if slot in selected:
                raise InputError(
                    f"beacons {selected[slot]} and {beacon.name} are both driven in slot {slot};"
                    " give every coil a slot of its own"
                )
            selected[slot] = beacon.name
    return first.slots


def default_slot_settings(site: Site, mains_hz: float = 50.0) -> SlotSettings:
    """Choose settings: the ambient state for pulses, no removal for tapered carriers.

    With a carrier the silent slots determine nothing and add noise.
    """
    pulsed = any(np.any(beacon.tone_frequencies_hz == 0.0) for beacon in site.beacons)
    if pulsed:
        return SlotSettings("state", "rectangular", mains_hz=mains_hz)
    return SlotSettings("none", "hann", mains_hz=mains_hz)


def slot_lockin(site: Site, mains_hz: float = 50.0) -> LockinSettings:
    """Return window and step for a site with a schedule: its slots."""
    if is_marked(site):
        check_kept(site)
        return LockinSettings(0.0, 0.0, mains_hz)  # each burst has a length of its own
    duration = schedule(site).duration
    return LockinSettings(duration, duration, mains_hz)


def slot_settings_of(site: Site, lockin: LockinSettings | None) -> SlotSettings:
    """Return the settings for the options of a lock-in.

    Raises InputError where the options select a window that is not a slot.
    """
    if lockin is None:
        return default_slot_settings(site)
    if is_marked(site):
        if lockin.window > 0.0:
            raise InputError(
                f"--window {lockin.window:g} s: the marked bursts are the windows; leave the option"
                " out"
            )
        return default_slot_settings(site, lockin.mains_hz)
    duration = schedule(site).duration
    if abs(lockin.window - duration) > 1e-9 * duration:
        raise InputError(
            f"--window {lockin.window:g} s: the time slots of {duration:g} s are the windows;"
            " leave the option out"
        )
    return default_slot_settings(site, lockin.mains_hz)


@once_a_site
def is_pulsed(site: Site) -> bool:
    """Return whether the coils are driven by pulses of direct current, without a carrier."""
    return all(np.all(beacon.tone_frequencies_hz == 0.0) for beacon in site.beacons)


def history_of(site: Site, settings: SlotSettings) -> int:
    """Return to how many later cycles a slot contributes noise and ambient field."""
    return max(NOISE_CYCLES, settings.cycles * (STRETCH if is_pulsed(site) else 1))


def driven_slots(site: Site, number: IntArray) -> BoolArray:
    """Return in which slots, by running number, a coil is driven."""
    count = places(site)
    return owners(site, count)[number % count] >= 0


def carriers_hz(site: Site, count: int) -> Array:
    """Return the carrier of each slot of a cycle (Hz); that of the first coil in silent ones."""
    tones = [(slot, f) for beacon in site.beacons for f, slot in beacon.tones]
    carrier = np.full(count, tones[0][1])
    for slot, frequency in tones:
        assert slot is not None
        carrier[slot] = frequency
    return carrier


def check_carriers(site: Site, rate_hz: float, settings: SlotSettings) -> None:
    """Reject slots and carriers that the sampling rate or the settings do not suit."""
    slots = schedule(site)
    carrier = carriers_hz(site, slots.count)
    if slots.duration * rate_hz < MIN_SAMPLES * (1.0 - 1e-6):
        raise InputError(
            f"magnetometer: sampled at {rate_hz:.4g} Hz, too slow for slots of"
            f" {slots.duration:g} s; at least {MIN_SAMPLES / slots.duration:.4g} Hz are needed"
        )
    highest, lowest = float(np.max(carrier)), float(np.min(carrier))
    if highest > 0.45 * rate_hz:
        raise InputError(
            f"magnetometer: sampled at {rate_hz:.4g} Hz, too slow for the carrier at {highest:g}"
            f" Hz; at least {highest / 0.45:.4g} Hz are needed"
        )
    if highest > 0.0 and lowest * slots.duration < MIN_CYCLES:
        raise InputError(
            f"a carrier of {lowest:g} Hz has less than {MIN_CYCLES:g} cycles in a slot of"
            f" {slots.duration:g} s; give longer slots, a faster carrier, or frequency_hz: 0"
            " in all coils for pulses of direct current"
        )
    separate = settings.removal != "none"
    if separate and highest > lowest:
        raise InputError(
            "silent slots cannot determine the ambient field at several carriers; demodulate"
            " without them, or drive all coils at one frequency"
        )
    if (separate or highest == 0.0) and np.all(owners(site, slots.count) >= 0):
        raise InputError(
            f"all {slots.count} time slots are driven and none determines the ambient field; leave"
            " one silent, or drive the coils with a carrier"
        )


def owners(site: Site, count: int) -> IntArray:
    """Return the channel that each slot of a cycle drives; -1 where it is silent."""
    owner = np.full(count, -1)
    tones = [slot for beacon in site.beacons for _, slot in beacon.tones]
    owner[np.array(tones)] = np.arange(len(tones))
    return owner
