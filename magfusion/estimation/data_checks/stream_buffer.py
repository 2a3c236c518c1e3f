"""Input buffers: samples that are not processed yet, sorted by time, and their clock check."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from magfusion.errors import InputError
from magfusion.units import Array

MAX_JUMP = 60.0  # s; a stamp farther from the newest of all streams means a clock jump


def check_clock(name: str, time: Array, newest: float) -> None:
    """Reject samples after a clock jump, forward or back, or with one among them.

    `name`: of the stream. `time` (k,). `newest`: newest stamp of all streams (s): a stream that
    paused for long has not jumped; before any stamp minus infinity.
    """
    if len(time) == 0:
        return
    newest = float(time.min()) if newest == -np.inf else newest
    if time.min() >= newest - MAX_JUMP and time.max() <= newest + MAX_JUMP:
        return  # the usual case
    stamps = np.sort(np.append(time, newest))
    steps = np.diff(stamps)
    k = int(np.argmax(steps))
    if steps[k] > MAX_JUMP:
        way = "back" if stamps[k] < newest else "ahead"
        raise InputError(
            f"{name}: its clock jumped {way} by {steps[k]:.4g} s at {newest:.3f} s."
            " Start a new navigator, or correct the clock"
        )


@dataclass(eq=False)
class _Room:
    """Storage of samples, with its end."""

    time: Array
    rows: Array
    end: int


class Buffer:
    """One stream, sorted by time: stamps with rows of numbers.

    `name`: of the stream, for error messages. `width`: numbers per row.
    """

    newest: float
    closed_until: float
    late: int
    _time: Array
    _rows: Array

    def __init__(self, name: str, width: int) -> None:
        self.name, self.width = name, width
        self._time, self._rows = np.empty(0), np.empty((0, width))
        self._room: _Room | None = None
        self._waiting: deque[tuple[Array, Array]] = deque()
        self.newest = -np.inf
        self.closed_until = -np.inf
        self.late = 0

    def add(self, time: Array, rows: Array) -> None:
        """Insert samples, in any order but not before the settled time.

        Raises InputError if a number is not finite.
        """
        if not (np.isfinite(time).all() and np.isfinite(rows).all()):
            raise InputError(f"{self.name}: a sample is not finite; drop it from the stream")
        if len(time) == 0:
            return
        fresh = time > self.closed_until
        if fresh.all():
            self._waiting.append((time.copy(), rows.copy()))
        else:
            self.late += int(np.sum(~fresh))
            self._waiting.append((time[fresh], rows[fresh]))
        self.newest = max(self.newest, float(time.max()))

    def leave_out(self, after: float, until: float) -> int:
        """Drop the samples after a time and up to another (s); return how many."""
        time, rows = self.rows()
        kept = (time <= after) | (time > until)
        self._time, self._rows = time[kept], rows[kept]
        return int(np.sum(~kept))

    def rows(self) -> tuple[Array, Array]:
        """Return all samples, sorted by time; of equal stamps the first."""
        if self._waiting:
            time, rows = self._waiting[0]
            if len(self._waiting) > 1:
                time = np.concatenate([t for t, _ in self._waiting])
                rows = np.concatenate([r for _, r in self._waiting])
            self._waiting.clear()
            if self._follows(time):
                self._append(time, rows)
                return self._time, self._rows
            time = np.concatenate([self._time, time])
            time, first = np.unique(time, return_index=True)
            rows = np.concatenate([self._rows, rows])
            self.late += len(rows) - len(first)
            self._time, self._rows = time, rows[first]
        return self._time, self._rows

    def _follows(self, time: Array) -> bool:
        """Return whether stamps are sorted and newer than all stored ones."""
        if len(self._time) and len(time) and time[0] <= self._time[-1]:
            return False
        return bool((time[1:] > time[:-1]).all())

    def _append(self, time: Array, rows: Array) -> None:
        """Append newer samples; the stored ones are copied only now and then."""
        kept, more, room = len(self._time), len(time), self._room
        if room is None or self._time.base is not room.time or room.end + more > len(room.time):
            size = 2 * (kept + more)
            room = self._room = _Room(np.empty(size), np.empty((size, self.width)), kept)
            room.time[:kept], room.rows[:kept] = self._time, self._rows
        begin, end = room.end, room.end + more
        room.time[begin:end], room.rows[begin:end] = time, rows
        self._time, self._rows = room.time[begin - kept : end], room.rows[begin - kept : end]
        room.end = end

    def between(self, begin: float, end: float) -> tuple[Array, Array]:
        """Return the samples of an interval, with the neighbours just outside it."""
        time, rows = self.rows()
        lo = max(int(time.searchsorted(begin, side="right")) - 1, 0)
        hi = min(int(time.searchsorted(end)) + 1, len(time))
        return time[lo:hi], rows[lo:hi]

    def discard_before(self, before: float, closed_until: float) -> None:
        """Drop older samples except the last; reject later those before the settled time."""
        time, rows = self.rows()
        lo = max(int(time.searchsorted(before, side="right")) - 1, 0)
        self._time, self._rows = time[lo:], rows[lo:]
        self.closed_until = max(self.closed_until, closed_until)

    def __len__(self) -> int:
        return len(self.rows()[0])
