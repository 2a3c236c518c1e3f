"""Bursts of a multiplexer: times at which coils were driven, recorded by their driver."""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array, BoolArray, IntArray

SILENT = -1  # slot of a time without a driven coil
UNKNOWN_SLOT = -2  # slot of samples to ignore, while the current settles


@dataclass(frozen=True, eq=False)
class Marks:
    """Bursts in order of time, without overlap."""

    # begin, end: (n,), on the clock of the waveform, seconds since the log's epoch
    begin: Array
    end: Array
    slot: IntArray  # (n,), slot of the driven coils; `SILENT` for none

    def __len__(self) -> int:
        return len(self.slot)

    @staticmethod
    def none() -> "Marks":
        """Return an empty set of bursts."""
        return Marks(np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.int64))

    def rows(self, kept: BoolArray | IntArray | slice) -> "Marks":
        """Return a subset of the bursts."""
        return Marks(self.begin[kept], self.end[kept], self.slot[kept])

    def joined(self, later: "Marks") -> "Marks":
        """Return these and later bursts."""
        pairs = zip(vars(self).values(), vars(later).values(), strict=True)
        return Marks(*(np.concatenate(pair) for pair in pairs))

    def on_clock(self, stamps: Array, time: Array) -> "Marks":
        """Return the bursts on another clock, given both stamps and times of the samples (s)."""
        return Marks(_moved(self.begin, stamps, time), _moved(self.end, stamps, time), self.slot)


def _moved(edge: Array, stamps: Array, time: Array) -> Array:
    inside = np.interp(edge, stamps, time)
    before, after = np.minimum(edge - stamps[0], 0.0), np.maximum(edge - stamps[-1], 0.0)
    return np.asarray(inside + before + after)


class SlotColumn:
    """Bursts from the slots given per sample, in pieces of any size.

    A burst is complete when a sample of another slot follows.  It begins and ends half a step
    outside its samples.
    """

    # Part of a checkpoint: state of the current run.
    _first: float
    _last: float
    _before: float  # time of the sample before it
    _slot: int
    _count: int

    def __init__(self) -> None:
        self._first = self._last = self._before = -np.inf
        self._slot, self._count = UNKNOWN_SLOT, 0

    def add_samples(self, time: Array, slot: IntArray) -> Marks:
        """Return the bursts completed by samples; samples not later than earlier ones are skipped.

        `slot` (n,): of each sample; `UNKNOWN_SLOT` for samples to ignore.
        """
        newest = np.maximum.accumulate(np.append(self._last, time))
        later = time > newest[:-1]
        time, slot = time[later], slot[later]
        if len(time) == 0:
            return Marks.none()
        starts = np.flatnonzero(np.diff(slot, prepend=self._slot) != 0)
        result: list[tuple[float, float, int]] = []
        ends = np.append(starts, len(time))
        if ends[0] > 0:  # the current run continues
            self._last, self._count = float(time[ends[0] - 1]), self._count + int(ends[0])
        for first, last in zip(starts.tolist(), ends[1:].tolist(), strict=True):
            result += self._closed(float(time[first]))
            self._before = self._last
            self._first, self._last = float(time[first]), float(time[last - 1])
            self._slot, self._count = int(slot[first]), last - first
        return _marks(result)

    def ended(self) -> Marks:
        """Return the current burst, if no sample follows."""
        return _marks(self._closed(np.inf))

    def _closed(self, following: float) -> list[tuple[float, float, int]]:
        if self._slot == UNKNOWN_SLOT or self._count < 2:
            return []
        half = 0.5 * (self._last - self._first) / (self._count - 1)
        begin = self._first - min(half, 0.5 * (self._first - self._before))
        return [(begin, self._last + min(half, 0.5 * (following - self._last)), self._slot)]


def _marks(result: list[tuple[float, float, int]]) -> Marks:
    if not result:
        return Marks.none()
    begin, end, slot = zip(*result, strict=True)
    return Marks(np.array(begin), np.array(end), np.array(slot, dtype=np.int64))


def marks_of_column(time: Array, slot: IntArray) -> Marks:
    """Return the bursts from the slot of each sample of a waveform."""
    column = SlotColumn()
    return column.add_samples(time, slot).joined(column.ended())
