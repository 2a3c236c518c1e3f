"""Rules that decide which windows of a waveform are demodulated, for whole logs and for pieces.

A window is assessed once, when it is complete, from the samples up to then.  A log therefore drops
the same windows whether it is read at once or streamed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import Waveform
from magfusion.receiver.range_ends import RangeEnds, at_declared_range, saturated, still
from magfusion.units import Array, BoolArray, IntArray

MAGNETOMETER_GAP = "gap in the magnetometer stream"
TOO_FEW = "too few samples"
STILL = "magnetometer stands still"
SATURATED = "magnetometer saturated"
NO_INERTIAL = "no inertial data"
INERTIAL_GAP = "gap in the inertial stream"
REASONS = (MAGNETOMETER_GAP, TOO_FEW, STILL, SATURATED, NO_INERTIAL, INERTIAL_GAP)

MAX_GROWTH = 4.0  # largest growth of a phasor's variance by missing samples
MAX_GAP = 0.02  # s; of inertial samples: the motion between is a straight line
MAX_UNCOVERED_STEPS = 0.6  # steps before a window's end after which no inertial sample is needed
ROUNDING = 1e-6  # of a step; tolerance for rounding of a window's limits


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of a waveform that can be demodulated."""

    number: IntArray  # (n,), running number on the grid
    centre: Array  # (n,) (s)
    # first, count: (n,), samples of each window
    first: IntArray
    count: IntArray
    length: Array  # (n,) (s)
    place: IntArray  # (n,), place in a cycle of slots; zero for windows of one kind

    def __len__(self) -> int:
        return len(self.number)

    def rows(self, kept: BoolArray | IntArray | slice) -> "Windows":
        """Return a subset of the windows."""
        return Windows(*(part[kept] for part in vars(self).values()))

    def joined(self, others: "Windows") -> "Windows":
        """Return these windows and others of the same grid, in order."""
        rows = zip(vars(self).values(), vars(others).values(), strict=True)
        both = Windows(*(np.concatenate(pair) for pair in rows))
        return both.rows(np.argsort(both.number))

    @staticmethod
    def none() -> "Windows":
        """Return no windows."""
        whole = np.zeros(0, dtype=np.int64)
        return Windows(whole, np.zeros(0), whole, whole, np.zeros(0), whole)


@dataclass(frozen=True)
class WindowGrid:
    """Windows of one length at a fixed step."""

    centre: float  # centre of window 0 (s)
    # step, length (s)
    step: float
    length: float
    # time from the start of the first sample's interval to the start of the window (s)
    early: float = 0.0
    rounding: float = 0.0  # tolerance by which a time stamp may precede its window (s)
    wait: float = 0.0  # time after a window's end until its last sample has certainly arrived (s)
    together: int = 1  # windows assessed at once, when the last of them is complete

    def last(self, until: float) -> int:
        """Return the number of the last window that can be assessed at a time (s)."""
        complete = self.centre + self.length / 2.0 + self.wait
        number = int(np.floor((until - complete) / self.step + ROUNDING))
        return (number + 1) // self.together * self.together - 1

    def last_of_log(self, time: Array, sample_step: float) -> int:
        """Return the number of the last window that the samples of a whole log fill."""
        # The last sample covers the interval up to the next one, as every sample does.
        end = time[-1] + 0.5 * sample_step + self.early - self.length / 2.0
        return int(np.floor((end - self.centre) / self.step + ROUNDING))

    def windows(self, number: IntArray, time: Array) -> Windows:
        """Return windows by number, with their samples among these times."""
        centre = np.asarray(self.centre + self.step * number, dtype=np.float64)
        half = self.length / 2.0
        first = np.searchsorted(time, centre - half - self.rounding)
        last = np.searchsorted(time, centre + half - self.rounding)
        length = np.full(len(number), self.length)
        return Windows(number, centre, first, last - first, length, number % self.together)


def usual_step(time: Array, stream: str) -> float:
    """Return the median time between two samples (s).

    Raises InputError where there are less than two samples.
    """
    if len(time) < 2:
        raise InputError(f"{stream}: found {len(time)} samples; record at least one window")
    return float(np.median(np.diff(time)))


def sample_rate_hz(waveform: Waveform) -> float:
    """Return the median sampling rate (Hz).

    Raises InputError where there are less than two samples.
    """
    return 1.0 / usual_step(waveform.time, "magnetometer")


Growth = Callable[[Windows, Array], Array]


@dataclass(eq=False)
class Admission:
    """Rules by which windows are admitted, applied in the order of their numbers."""

    # magnetometer_step, imu_step: usual time between two samples (s)
    magnetometer_step: float
    imu_step: float
    imu_begin: float  # time of the first inertial sample (s)
    imu_margin: float  # how far a window may reach beyond the inertial samples (s)
    clips: bool  # whether a constant extreme is saturation
    # whether a window without inertial samples is dropped; otherwise its noise is larger
    needs_turn: bool
    least_share: float  # least share of its nominal samples that a window must hold
    slack: int = 0  # samples by which windows may be offset from the sampling
    # range of each axis as observed so far
    ends: tuple[RangeEnds, ...] = field(default_factory=lambda: tuple(RangeEnds() for _ in "xyz"))

    def verdicts(
        self,
        grid: WindowGrid,
        windows: Windows,
        waveform: Waveform,
        imu_time: Array,
        growth: Growth,
        field_range: float,
    ) -> IntArray:
        """Return the reason to drop each window, an index into `REASONS`; -1 for none.

        Parameters
        ----------
        windows : Windows
            Those after the windows assessed last.
        waveform : Waveform
            With all samples of these windows and since those before.
        imu_time : ndarray
            On the clock of the waveform (s), likewise.
        growth : callable
            Takes windows with missing samples and the times of all samples; returns the variance of
            their phasors relative to a whole window.
        field_range : float
            Of the magnetometer, as declared (T).
        """
        half = windows.length / 2.0 + grid.early
        begin, end = windows.centre - half, windows.centre + windows.length / 2.0 - grid.early
        result = np.full(len(windows), -1)

        def drop(reason: str, corrupted: BoolArray) -> None:
            result[(result < 0) & corrupted] = REASONS.index(reason)

        time, step = waveform.time, self.magnetometer_step
        gap = (time[1:] - time[:-1] > 1.5 * step).nonzero()[0]
        # From just before the first missing sample to just after the last.
        lacking = meets(time[gap] + 0.75 * step, time[gap + 1] - 0.75 * step, begin, end)
        few = (windows.count + self.slack) * step < self.least_share * windows.length
        requested = lacking & ~few
        if requested.any():
            lacking[requested] = growth(windows.rows(requested), time) > MAX_GROWTH
        drop(MAGNETOMETER_GAP, lacking)
        drop(TOO_FEW, few)
        last = windows.first + windows.count
        drop(SATURATED, at_declared_range(waveform, windows.first, last, field_range))
        if self.clips:
            drop(STILL, still(waveform, windows.first, last))
            drop(SATURATED, saturated(waveform, windows.first, last, self.ends))
        drop(NO_INERTIAL, begin < self.imu_begin - self.imu_margin)
        if self.needs_turn:
            silence = silences(imu_time, self.imu_step, self.imu_margin)
            drop(INERTIAL_GAP, meets(*silence, begin, end - MAX_UNCOVERED_STEPS * step))
        return result


_NEVER = np.array([np.inf])


def longest_step(step: float) -> float:
    """Return the longest time between two inertial samples that is no gap, of the usual one (s)."""
    return max(3.0 * step, MAX_GAP)


def silences(imu_time: Array, step: float, margin: float) -> tuple[Array, Array]:
    """Return begin and end of each gap of an inertial stream; the last follows its end (s).

    `step`, `margin`: as of `Admission` (s).
    """
    gap = (imu_time[1:] - imu_time[:-1] > longest_step(step)).nonzero()[0]
    begin = np.concatenate([imu_time[gap], imu_time[-1:] + margin])
    return begin, np.concatenate([imu_time[gap + 1], _NEVER])


def meets_silence(
    windows: Windows, length: float, step: float, silence: tuple[Array, Array]
) -> BoolArray:
    """Return which windows of a length (s) lack inertial samples.

    `step`: usual time between two samples of the magnetometer (s). `silence`: as from `silences`.
    """
    begin, end = windows.centre - length / 2.0, windows.centre + length / 2.0
    return meets(*silence, begin, end - MAX_UNCOVERED_STEPS * step)


def meets(begin: Array, end: Array, span_begin: Array, span_end: Array) -> BoolArray:
    """Return which spans overlap any of the sorted, disjoint stretches (s)."""
    return np.asarray(begin.searchsorted(span_end) > end.searchsorted(span_begin))
