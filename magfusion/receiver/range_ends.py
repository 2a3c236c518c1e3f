"""Detection of the end of an instrument's range from the samples so far.

At the end of its range an axis is constant while the others change.  A magnetometer that is read
faster than it measures repeats all three, and one near rest repeats any value between two steps.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magfusion.files.plausible import reaches
from magfusion.model.samples import Waveform
from magfusion.units import Array, BoolArray, IntArray

MIN_RUN = 3  # samples in a row at the end of a range
MAX_RUN = 8  # length of a run that is an end of range, whatever repeats elsewhere
STEPS = 8.0  # of the instrument, that a range must have before its end is reached


@dataclass(eq=False)
class RangeEnds:
    """Observed range of one axis."""

    # low, high: least and largest value so far (T)
    low: float = np.inf
    high: float = -np.inf
    finest: float = np.inf  # smallest change from one sample to the next (T)
    # longest run of a constant value that was no extreme (samples); at most `MAX_RUN`
    kept: int = 0
    until: float = -np.inf  # time of the last sample used (s)


def still(waveform: Waveform, first: IntArray, last: IntArray) -> BoolArray:
    """Return in which windows all samples are equal; arguments as of `saturated`."""
    # An empty window may begin behind the last sample.
    changes = np.concatenate([[0], np.cumsum(_changed(waveform.measured_sensor)), [-1]])
    fixed = changes[np.maximum(last - 1, first)] == changes[first]
    return np.asarray(fixed & (last > first + 1))


def _changed(measured: Array) -> BoolArray:
    """Return which samples (n, 3) differ from the one before, (n - 1,)."""
    x, y, z = (measured[1:] != measured[:-1]).T
    return np.asarray(x | y | z)


def at_declared_range(
    waveform: Waveform, first: IntArray, last: IntArray, largest: float
) -> BoolArray:
    """Return in which windows an axis is at the end of a declared range (T)."""
    count = np.cumsum(np.append(0, reaches(waveform.measured_sensor, largest).any(axis=1)))
    return np.asarray(count[np.maximum(last, first)] > count[first])


def saturated(
    waveform: Waveform, first: IntArray, last: IntArray, ends: tuple[RangeEnds, ...]
) -> BoolArray:
    """Return in which windows an axis is at the end of its range.

    Parameters
    ----------
    waveform : Waveform
        With all samples of the windows.
    first, last : int ndarray, shape (n,)
        Sample ranges, end exclusive; windows after those assessed before.
    ends : tuple of RangeEnds
        Of the three axes; they are updated.
    """
    corrupted = np.zeros(len(first), dtype=bool)
    until = int(np.max(last, initial=0))
    if until == 0:
        return corrupted
    measured = waveform.measured_sensor[:until]
    fresh = np.concatenate([[0], np.flatnonzero(_changed(measured)) + 1])
    begin, end = np.searchsorted(fresh, first), np.searchsorted(fresh, last)
    # The ends cover the earlier samples, except the length of the newest run.
    new = int(np.searchsorted(waveform.time[fresh], min(one.until for one in ends), side="right"))
    known_until = max(min(new, int(begin.min())) - MAX_RUN, 0)
    fresh, begin, end = fresh[known_until:], begin - known_until, end - known_until
    value, time = measured[fresh], waveform.time[fresh]
    known = np.array([(one.low, one.high, one.finest, one.kept) for one in ends]).T
    if known[3].min() >= 1 and (value[1:] != value[:-1]).all():
        _update_ends(ends, value, time)  # no axis repeats a value, the usual case
        return corrupted
    low = np.minimum(np.minimum.accumulate(value), known[0])
    high = np.maximum(np.maximum.accumulate(value), known[1])
    change = np.zeros_like(value)
    np.abs(value[1:] - value[:-1], out=change[1:])
    moved = change > 0.0
    finest = np.minimum.accumulate(np.where(moved, change, np.inf))
    finest = np.minimum(finest, known[2])
    index = np.arange(len(value))[:, None]
    start = np.maximum.accumulate(np.where(moved, index, 0))
    inner = (value > low) & (value < high)
    inner &= time[:, None] > np.array([one.until for one in ends])
    length = np.minimum(index - start + 1, MAX_RUN)
    kept = np.maximum(np.maximum.accumulate(np.where(inner, length, 0)), known[3])
    for axis in np.flatnonzero(np.max(length, axis=0) >= MIN_RUN).tolist():
        runs = _Runs(*(part[:, axis] for part in (value, low, high, finest, start, kept)))
        corrupted |= _at_end(runs, begin, end)
    newest = float(time[-1])
    for axis, one in enumerate(ends):
        one.low, one.high = float(low[-1, axis]), float(high[-1, axis])
        one.finest, one.kept = float(finest[-1, axis]), int(kept[-1, axis])
        one.until = max(one.until, newest)
    return corrupted


def _update_ends(ends: tuple[RangeEnds, ...], value: Array, time: Array) -> None:
    """Update ends with samples (n, 3) that each differ from the one before."""
    low, high = value.min(axis=0).tolist(), value.max(axis=0).tolist()
    finest = np.min(np.abs(value[1:] - value[:-1]), axis=0, initial=np.inf).tolist()
    for axis, one in enumerate(ends):
        one.low, one.high = min(one.low, low[axis]), max(one.high, high[axis])
        one.finest = min(one.finest, finest[axis])
        one.until = max(one.until, float(time[-1]))


class _Runs(NamedTuple):
    """Observed range of one axis at each sample, shape (samples,) each."""

    value: Array  # (T)
    # low, high, finest, kept: as of `RangeEnds`, until then
    low: Array
    high: Array
    finest: Array
    start: IntArray  # first sample of the current run
    kept: Array


def _at_end(runs: _Runs, begin: IntArray, end: IntArray) -> BoolArray:
    """Return which windows, samples ``begin`` to before ``end``, contain an end of range."""
    value, low, high, finest, start, kept = runs
    result = np.zeros(len(begin), dtype=bool)
    first = np.flatnonzero(start == np.arange(len(value)))
    stop = np.append(first[1:], len(value))
    extreme = (value[first] == low[stop - 1]) | (value[first] == high[stop - 1])
    long = (stop - first >= MIN_RUN) & extreme
    first, stop = first[long], stop[long]
    from_run, to_run = np.searchsorted(stop, begin, side="right"), np.searchsorted(first, end)
    for k in np.flatnonzero((to_run > from_run) & (end > begin)):
        at, within = end[k] - 1, slice(from_run[k], to_run[k])
        if high[at] - low[at] <= STEPS * finest[at]:
            continue
        least = max(MIN_RUN, min(int(kept[at]) + 1, MAX_RUN))
        whole = np.minimum(stop[within], end[k]) - np.maximum(first[within], begin[k])
        own = value[first[within]]
        result[k] = bool(np.any((whole >= least) & ((own == low[at]) | (own == high[at]))))
    return result
