"""Even clock of a stream whose stamps are of batches or bursts, or rounded, as samples arrive.

The beginning decides by the procedures for logs; from there on samples are counted.
"""

from typing import Literal

import numpy as np

from magfusion.model.batches import PAUSE, spread_batches
from magfusion.receiver.bursts import (
    MAX_PAUSE,
    SHARE,
    TOGETHER,
    burst_ends,
    burst_limit,
    shortest_pause,
)
from magfusion.receiver.sampling_clock import (
    GAP,
    is_even,
    lost_ticks,
    sampling_clock,
    stamp_resolution,
)
from magfusion.units import Array, BoolArray, IntArray

MIN_SAMPLES = 32  # that show whether stamps are even
ENOUGH = 200  # samples that determine another clock
MAX_WAIT = 2.0  # s; for either
MEMORY = 2000  # stamps that determine the clock
MIN_POINTS = 4  # batches
REFIT = 0.1  # s between two fits
UNDECIDED = 30  # samples
CLEAR = 0.25  # of a step, root mean square; beyond, the ticks of the first samples are not certain
MIN_ADVANCE = 0.5  # of a step, where the clock is set back


Stamping = Literal["stamps", "counted", "rounded"]


class RunningClock:
    """Replaces the stamps of a stream by an even clock, where they are not those of its samples.

    `known`: kind of stamps, where it need not be found. Attributes: `stamping`: None until it is
    decided; ``counted`` if samples have the stamps of batches. `step`: between two samples (s).
    """

    def __init__(self, known: Stamping | None = None) -> None:
        self._begin_again(known)

    def _begin_again(self, known: Stamping | None = None) -> None:
        self.stamping, self.step = known, 0.0
        self._waiting: tuple[Array, Array] | None = None  # stamps and rows
        self._tick, self._stamp, self._newest = 0, -np.inf, -np.inf
        self._origin, self._pause, self._fitted = 0.0, np.inf, -np.inf
        self._points, self._width = np.empty((2, 0)), 0
        self._scatter, self._rounding = 0.0, 0.0
        self._limit: float | None = None  # s; samples of a burst are closer
        # Even stamps that may turn out to be rounded, and how many come before a check.
        self._watched: Array | None = None
        self._until_check = 0

    def push(self, stamps: Array, rows: Array) -> tuple[Array, Array]:
        """Add samples (k,) with their stamps (s); return sampling times (s) of those known."""
        self._width = rows.shape[1]
        if not len(stamps):
            return stamps, rows
        if self.stamping == "stamps":
            return self._watch(stamps), rows
        if self.stamping is None:
            return self._gather(stamps, rows)
        gap = np.flatnonzero(np.diff(stamps, prepend=self._stamp) > self._pause)
        if len(gap):
            time, own = self._timed(stamps[: gap[0]]), rows[: gap[0]]
            self._begin_again()
            later = self._gather(stamps[gap[0] :], rows[gap[0] :])
            return np.append(time, later[0]), np.concatenate([own, later[1]])
        return self._timed(stamps), rows

    def end(self) -> tuple[Array, Array]:
        """Return the samples that wait at the end of the stream."""
        if self._waiting is None:
            return np.empty(0), np.empty((0, self._width))
        return self._decide(*self._waiting)

    def _gather(self, stamps: Array, rows: Array) -> tuple[Array, Array]:
        """Keep samples until the kind of clock is known."""
        if self._waiting is not None:
            stamps = np.append(self._waiting[0], stamps)
            rows = np.concatenate([self._waiting[1], rows])
        late = float(stamps[-1] - stamps[0]) >= MAX_WAIT
        known = len(stamps) >= MIN_SAMPLES and not _is_candidate(stamps)
        if len(stamps) >= ENOUGH or late or known:
            return self._decide(stamps, rows)
        self._waiting = stamps, rows
        return stamps[:0], rows[:0]

    def _decide(self, stamps: Array, rows: Array) -> tuple[Array, Array]:
        """Find the clock of the first samples, and return them on it."""
        self._waiting, self.stamping = None, "stamps"
        if len(stamps) < MIN_SAMPLES or not _is_candidate(stamps):
            if len(stamps) >= MIN_SAMPLES and stamp_resolution(stamps) > 0.0:
                self._watched = stamps
            return stamps, rows
        together = np.diff(stamps) == 0.0
        if np.mean(together) > 0.5 * SHARE:
            copies = (rows[1:] == rows[:-1]).all(axis=1)
            last = np.append(np.flatnonzero(~together), len(stamps) - 1)
            if np.mean(copies[together]) > 0.5 or len(last) < MIN_POINTS:
                return stamps, rows
            return self._start("counted", stamps, spread_batches(stamps, last), last), rows
        self._limit = burst_limit(stamps)
        if self._limit is not None:
            last = burst_ends(stamps, self._limit)
            return self._start("counted", stamps, spread_batches(stamps, last), last), rows
        clock = sampling_clock(stamps)
        self._rounding = stamp_resolution(stamps)
        if clock is None or not self._rounding or clock.scatter > CLEAR * clock.step:
            self._watched = stamps if self._rounding else None
            return stamps, rows
        return self._start("rounded", stamps, clock.time, np.arange(len(stamps))), rows

    def _watch(self, stamps: Array) -> Array:
        """Return further stamps, or times of a clock (s) once they are seen to be rounded.

        The steps of 333 Hz in whole milliseconds are equal until one of them is longer.
        """
        if self._watched is None:
            return stamps
        seen, before = np.append(self._watched, stamps)[-MEMORY:], float(self._watched[-1])
        self._watched, self._until_check = seen, self._until_check - len(stamps)
        if len(seen) < ENOUGH or self._until_check > 0:
            return stamps
        self._until_check, steps = ENOUGH, np.diff(seen)
        if np.min(steps) <= 0.0 or np.max(steps) > GAP * np.median(steps):
            self._watched = stamps
            return stamps
        resolution = stamp_resolution(seen)
        if resolution > 0.5 * np.min(steps):
            return stamps
        clock = sampling_clock(seen) if resolution else None
        if clock is None or not clock.resolution or clock.scatter > CLEAR * clock.step:
            self._watched = seen if len(seen) < MEMORY and resolution else None
            return stamps
        self._watched, self._rounding = None, resolution
        time = self._start("rounded", seen, clock.time, np.arange(len(seen)))[-len(stamps) :]
        least = before + MIN_ADVANCE * self.step * np.arange(1, len(time) + 1)
        time = np.maximum(time, least)
        self._newest = float(time[-1])
        return np.asarray(time)

    def _start(self, stamping: Stamping, stamps: Array, time: Array, last: IntArray) -> Array:
        """Begin a clock with approximate times (n,); return them on it (s).

        `last`: samples whose stamps determine it.
        """
        self.stamping, tick = stamping, np.arange(float(len(stamps)))
        if stamping == "rounded":
            step = float(np.median(np.diff(time)))
            tick = np.cumsum(np.append(0.0, np.maximum(np.rint(np.diff(time) / step), 1.0)))
        else:
            between = float(np.median(np.diff(stamps[last])))
            self._pause, last = max(PAUSE * between, MAX_PAUSE), last[:-1]
        self._tick, self._stamp = int(tick[-1]), float(stamps[-1])
        self._points = np.stack([tick[last], stamps[last]])
        self._fit()
        result = self._origin + self.step * tick
        self._newest = float(result[-1])
        return np.asarray(result)

    def _timed(self, stamps: Array) -> Array:
        """Return the sampling times (s) of further stamps (k,)."""
        if not len(stamps) or stamps[0] < self._stamp or (np.diff(stamps) < 0.0).any():
            return stamps  # late ones
        before = np.append(self._stamp, stamps)
        if self.stamping == "counted":
            tick = self._tick + np.arange(float(len(before)))
            ends = np.flatnonzero(np.diff(before) > (self._limit or TOGETHER * self.step))
            points = np.stack([tick[ends], before[ends]])
            self._points = np.hstack([self._points, points])
        else:
            tick = self._with_losses(stamps)
        self._points = self._points[:, -MEMORY:]
        self._tick, self._stamp = int(tick[-1]), float(stamps[-1])
        if self._stamp > self._fitted + REFIT:
            self._fit()
        least = self._newest + MIN_ADVANCE * self.step * np.arange(1, len(before))
        result = np.maximum(self._origin + self.step * tick[1:], least)
        self._newest = float(result[-1])
        return np.asarray(result)

    def _with_losses(self, stamps: Array) -> Array:
        """Return the ticks of the newest sample before, and of further stamps (k,).

        What is late may be delayed, or follow a loss, which the next samples show: the ticks of the
        last `UNDECIDED` are determined again.
        """
        (fixed, recent), known = np.split(self._points, [-UNDECIDED], axis=1), len(stamps)
        base = fixed[0, -1] if fixed.shape[1] else recent[0, 0] - 1.0
        own = np.append(recent[1], stamps)
        count = base + np.arange(1.0, len(own) + 1.0)
        tick = count + lost_ticks((own - self._origin) / self.step - count, self._scatter)
        self._points = np.hstack([fixed, np.stack([tick, own])])
        return tick[-known - 1 :]

    def _fit(self) -> None:
        """Fit a straight line to the stamps over their ticks; a stalled host counts less."""
        tick, stamp = self._points
        weight, least = np.ones(len(tick)), max(self._rounding, 1e-12)
        for _ in range(3):
            slope, origin = np.polyfit(tick - tick[-1], stamp - stamp[-1], 1, w=np.sqrt(weight))
            off = np.abs(stamp - stamp[-1] - origin - slope * (tick - tick[-1]))
            weight = 1.0 / np.maximum(1.0, off / max(3.0 * float(np.median(off)) / 0.6745, least))
        self.step, self._fitted = float(slope), float(stamp[-1])
        self._origin = float(stamp[-1] + origin - slope * tick[-1])
        self._scatter = max(0.3 * least, float(np.median(off)) / 0.6745) / slope


def _is_candidate(stamps: Array) -> bool:
    """Return whether stamps are of batches or bursts, or rounded, and in order."""
    steps = np.diff(stamps)
    if (steps < 0.0).any():
        return False
    together: BoolArray = steps <= shortest_pause(steps)
    if np.mean(together) > 0.5 * SHARE:
        return True
    distinct = stamps[np.append(True, steps > 0.0)]
    mean = float(np.mean(np.diff(distinct)))  # the median is that of rounded stamps
    return not is_even(distinct, mean) and stamp_resolution(distinct) > 0.0
