"""Where an instrument's range ends, by the samples until then.

At the end of its range an axis keeps one value while the others go on.  A magnetometer that is read
faster than it measures keeps all three, and one that rests between two steps keeps values anywhere.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.model.samples import Waveform
from magfusion.units import Array, BoolArray, IntArray

SHORTEST = 3  # samples in a row at the end of a range
LONGEST = 8  # from so many on it is one, whatever is kept elsewhere
STEPS = 8.0  # of the instrument, that a range must have before its end is reached


@dataclass(eq=False)
class RangeEnds:
    """What is known of the range of one axis.

    Parameters
    ----------
    low, high : float
        Least and largest value so far (T).
    finest : float
        Smallest change from one sample to the next (T).
    kept : int
        Samples in a row with one value that was no extreme; at most `LONGEST`.
    until : float
        Last sample that counted (s).
    """

    low: float = np.inf
    high: float = -np.inf
    finest: float = np.inf
    kept: int = 0
    until: float = -np.inf


def still(waveform: Waveform, first: IntArray, last: IntArray) -> BoolArray:
    """Return in which windows no sample differs from the one before; as `saturated`."""
    measured = waveform.measured_sensor
    changed = np.any(measured[1:] != measured[:-1], axis=1)
    changes = np.concatenate([[0], np.cumsum(changed)])
    held = changes[np.maximum(last - 1, first)] == changes[first]
    return np.asarray(held & (last > first + 1))


def saturated(
    waveform: Waveform, first: IntArray, last: IntArray, ends: tuple[RangeEnds, ...]
) -> BoolArray:
    """Return in which windows an axis stays at the end of its range.

    Parameters
    ----------
    waveform : Waveform
        With all samples of the windows.
    first, last : int ndarray, shape (n,)
        Samples of each window, without the last; windows after those that were judged before.
    ends : tuple of RangeEnds
        Of the three axes; they are brought up to date.
    """
    spoilt = np.zeros(len(first), dtype=bool)
    until = int(np.max(last, initial=0))
    if until == 0:
        return spoilt
    measured = waveform.measured_sensor[:until]
    changed = np.any(measured[1:] != measured[:-1], axis=1)
    fresh = np.concatenate([[0], np.flatnonzero(changed) + 1])
    begin, end = np.searchsorted(fresh, first), np.searchsorted(fresh, last)
    time = waveform.time[fresh]
    for axis, known in enumerate(ends):
        spoilt |= _at_end(measured[fresh, axis], time, begin, end, known)
    return spoilt


def _at_end(
    value: Array, time: Array, begin: IntArray, end: IntArray, known: RangeEnds
) -> BoolArray:
    """Return which windows, samples ``begin`` to before ``end``, hold an end of range."""
    low = np.minimum(np.minimum.accumulate(value), known.low)
    high = np.maximum(np.maximum.accumulate(value), known.high)
    change = np.abs(np.diff(value, prepend=value[:1]))
    finest = np.minimum.accumulate(np.where(change > 0.0, change, np.inf))
    finest = np.minimum(finest, known.finest)
    index = np.arange(len(value))
    start = np.maximum.accumulate(np.where(change > 0.0, index, 0))
    inner = (value > low) & (value < high) & (time > known.until)
    length = np.minimum(index - start + 1, LONGEST)
    kept = np.maximum(np.maximum.accumulate(np.where(inner, length, 0)), known.kept)
    found = np.zeros(len(begin), dtype=bool)
    first = np.flatnonzero(start == index)
    stop = np.append(first[1:], len(value))
    extreme = (value[first] == low[stop - 1]) | (value[first] == high[stop - 1])
    long = (stop - first >= SHORTEST) & extreme
    first, stop = first[long], stop[long]
    from_run, to_run = np.searchsorted(stop, begin, side="right"), np.searchsorted(first, end)
    for k in np.flatnonzero((to_run > from_run) & (end > begin)):
        at, runs = end[k] - 1, slice(from_run[k], to_run[k])
        if high[at] - low[at] <= STEPS * finest[at]:
            continue
        least = max(SHORTEST, min(int(kept[at]) + 1, LONGEST))
        whole = np.minimum(stop[runs], end[k]) - np.maximum(first[runs], begin[k])
        own = value[first[runs]]
        found[k] = bool(np.any((whole >= least) & ((own == low[at]) | (own == high[at]))))
    known.low, known.high, known.finest = float(low[-1]), float(high[-1]), float(finest[-1])
    known.kept, known.until = int(kept[-1]), max(known.until, float(time[-1]))
    return found
