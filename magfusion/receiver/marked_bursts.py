"""Marked bursts that are not demodulated yet, and their grouping into epochs."""

import numpy as np

from magfusion.errors import InputError
from magfusion.model.marks import SILENT, Marks, SlotColumn
from magfusion.model.site import Site
from magfusion.receiver.slots import is_pulsed, places
from magfusion.units import Array, IntArray

# s; from the first to the last slot of an epoch. In half that time a head accelerated by
# 10 m/s^2 deviates by 0.2 mm from constant velocity.
MAX_EPOCH = 0.012
MAX_BURST = 1.0  # s; longer ones are split
OVERLAP = 1e-6  # s; tolerance for rounding
LATE = 0.6  # steps before a burst's end, after which no sample of it comes


class Bursts:
    """Bursts with their running numbers and epochs.

    A repeated coil begins a new epoch, as does a burst more than `MAX_EPOCH` after the first.
    """

    # What a checkpoint holds.
    marks: Marks  # stored bursts, split to at most `MAX_BURST`
    first: int  # number of the first of these
    column: SlotColumn  # slots given per sample
    _epoch: IntArray
    _epoch_bursts: list[int]
    _epoch_start: float
    _end: float
    _newest: int

    def __init__(self, site: Site) -> None:
        self._count, self._silences = places(site), is_pulsed(site)
        self._slots = sorted({s for b in site.beacons for _, s in b.tones if s is not None})
        self.marks, self.first, self.column = Marks.none(), 0, SlotColumn()
        self._epoch, self._epoch_bursts = np.zeros(0, dtype=np.int64), []
        self._epoch_start = self._end = -np.inf
        self._newest = 0

    def __len__(self) -> int:
        return len(self.marks)

    def add(self, marks: Marks) -> None:
        """Add bursts after the earlier ones.

        Raises InputError where they are not in order, or a slot has no coil.
        """
        self._check(marks)
        if len(marks) == 0:
            return
        self._end = float(marks.end[-1])
        if not self._silences:  # with a carrier they determine nothing
            marks = marks.rows(marks.slot != SILENT)
        marks = _in_pieces(marks)
        epochs = [self._epoch_of(*one) for one in zip(marks.slot, _centres(marks), strict=True)]
        self._epoch = np.append(self._epoch, np.array(epochs, dtype=np.int64))
        self.marks = self.marks.joined(marks)

    def _check(self, marks: Marks) -> None:
        known = np.isin(marks.slot, [*self._slots, SILENT])
        if not np.all(known):
            k = int(np.argmin(known))
            slots = ", ".join(map(str, self._slots))
            raise InputError(
                f"marks: slot {marks.slot[k]} at {marks.begin[k]:.6f} s is of no coil; the site's"
                f" coils have {slots}; write {SILENT} where none is driven"
            )
        before = np.append(self._end, marks.end)[:-1]
        misaligned = (marks.end <= marks.begin) | (marks.begin < before - OVERLAP)
        if np.any(misaligned):
            k = int(np.argmax(misaligned))
            raise InputError(
                f"marks: the burst from {marks.begin[k]:.6f} to {marks.end[k]:.6f} s does not"
                f" follow the one that ends at {before[k]:.6f} s; give bursts in order of time that"
                " do not overlap"
            )

    def _epoch_of(self, slot: int, centre: float) -> int:
        """Return the epoch of the next burst; a silent one has that of the burst before."""
        if slot == SILENT:
            return self._newest
        if (
            not self._epoch_bursts
            or slot in self._epoch_bursts
            or centre - self._epoch_start > MAX_EPOCH
        ):
            self._newest, self._epoch_bursts, self._epoch_start = (
                self._newest + 1,
                [],
                float(centre),
            )
        self._epoch_bursts.append(int(slot))
        return self._newest

    @property
    def numbers(self) -> IntArray:
        """Number of each burst."""
        return self.first + np.arange(len(self))

    def next_centre(self, number: int) -> float:
        """Return the middle of a burst (s); of a future one, its earliest begin."""
        row = number - self.first
        if row < 0:
            return float(self.marks.begin[0]) - MAX_BURST if len(self) else -np.inf
        return float(_centres(self.marks)[row]) if row < len(self) else self._end

    def epochs(self, number: IntArray) -> IntArray:
        """Return the epoch of each burst."""
        return self._epoch[number - self.first]

    def last(self, until: float, next_number: int) -> int:
        """Return the number of the last burst whose epoch is complete at a time (s).

        `next_number`: first burst not returned yet.
        """
        begin = max(next_number - self.first, 0)
        own = slice(begin, None)
        full = len(self._epoch_bursts) == len(self._slots)
        closed = (self._epoch[own] < self._newest) | full | (self.marks.slot[own] == SILENT)
        waiting = np.flatnonzero(~closed | (self.marks.end[own] > until))
        if len(waiting) == 0:
            return self.first + len(self) - 1
        epoch = int(np.searchsorted(self._epoch, self._epoch[begin + waiting[0]]))
        return self.first + max(epoch, begin) - 1

    def first_after(self, time: float) -> int:
        """Return the number of the first burst that begins at or after a time (s)."""
        return self.first + int(np.searchsorted(self.marks.begin, time))

    def until(self, time: float) -> int:
        """Return the number of the last burst that ends at or before a time (s)."""
        return self.first + int(np.searchsorted(self.marks.end, time, side="right")) - 1

    def rows(self, number: IntArray) -> tuple[Marks, Array, IntArray]:
        """Return bursts by number, with their middle (s) and place in a cycle."""
        result = self.marks.rows(number - self.first)
        return result, _centres(result), result.slot % self._count

    def discard_before(self, number: int) -> None:
        """Discard the bursts before a number."""
        elapsed = min(max(number - self.first, 0), len(self))
        self.marks, self._epoch = self.marks.rows(slice(elapsed, None)), self._epoch[elapsed:]
        self.first += elapsed


def _centres(marks: Marks) -> Array:
    return np.asarray(0.5 * (marks.begin + marks.end))


def _in_pieces(marks: Marks) -> Marks:
    """Split bursts so that none is longer than `MAX_BURST`."""
    length = marks.end - marks.begin
    pieces = np.maximum(np.ceil(length / MAX_BURST - 1e-9), 1.0).astype(np.int64)
    if np.all(pieces == 1):
        return marks
    row = np.repeat(np.arange(len(marks)), pieces)
    place = np.arange(len(row)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    begin = marks.begin[row] + MAX_BURST * place
    return Marks(begin, np.minimum(begin + MAX_BURST, marks.end[row]), marks.slot[row])
