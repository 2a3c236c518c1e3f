"""Overlapping Allan variance of a stream of any length, in constant memory.

Samples are averaged in pairs, and pairs of pairs, level by level; a level keeps a few averages, of
which the clusters of `CLUSTERS` neighbours are compared at every step of the level.  So clusters
overlap by all but a quarter to a seventh, which is as good as overlapping them at every sample.

Missing samples are tracked: each average has the share of samples present, and a cluster is
used only where nearly all of its samples are present.
"""

from dataclasses import dataclass, field

import numpy as np

from magfusion.units import Array, IntArray

CLUSTERS = (4, 5, 6, 7)  # averages of a level in a cluster: four cluster times an octave
FIRST = (1, 2, 3)  # of the level of the samples, before those
THERE = 0.9  # share of a cluster, at least, that must be there
_KEPT = 2 * CLUSTERS[-1] - 1  # averages of a level that the next ones are compared with
CHUNK = 1 << 16  # samples that a gap is filled with at a time


@dataclass(frozen=True, eq=False)
class AllanVariance:
    """Allan variance by cluster time."""

    tau: Array  # (n,), length of a cluster (s)
    variance: Array  # (n, axes), in the stream's unit, squared
    count: IntArray  # (n,), differences of clusters, which overlap
    clusters: Array  # (n,), number of non-overlapping clusters
    # (n,), whether a cluster time is a power of two samples: those are nearly independent
    octave: Array


@dataclass
class _Level:
    """Averages of 2^k samples, and the squares of the differences of clusters of them."""

    axes: int
    sizes: tuple[int, ...]
    mean: Array = field(init=False)
    share: Array = field(init=False)
    odd: tuple[Array, Array] | None = None
    square: dict[int, Array] = field(init=False)
    count: dict[int, int] = field(init=False)

    def __post_init__(self) -> None:
        self.mean, self.share = np.zeros((0, self.axes)), np.zeros(0)
        self.square = {m: np.zeros(self.axes) for m in self.sizes}
        self.count = dict.fromkeys(self.sizes, 0)

    def add(self, mean: Array, share: Array) -> None:
        """Process further averages (n, axes), each with its share (n,) of samples present."""
        mean = np.concatenate([self.mean, mean])
        share = np.concatenate([self.share, share])
        fresh = len(mean) - len(self.mean)
        weighed = np.cumsum(np.concatenate([np.zeros((1, self.axes)), share[:, None] * mean]), 0)
        there = np.cumsum(np.concatenate([[0.0], share]))
        complete = bool(np.all(share == 1.0))
        for m in self.sizes:
            # Only the clusters that end with one of the fresh averages.
            first = max(0, len(mean) - fresh - 2 * m + 1)
            last = len(mean) - 2 * m + 1
            if last <= first:
                continue
            residual, middle = slice(first, last), slice(first + m, last + m)
            right = slice(first + 2 * m, last + 2 * m)
            if complete:
                step = (weighed[right] - 2.0 * weighed[middle] + weighed[residual]) / m
            else:
                before, after = there[middle] - there[residual], there[right] - there[middle]
                whole = (before >= THERE * m) & (after >= THERE * m)
                safe = np.where(whole, after, 1.0)[:, None], np.where(whole, before, 1.0)[:, None]
                step = (weighed[right] - weighed[middle]) / safe[0]
                step -= (weighed[middle] - weighed[residual]) / safe[1]
                step = step[whole]
            self.square[m] += 0.5 * np.einsum("na,na->a", step, step)
            self.count[m] += len(step)
        self.mean, self.share = mean[-_KEPT:], share[-_KEPT:]

    def pairs(self, mean: Array, share: Array) -> tuple[Array, Array]:
        """Return the averages of pairs; an unpaired average is kept for the next call."""
        if self.odd is not None:
            mean = np.concatenate([self.odd[0], mean])
            share = np.concatenate([self.odd[1], share])
        even = len(mean) - len(mean) % 2
        self.odd = (mean[even:], share[even:]) if even < len(mean) else None
        both = share[:even].reshape(-1, 2)
        total = both.sum(axis=1)
        weighed = (both[..., None] * mean[:even].reshape(-1, 2, self.axes)).sum(axis=1)
        safe = np.where(total > 0.0, total, 1.0)[:, None]
        return weighed / safe, 0.5 * total


class AllanStream:
    """Allan variance of samples that arrive in blocks.

    `axes`: number of channels.
    """

    def __init__(self, axes: int) -> None:
        self._axes = axes
        self._levels: list[_Level] = []
        self._origin: Array | None = None
        self.samples = 0
        self.missing = 0

    def add(self, values: Array) -> None:
        """Process further samples (n, axes), evenly spaced; a row with a NaN counts as missing."""
        there = np.asarray(np.isfinite(values).all(axis=1))
        if self._origin is None:
            if not there.any():
                self.missing += len(values) if self.samples else 0
                return
            self._origin = values[there][0].copy()  # so that cumulated sums do not round
        self.samples += int(there.sum())
        self.missing += int(len(there) - there.sum())
        mean = np.asarray(np.where(there[:, None], values - self._origin, 0.0))
        share = np.asarray(there, dtype=np.float64)
        level = 0
        while len(mean):
            if level == len(self._levels):
                sizes = CLUSTERS if level else (*FIRST, *CLUSTERS)
                self._levels.append(_Level(self._axes, sizes))
            one = self._levels[level]
            one.add(mean, share)
            mean, share = one.pairs(mean, share)
            level += 1

    def skip(self, count: int) -> None:
        """Register missing samples."""
        while count > 0:
            piece = min(count, CHUNK)
            self.add(np.full((piece, self._axes), np.nan))
            count -= piece

    def result(self, step: float) -> AllanVariance:
        """Return the Allan variance of the samples so far.

        `step`: time from sample to sample (s).
        """
        rows = [
            (m << k, level.square[m] / level.count[m], level.count[m], level.count[m] / m)
            for k, level in enumerate(self._levels)
            for m in level.sizes
            if level.count[m] >= m
        ]
        rows.sort(key=lambda row: row[0])
        length = np.array([row[0] for row in rows], dtype=np.int64)
        return AllanVariance(
            tau=np.asarray(length * step, dtype=np.float64),
            variance=np.array([row[1] for row in rows]).reshape(len(rows), self._axes),
            count=np.array([row[2] for row in rows], dtype=np.int64),
            clusters=np.array([row[3] for row in rows]),
            octave=(length & (length - 1)) == 0,
        )
