"""A stream of samples at rest, of any length: even spacing, gaps, and whether it moved.

Memory is bounded: Allan sums, and a summary of at most `MAX_BLOCKS` stretches.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.calibration.allan import AllanStream, AllanVariance
from magfusion.receiver.sampling_clock import sampling_clock
from magfusion.units import Array, BoolArray, IntArray

MAX_BLOCKS = 4096
MAX_CLOCKED = 10_000  # samples that show whether stamps are coarse
COARSE = 0.02  # of a step
BLOCK = 1.0  # s, of the shortest stretch
GAP = 0.5  # of a step, by which three steps in a row are too long where a sample is missing
MAX_FILL = 64  # samples missing in a row; beyond, nothing is filled in
ROWS = 1 << 14  # samples that are taken at once
SHAKEN = 3.0  # times the usual scatter in a stretch
STILL = 1e-6  # of the usual scatter, what rounding leaves of a frozen stretch
KNOCKED = 10.0  # times the usual change from stretch to stretch
QUANTISED = 0.5  # share of the samples whose value on one axis is the one before


@dataclass(frozen=True, eq=False)
class Blocks:
    """Stretches of a stream."""

    begin: Array  # (n,) (s)
    end: Array  # (n,) (s)
    mean: Array  # (n, axes)
    scatter: Array  # (n, axes), largest one-second standard deviation
    change: Array  # (n, axes), largest change of the mean from one second to the next

    def outlying(self) -> BoolArray:
        """Return which stretches are shaken, knocked or frozen relative to the others, (n,)."""
        if len(self.begin) < 4:
            return np.zeros(len(self.begin), dtype=bool)
        usual = np.median(self.scatter, axis=0)
        shaken = self.scatter > SHAKEN * usual
        knocked = self.change > KNOCKED * np.median(self.change, axis=0)
        frozen = np.all(self.scatter < STILL * usual, axis=1)
        strong = (shaken & (self.scatter > 0.0)) | (knocked & (self.change > 0.0))
        return np.asarray(frozen | strong.any(axis=1))

    def exceeding(self, limit: Array) -> BoolArray:
        """Return in which stretches an axis deviates or scatters beyond limits (axes,)."""
        off = np.abs(self.mean - np.median(self.mean, axis=0))
        return np.asarray(((off > limit) | (self.scatter > limit)).any(axis=1))


class RestStream:
    """Samples of one stream, processed in blocks."""

    def __init__(self, axes: int) -> None:
        self.allan = AllanStream(axes)
        self._axes = axes
        self._step, self._stamp, self._counted = 0.0, -np.inf, False
        self._last: tuple[float, Array] | None = None
        self._slots = 0
        self._begin = self._end = 0.0
        self._sum = np.zeros(axes)
        self._origin = np.zeros(axes)
        self._repeated = np.zeros(axes)
        self._changed = 0
        self._rest = np.zeros((0, axes))
        self._rest_begin = 0.0
        self._blocks: list[tuple[float, float, Array, Array, Array]] = []
        self._per_block = 1
        self._pending: list[tuple[float, float, Array, Array, Array]] = []
        self._before: Array | None = None

    def __len__(self) -> int:
        return self.allan.samples

    def add(self, time: Array, values: Array) -> None:
        """Process further samples: times (n,) (s), values (n, axes), NaN where one is missing."""
        fresh = np.flatnonzero(np.diff(time, prepend=self._stamp) > 0.0)
        time, values = time[fresh], values[fresh]
        if len(time) == 0:
            return
        if self._last is None and len(time) < 3:
            return
        self._stamp = float(time[-1])
        if self._last is None:
            self._counted = _are_counted(time)
        clock = sampling_clock(time) if self._counted else None
        time = time if clock is None else clock.time
        if self._last is None:
            self._step = _usual_step(time) if clock is None else clock.step
            self._begin = self._rest_begin = float(time[0])
            self._origin = np.nan_to_num(values[0])
        previous = time[0] - self._step if self._last is None else self._last[0]
        self._count_repeated(values)
        missing = _missing(np.diff(time, prepend=previous) / self._step)
        for first in range(0, len(time), ROWS):
            part = slice(first, first + ROWS)
            self._fill(values[part], missing[part])
        self._end = float(time[-1])
        self._last = (float(time[-1]), values[-1])

    @property
    def step(self) -> float:
        """Mean sample interval (s)."""
        return (self._end - self._begin) / max(self._slots - 1, 1)

    @property
    def duration(self) -> float:
        """Duration from the first sample to the last (s)."""
        return self._end - self._begin

    @property
    def mean(self) -> Array:
        """Mean of all samples, shape (axes,)."""
        return self._origin + self._sum / max(len(self), 1)

    @property
    def missing_share(self) -> float:
        """Share of the samples that are missing."""
        return self.allan.missing / max(self._slots, 1)

    @property
    def repeated(self) -> Array:
        """Share of saturated samples, among those that are not all the same."""
        return self._repeated / max(self._changed, 1)

    def allan_variance(self) -> AllanVariance:
        """Return the Allan variance of the samples so far."""
        return self.allan.result(self.step)

    def blocks(self) -> Blocks:
        """Return the stretches so far."""
        rows = self._blocks + ([_merged(self._pending)] if self._pending else [])
        if not rows:
            nothing = np.zeros((0, self._axes))
            return Blocks(np.zeros(0), np.zeros(0), nothing, nothing, nothing)
        begin, end = (np.array([row[k] for row in rows]) for k in (0, 1))
        mean, scatter, change = (np.array([row[k] for row in rows]) for k in (2, 3, 4))
        return Blocks(begin, end, mean, scatter, change)

    def _count_repeated(self, values: Array) -> None:
        before = values[:1] * np.nan if self._last is None else self._last[1][None]
        same = values == np.concatenate([before, values[:-1]])
        changed = ~same.all(axis=1)
        self._repeated += np.sum(same[changed], axis=0)
        self._changed += int(np.sum(changed))

    def _fill(self, values: Array, missing: IntArray) -> None:
        """Put samples on an even grid."""
        long = np.flatnonzero(missing > MAX_FILL)
        for part, gap in zip(
            np.split(np.arange(len(values)), long), [0, *missing[long]], strict=True
        ):
            if gap:
                self._slots += int(gap)
                self.allan.skip(int(gap))
                self._rest = self._rest[:0]
                self._before = None
            if len(part) == 0:
                continue
            own = missing[part].copy()
            own[0] = 0 if gap else own[0]
            place = np.arange(len(part)) + np.cumsum(own)
            even = np.full((int(place[-1]) + 1, self._axes), np.nan)
            even[place] = values[part]
            there = np.isfinite(even).all(axis=1)
            self._sum += np.sum(even[there] - self._origin, axis=0)
            self.allan.add(even)
            self._summarise(even)
            self._slots += len(even)

    def _summarise(self, even: Array) -> None:
        """Summarise each second."""
        begin = self._begin + self._step * (self._slots - len(self._rest))
        rows = np.concatenate([self._rest, even])
        length = max(2, round(BLOCK / self._step))
        count = len(rows) // length
        self._rest = rows[count * length :].copy()
        for k in range(count):
            block = rows[k * length : (k + 1) * length]
            block = block[np.isfinite(block).all(axis=1)]
            if len(block) < 0.5 * length:
                self._before = None
                continue
            mean = np.mean(block, axis=0)
            change = np.zeros(self._axes) if self._before is None else np.abs(mean - self._before)
            at = begin + k * length * self._step
            row = (at, at + length * self._step, mean, np.std(block, axis=0), change)
            self._before = mean
            self._pending.append(row)
            if len(self._pending) == self._per_block:
                self._blocks.append(_merged(self._pending))
                self._pending = []
            if len(self._blocks) == MAX_BLOCKS:
                pairs = zip(self._blocks[::2], self._blocks[1::2], strict=True)
                self._blocks = [_merged([a, b]) for a, b in pairs]
                self._per_block *= 2


def _merged(
    rows: list[tuple[float, float, Array, Array, Array]],
) -> tuple[float, float, Array, Array, Array]:
    mean = np.mean([row[2] for row in rows], axis=0)
    scatter = np.max([row[3] for row in rows], axis=0)
    change = np.max([row[4] for row in rows], axis=0)
    return rows[0][0], rows[-1][1], mean, scatter, change


def _are_counted(time: Array) -> bool:
    """Return whether stamps are so coarse or late that their steps are not the sensor's."""
    clock = sampling_clock(time[:MAX_CLOCKED])
    return clock is not None and abs(_usual_step(time) / clock.step - 1.0) > COARSE


def _usual_step(time: Array) -> float:
    """Return the mean of the steps near the median step, to within their sum."""
    step = np.diff(time)
    ratio = step / np.median(step)
    return float(np.mean(step[(ratio > 1.0 - GAP) & (ratio < 1.0 + GAP)]))


def _missing(steps: Array) -> IntArray:
    """Return the number of samples missing before each, from steps in units of the nominal step.

    A late stamp is followed by a short step; a missing sample is not.
    """
    excess = steps - 1.0
    padded = np.concatenate([[0.0], excess, [0.0]])
    around = padded[:-2] + excess + padded[2:]
    late = (excess > GAP) & (around > GAP)
    return np.where(late, np.maximum(np.rint(np.minimum(excess, around)), 0.0), 0.0).astype(
        np.int64
    )
