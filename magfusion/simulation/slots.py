"""Coils driven in turn: the times of each current."""

from dataclasses import dataclass

import numpy as np

from magfusion.errors import InputError
from magfusion.model.marks import SILENT, Marks
from magfusion.model.site import Beacon, MarkedSlots, Site
from magfusion.units import Array

MIN_SAMPLES_PER_SLOT = 4
MIN_PAUSE = 0.05  # of the longest


@dataclass(frozen=True)
class Multiplexer:
    """A host that drives one coil after the other, with random pauses."""

    burst: float = 0.002  # of each coil, and of the silence after the last (s)
    pause: float = 0.002  # maximum pause (s); each is drawn


def draw_marks(
    site: Site, multiplexer: Multiplexer, duration: float, rng: np.random.Generator
) -> Marks:
    """Return the bursts of a host; in those of `SILENT` no coil is driven, as in the pauses."""
    slots = sorted({s for beacon in site.beacons for _, s in beacon.tones if s is not None})
    longest, burst = multiplexer.pause, multiplexer.burst
    count = int(np.ceil(duration / burst))
    pause = rng.uniform(MIN_PAUSE * longest, longest, count)
    begin = np.cumsum(pause + burst) - burst
    turn = np.resize(np.array([*slots, SILENT], dtype=np.int64), count)
    return Marks(begin, begin + burst, turn).rows(begin + burst < duration)


def check_slots(beacon: Beacon, rate_hz: float, marks: Marks | None = None) -> None:
    """Raise an error for slots that no schedule drives, or that are too short for the samples."""
    if all(slot is None for _, slot in beacon.tones):
        return
    slots = beacon.slots
    if slots is None or (isinstance(slots, MarkedSlots) and marks is None):
        raise InputError(
            f"beacons.{beacon.name}: coils in time slots cannot be simulated without the beacon's "
            "slots: {duration_s, count}; add it, or give each coil a frequency_hz instead"
        )
    if isinstance(slots, MarkedSlots):
        assert marks is not None
        duration = float(np.min(marks.end - marks.begin, initial=np.inf))
    else:
        duration = slots.duration
    least = MIN_SAMPLES_PER_SLOT / duration
    if rate_hz < least:
        raise InputError(
            f"magnetometer_rate_hz: found {rate_hz} Hz and slots of {duration} s in "
            f"beacon {beacon.name}; give at least {least:g} Hz"
        )


def slot_gates(beacon: Beacon, time: Array, marks: Marks | None = None) -> Array:
    """Return one while a tone's coils are driven and zero otherwise, shape (n, tones).

    The current is switched instantly: a real driver has a time constant.
    """
    gates = np.ones((len(time), len(beacon.tones)))
    if beacon.slots is None:
        return gates
    if isinstance(beacon.slots, MarkedSlots):
        assert marks is not None
        row = np.searchsorted(marks.begin, time, side="right") - 1
        inside = (row >= 0) & (time < marks.end[row])
        running = np.where(inside, marks.slot[row], SILENT)
    else:
        running = beacon.slots.running(time) % beacon.slots.count
    for k, (_, slot) in enumerate(beacon.tones):
        if slot is not None:
            gates[:, k] = running == slot
    return gates
