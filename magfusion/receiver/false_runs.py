"""Runs of consecutive false samples: off by about the same, between neighbours that agree.

A motion of that size begins and ends over several samples, and a knock rings.
"""

import numpy as np

from magfusion.units import Array, BoolArray, IntArray

MAX_RUN = 8  # samples
FLANK = 2  # good samples needed on each side
EDGE = 5.0  # an edge's step over those of the two good samples next to it
CLOSED = 3.0  # least deviation of a run over the difference between its flanks
FLAT = 3.0  # largest deviation within a run over the least
UNEVEN = 2.5  # a gap is this many times the usual step


def false_runs(time: Array, x: Array, step: float, least: Array) -> tuple[IntArray, int]:
    """Return the rows of false runs, and the first row that may begin one at the end.

    `time` (n,) (s) with a usual `step` (s). `x` (n, axes). `least` (n, axes): least deviation of a
    false sample. The latter is ``n`` where no run is open.
    """
    count = len(x)
    rows: list[IntArray] = []
    open_row = count
    if count < 2 * FLANK:
        return np.zeros(0, dtype=np.int64), count
    even = np.append(np.diff(time) < UNEVEN * step, True)
    for axis in range(x.shape[1]):
        own, limit = x[:, axis], least[:, axis]
        begins, ends = _edges(own, limit)
        for begin in np.flatnonzero(begins).tolist():
            if not even[begin - FLANK : begin + 1].all():
                continue
            last = min(begin + MAX_RUN, count - FLANK)
            candidates = begin + 2 + np.flatnonzero(ends[begin + 2 : last + 1])
            for end in candidates.tolist():
                if even[begin : end + 1].all() and _is_false(own, begin, end, limit[begin]):
                    rows.append(np.arange(begin, end))
                    break
            else:
                if begin + MAX_RUN + FLANK > count:
                    open_row = min(open_row, begin)
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *rows])), open_row


def _edges(x: Array, least: Array) -> tuple[BoolArray, BoolArray]:
    """Return which samples (n,) may begin a run, and which may be the first good ones after it."""
    jump = np.abs(np.diff(x))
    large = jump > least[1:]
    begins, ends = np.zeros((2, len(x)), dtype=bool)
    quiet = np.maximum(jump[:-1], np.append(0.0, jump[:-2]))
    begins[2:] = large[1:] & (jump[1:] > EDGE * quiet)
    quiet = np.maximum(jump[1:], np.append(jump[2:], 0.0))
    ends[1:-1] = large[:-1] & (jump[:-1] > EDGE * quiet)
    return begins, ends


def _is_false(x: Array, begin: int, end: int, least: float) -> bool:
    """Return whether the samples from ``begin`` to before ``end`` are off their flanks."""
    before, after = x[begin - 1], x[end]
    share = np.arange(1, end - begin + 1) / (end - begin + 1)
    off = x[begin:end] - (before + share * (after - before))
    size = np.abs(off)
    one_way = bool(np.all(off > 0.0) or np.all(off < 0.0))
    flat = np.max(size) < FLAT * np.min(size)
    return one_way and bool(flat and np.min(size) > max(least, CLOSED * abs(after - before)))
