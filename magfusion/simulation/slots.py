"""Coils that are driven in turn: when each carries its current."""

import numpy as np

from magfusion.errors import InputError
from magfusion.model.site import Beacon
from magfusion.units import Array

LEAST_SAMPLES_PER_SLOT = 4


def check_slots(beacon: Beacon, rate_hz: float) -> None:
    """Refuse coils in time slots that no schedule drives, or that the samples cannot follow.

    Raises
    ------
    InputError
    """
    if all(slot is None for _, slot in beacon.tones):
        return
    if beacon.slots is None:
        raise InputError(
            f"beacons.{beacon.name}: found coils in time slots, of which no waveform can be "
            "simulated without the beacon's slots: {duration_s, count}; add it, or give each coil "
            "a frequency_hz instead"
        )
    least = LEAST_SAMPLES_PER_SLOT / beacon.slots.duration
    if rate_hz < least:
        raise InputError(
            f"magnetometer_rate_hz: found {rate_hz} Hz and slots of {beacon.slots.duration} s in "
            f"beacon {beacon.name}; give at least {least:g} Hz"
        )


def slot_gates(beacon: Beacon, time: Array) -> Array:
    """Return one while a tone's coils are driven and zero otherwise, shape (n, tones).

    The current is switched at once: a real driver takes its time constant.
    """
    gates = np.ones((len(time), len(beacon.tones)))
    if beacon.slots is None:
        return gates
    running = beacon.slots.running(time) % beacon.slots.count
    for k, (_, slot) in enumerate(beacon.tones):
        if slot is not None:
            gates[:, k] = running == slot
    return gates
