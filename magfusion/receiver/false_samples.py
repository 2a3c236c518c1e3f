"""False samples of a stream: isolated ones, and runs of a few that are off by about the same.

Their neighbours agree with each other.  A motion of that size begins and ends over several samples,
and a knock rings.
"""

from typing import NamedTuple

import numpy as np

from magfusion.units import Array, BoolArray, IntArray

MAX_RUN = 8  # samples
FLANK = 2  # good samples needed on each side
EDGE = 5.0  # an edge's step over those of the two good samples next to it
CLOSED = 3.0  # least deviation of a run over the difference between its flanks
FLAT = 3.0  # largest deviation within a run over the least
UNEVEN = 2.5  # a gap is this many times the usual step
# Deviations over the differences of the neighbours, and of all but an outer one that may be false.
AGREEMENT, AGREEMENT_BUT_ONE = 3.0, 30.0
EVEN_GAIN = 70.0**0.5 / 6.0  # of noise, in a sample less the cubic: weights -1, 4, 4, -1 sixths


class Deviations(NamedTuple):
    """Deviations of samples from their neighbours."""

    off: Array  # (n, axes), zero where the neighbours do not agree with each other
    # (n, axes), from the cubic through the neighbours, of noise as if they were even
    residual: Array
    widening: Array  # (n, 1), how much larger it may be where they are not
    centre: Array  # (n, axes), mean of the nearest neighbours

    def size(self, scatter: Array) -> Array:
        """Return deviations relative to the scatter of residuals, the largest axis, shape (n,)."""
        usual = self.widening * scatter + 1e-9 * np.abs(self.centre)  # rounding
        return np.asarray(np.max(self.off / np.maximum(usual, np.finfo(float).tiny), axis=1))


def deviations(time: Array, x: Array, step: float) -> Deviations:
    """Return deviations of samples (n, axes), at least five, at times (s) with a usual step."""
    row = np.arange(len(x))
    first = np.clip(row - 2, 0, len(x) - 5)
    near = [first + k + (first + k >= row) for k in range(4)]
    weight, noise, widening = _cubic(time, near, step)
    curve = np.zeros_like(x)
    for own, at in zip(weight, near, strict=True):
        curve += own[:, None] * x[at]
    before, after = x[near[1]], x[near[2]]
    centre = 0.5 * (before + after)
    outer = np.abs(x[near[0]] - centre), np.abs(x[near[3]] - centre)
    separate = np.maximum(np.abs(after - before), np.maximum(*outer))
    others = np.maximum(np.abs(after - before), np.minimum(*outer))
    from_curve = np.abs(x - curve)
    off = np.minimum(from_curve, np.abs(x - centre))
    alone = (off > AGREEMENT * separate) | (off > AGREEMENT_BUT_ONE * others)
    return Deviations(np.where(alone, off, 0.0), from_curve / noise, widening, centre)


def _cubic(time: Array, near: list[IntArray], step: float) -> tuple[list[Array], Array, Array]:
    """Return weights (n,) of four neighbours in a cubic, and how much its error grows.

    The latter, shape (n, 1), is relative to even samples: of noise alone, and of noise or a smooth
    signal where samples are missing or at an end.
    """
    far = [(time[at] - time) / step for at in near]
    weight = []
    for k, own in enumerate(far):
        others = [far[j] for j in range(4) if j != k]
        weight.append(np.prod([other / (other - own) for other in others], axis=0))
    noise = np.sqrt(1.0 + np.sum(np.square(weight), axis=0))[:, None] / EVEN_GAIN
    smooth = np.abs(np.prod(far, axis=0))[:, None] / 4.0
    return weight, noise, np.maximum(1.0, np.maximum(noise, smooth))


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
