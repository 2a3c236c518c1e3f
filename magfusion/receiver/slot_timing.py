"""Estimation of the slot timing of an unsynchronised tracker from the stream.

Folded at the cycle, the amplitude of the carrier is a step in each slot.  The slots begin where
steps fit best, and the silent ones identify them.
"""

import numpy as np

from magfusion.errors import InputError
from magfusion.model.once import once_a_site
from magfusion.model.samples import Waveform
from magfusion.model.site import Site, Slots
from magfusion.receiver.slots import carriers_hz, is_marked, is_pulsed, owners, schedule
from magfusion.units import AnyArray, Array

BINS = 32  # of a slot
MIN_BINS = 6  # of them with samples; a slot has eight
MIN_CYCLES = 4
MAX_FOLD = 0.3  # s; clocks that are 100 ppm apart drift by 30 us
STEADY_CYCLES = 4  # of the carrier, over which the mean is the static field
MAX_SILENT_LEVEL = 0.4  # of the weakest driven slot


@once_a_site
def is_searched(site: Site) -> bool:
    """Return whether the cycle's begin is to be estimated from the stream.

    The schedule's clock is then not the log's, there is a carrier, and the places of the silent
    slots identify each slot.
    """
    if is_marked(site) or is_pulsed(site) or all(beacon.synchronised for beacon in site.beacons):
        return False
    slots = schedule(site)
    silent = owners(site, slots.count) < 0
    shared = [np.array_equal(np.roll(silent, k), silent) for k in range(1, slots.count)]
    return not any(shared)


def check_timing_declared(site: Site) -> None:
    """Reject pulses of unknown timing.

    Raises InputError folded at the cycle, the Earth's field looks like that of a coil.
    """
    free_running = [beacon.name for beacon in site.beacons if not beacon.synchronised]
    if free_running and is_pulsed(site):
        raise InputError(
            f"beacon {free_running[0]} sends direct-current pulses by its own clock (synchronised:"
            " false), and the stream does not identify its slots; record when its cycles begin"
            " and give that (synchronised: true, with start_s), or drive the coils with a carrier"
        )


def informative_share(slots: Slots) -> float:
    """Return the length of stream needed to estimate the begin of a cycle (s)."""
    return max(MAX_FOLD, 2.0 * MIN_CYCLES * slots.cycle)


def slot_start(waveform: Waveform, site: Site, rate_hz: float) -> float | None:
    """Return the begin of the first cycle in the samples (s); None if it is ambiguous.

    `waveform`: its end is used. `rate_hz`: median sampling rate.
    """
    slots = schedule(site)
    part = waveform.time >= waveform.time[-1] - informative_share(slots)
    time, measured = waveform.time[part], waveform.measured_sensor[part]
    if time[-1] - time[0] < MIN_CYCLES * slots.cycle:
        return None
    folded = _folded(time, measured, site, slots, rate_hz)
    if folded is None:
        return None
    n = len(folded)
    total = np.concatenate([[0.0], np.cumsum(np.concatenate([folded, folded]))])
    window = total[BINS : BINS + n] - total[:n]  # sum of a slot that begins in each bin
    steps = np.add.reduce([np.roll(window, -k * BINS)[:BINS] ** 2 for k in range(slots.count)])
    best = int(np.argmax(steps))
    level = window[best::BINS][: slots.count] / BINS
    silent = owners(site, slots.count) < 0
    fits = []
    for k in range(slots.count):
        rotated = np.roll(level, -k)
        fits.append(float(np.max(rotated[silent]) / np.min(rotated[~silent])))
    first = int(np.argmin(fits))
    if fits[first] > MAX_SILENT_LEVEL:
        return None
    before, here, after = (steps[(best + k) % BINS] for k in (-1, 0, 1))
    bend = before - 2.0 * here + after
    fraction = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    phase = (first * BINS + best + fraction) / n * slots.cycle
    return float(time[0] + phase)


def _folded(time: Array, measured: Array, site: Site, slots: Slots, rate_hz: float) -> Array | None:
    """Return the mean carrier amplitude in each bin of the cycle, from the first sample on."""
    size = np.zeros(len(time))
    for carrier_hz in np.unique(carriers_hz(site, slots.count)):
        varying = measured - _mean_about(measured, round(rate_hz * STEADY_CYCLES / carrier_hz))
        propagated = varying * np.exp(-2j * np.pi * carrier_hz * time)[:, None]
        length = max(2, round(rate_hz * max(2.0 / carrier_hz, slots.duration / 16.0)))
        size += np.linalg.norm(_mean_about(propagated, length), axis=1)
    bins = np.floor((time - time[0]) / slots.cycle % 1.0 * slots.count * BINS).astype(np.int64)
    bins = np.minimum(bins, slots.count * BINS - 1)
    count = np.bincount(bins, minlength=slots.count * BINS)
    dimensions = np.flatnonzero(count)
    if len(dimensions) < MIN_BINS * slots.count:
        return None
    mean = np.bincount(bins, size, minlength=len(count))[dimensions] / count[dimensions]
    if len(dimensions) == len(count):
        return np.asarray(mean)
    # If whole cycles are whole samples, a cycle has no more bins than samples.
    return np.interp(np.arange(len(count)), dimensions, mean, period=len(count))


def _mean_about(values: AnyArray, length: int) -> AnyArray:
    """Return the mean of an odd number of samples about each, fewer at the ends."""
    half, count = length // 2, len(values)
    total = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), values]), axis=0)
    index = np.arange(count)
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, count)
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])
