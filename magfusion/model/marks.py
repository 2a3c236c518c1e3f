"""Bursts of a multiplexer: when which coil was driven, as whoever switched it wrote down."""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array, BoolArray, IntArray

SILENT = -1  # the slot of a stretch in which no coil is driven
UNTOLD = -2  # of samples of which nothing is said: the current settles


@dataclass(frozen=True, eq=False)
class Marks:
    """Bursts in order of time, which do not overlap.

    Parameters
    ----------
    begin, end : ndarray, shape (n,)
        On the clock of the waveform, seconds since the log's epoch.
    slot : int ndarray, shape (n,)
        Of the coils that are driven; `SILENT` where none is.
    """

    begin: Array
    end: Array
    slot: IntArray

    def __len__(self) -> int:
        return len(self.slot)

    @staticmethod
    def none() -> "Marks":
        """Return no burst."""
        return Marks(np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.int64))

    def rows(self, kept: BoolArray | IntArray | slice) -> "Marks":
        """Return some bursts."""
        return Marks(self.begin[kept], self.end[kept], self.slot[kept])

    def joined(self, later: "Marks") -> "Marks":
        """Return these and later ones."""
        pairs = zip(vars(self).values(), vars(later).values(), strict=True)
        return Marks(*(np.concatenate(pair) for pair in pairs))

    def on_clock(self, stamps: Array, time: Array) -> "Marks":
        """Return the bursts where the samples' stamps are replaced by other times (s)."""
        return Marks(_moved(self.begin, stamps, time), _moved(self.end, stamps, time), self.slot)


def _moved(edge: Array, stamps: Array, time: Array) -> Array:
    inside = np.interp(edge, stamps, time)
    before, after = np.minimum(edge - stamps[0], 0.0), np.maximum(edge - stamps[-1], 0.0)
    return np.asarray(inside + before + after)


class SlotColumn:
    """Bursts of the slots that stand beside samples, in whatever pieces these come.

    A burst is told when a sample of another slot follows it.  It begins and ends half a step
    outside its samples.
    """

    # What a checkpoint holds: of the run that is still open.
    _first: float
    _last: float
    _before: float  # the sample before it
    _slot: int
    _count: int

    def __init__(self) -> None:
        self._first = self._last = self._before = -np.inf
        self._slot, self._count = UNTOLD, 0

    @property
    def open_since(self) -> float:
        """When the run that is still open began (s)."""
        return self._first

    def hear(self, time: Array, slot: IntArray) -> Marks:
        """Return the bursts that samples end; those that are not later than before are passed over.

        Parameters
        ----------
        slot : int ndarray, shape (n,)
            Of each sample; `UNTOLD` where nothing is said.
        """
        newest = np.maximum.accumulate(np.append(self._last, time))
        later = time > newest[:-1]
        time, slot = time[later], slot[later]
        if len(time) == 0:
            return Marks.none()
        starts = np.flatnonzero(np.diff(slot, prepend=self._slot) != 0)
        found: list[tuple[float, float, int]] = []
        ends = np.append(starts, len(time))
        if ends[0] > 0:  # the open run goes on
            self._last, self._count = float(time[ends[0] - 1]), self._count + int(ends[0])
        for first, last in zip(starts.tolist(), ends[1:].tolist(), strict=True):
            found += self._closed(float(time[first]))
            self._before = self._last
            self._first, self._last = float(time[first]), float(time[last - 1])
            self._slot, self._count = int(slot[first]), last - first
        return _marks(found)

    def ended(self) -> Marks:
        """Return the burst that is still open, where no sample follows."""
        return _marks(self._closed(np.inf))

    def _closed(self, following: float) -> list[tuple[float, float, int]]:
        if self._slot == UNTOLD or self._count < 2:
            return []
        half = 0.5 * (self._last - self._first) / (self._count - 1)
        begin = self._first - min(half, 0.5 * (self._first - self._before))
        return [(begin, self._last + min(half, 0.5 * (following - self._last)), self._slot)]


def _marks(found: list[tuple[float, float, int]]) -> Marks:
    if not found:
        return Marks.none()
    begin, end, slot = zip(*found, strict=True)
    return Marks(np.array(begin), np.array(end), np.array(slot, dtype=np.int64))


def marks_of_column(time: Array, slot: IntArray) -> Marks:
    """Return the bursts of the slots that stand beside all samples of a waveform."""
    column = SlotColumn()
    return column.hear(time, slot).joined(column.ended())
