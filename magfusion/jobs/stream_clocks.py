"""Clocks of the records in a pipe: counters are unwrapped, steps are found."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, TextIO

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.stream_buffer import MAX_JUMP
from magfusion.files.records import Record
from magfusion.files.standard_streams import write_message
from magfusion.files.stream import NumberedRecord
from magfusion.model.counters import NEAR_END, lost_by_wrapping
from magfusion.units import Array

MIN_STEP = 1.0  # s back; a network delays a record by less
NEW_CLOCK = 10.0  # s of data, all before a checkpoint, are of a clock that began again


class ClockJump(InputError):
    """Stamps of a record that are far from all others."""


class ClockStep(NamedTuple):
    """Step of a stream's clock: when on the new one, and by how much (s)."""

    stream: str
    time: float
    seconds: float

    @property
    def sentence(self) -> str:
        """Return what is reported of it."""
        return (
            f"{self.stream}: its clock stepped by {self.seconds:+.4g} s; navigation restarts at"
            f" {self.time:.3f} s"
        )


@dataclass
class _Clock:
    """Clock of a stream (s): the last stamp, the newest accepted one, and one far from it.

    Of records in a row that are behind the newest stamp it has the number, and by how much the
    first is.
    """

    last_stamp: float = -np.inf
    newest: float = -np.inf
    wrapped: float = 0.0
    unconfirmed: float | None = None
    behind: int = 0
    back: float = 0.0


class StreamClocks:
    """Clocks of the streams of a pipe.

    `delay`: largest delay of samples that are still sorted in (s). `last`, `wrapped`: of a resumed
    run, the last stamp (s) before it, and what counters had lost by wrapping.
    """

    def __init__(self, delay: float, last: float = -np.inf, wrapped: float = 0.0) -> None:
        self._least, self._delay = max(MIN_STEP, 2.0 * delay), delay
        self._clocks: dict[str, _Clock] = {}
        self._resumed = _Clock(last_stamp=last, wrapped=wrapped)

    def reset(self) -> None:
        """Discard all stamps before, of a clock that began again."""
        self._clocks, self._resumed = {}, _Clock()

    @property
    def wrapped(self) -> float:
        """What the counters have lost by wrapping (s)."""
        return max((one.wrapped for one in self._clocks.values()), default=self._resumed.wrapped)

    def all_unwrapped(self, records: Iterable[NumberedRecord]) -> Iterator[NumberedRecord]:
        """Yield records as `unwrapped`."""
        for one in records:
            yield one if one.record is None else replace(one, record=self.unwrapped(one.record))

    def unwrapped(self, record: Record) -> Record:
        """Return a record whose stamps go on where a counter began again."""
        changed = {}
        for kind in type(record).model_fields:
            part = getattr(record, kind)
            names = [name for name in ("time", "start", "end") if hasattr(part, name)]
            if not names or not np.size(getattr(part, names[0])):
                continue
            times = np.atleast_1d(getattr(part, names[0]))
            wrapped = self._wrapped(_name(record, kind), times)
            if np.any(wrapped):
                missing = wrapped if np.ndim(getattr(part, names[0])) else float(wrapped[0])
                stamps = {name: getattr(part, name) + missing for name in names}
                changed[kind] = part.model_copy(update=stamps)
        return record.model_copy(update=changed) if changed else record

    def _wrapped(self, name: str, times: Array) -> Array:
        """Return what a stream's counter has lost by wrapping (s), at each of its stamps."""
        new, clock = name not in self._clocks, self._of(name)
        if new:  # the counter is that of the other streams
            other = max(self._clocks.values(), key=lambda one: one.last_stamp)
            clock.last_stamp, clock.wrapped = other.last_stamp, other.wrapped
        near = MAX_JUMP if new else NEAR_END
        missing = lost_by_wrapping(times, clock.last_stamp - clock.wrapped, clock.wrapped, near)
        clock.last_stamp, clock.wrapped = float(times[-1] + missing[-1]), float(missing[-1])
        return missing

    def step_in(self, record: Record) -> ClockStep | None:
        """Return the step of a stream's clock: it is seen in the second record after it."""
        for name, times in _streams(record):
            clock, first = self._of(name), float(times[0])
            follows = clock.unconfirmed is not None and 0.0 <= first - clock.unconfirmed < MAX_JUMP
            if follows and self._is_far(clock, times):
                seen = clock.newest if clock.newest > -np.inf else self._newest
                step = ClockStep(name, first, first - seen)
                self._resumed = _Clock()
                self._clocks = {
                    name: _Clock(last_stamp=one.last_stamp, wrapped=one.wrapped)
                    for name, one in self._clocks.items()
                }
                return step
        return None

    def set_back(self, record: Record) -> Iterator[str]:
        """Yield a sentence of each stream of which records in a row are too old to be used.

        It is reported at the second: a single one is late, or was sent twice.
        """
        for name, times in _streams(record):
            clock = self._of(name)
            if not clock.newest - float(np.max(times)) > self._delay or self._is_far(clock, times):
                clock.behind = 0
                continue
            clock.behind += 1
            if clock.behind == 1:
                clock.back = clock.newest - float(times[0])
            elif clock.behind == 2:
                yield (
                    f"{name}: its stamps go back by {clock.back:.3g} s; samples before"
                    f" {clock.newest:.3f} s are left out. The clock stepped back (restart the"
                    " run), or records are late (increase --delay) or sent twice"
                )

    def check(self, record: Record) -> None:
        """Note the stamps of a record.

        Raises InputError where they are far from those before: the record is an error of its own,
        or the first after a step.
        """
        for name, times in _streams(record):
            clock, last = self._of(name), float(np.max(times))
            if not self._is_far(clock, times):
                clock.unconfirmed, clock.newest = None, max(clock.newest, last)
                continue
            clock.unconfirmed = last
            way, seen = ("back", clock.newest) if last < clock.newest else ("ahead", self._newest)
            by = abs(last - seen)
            raise ClockJump(f"{name}: its clock jumped {way} by {by:.4g} s; the record is left out")

    def _of(self, name: str) -> _Clock:
        return self._clocks.setdefault(name, replace(self._resumed))

    @property
    def _newest(self) -> float:
        newest = max((known.newest for known in self._clocks.values()), default=-np.inf)
        return max(newest, self._resumed.last_stamp)

    def _is_far(self, clock: _Clock, times: Array) -> bool:
        """Return whether all stamps are behind the newest, or ahead of those of all streams."""
        behind = float(np.max(times)) < clock.newest - self._least
        return behind or -np.inf < self._newest < float(np.min(times)) - MAX_JUMP


class OlderRecords:
    """Records before a checkpoint, with which the stream of a resumed run may begin.

    `until`: time of the checkpoint (s); infinitely early without one. `restart`: called where a
    clock began again: records of `NEW_CLOCK` seconds are far before it.
    """

    def __init__(self, until: float, restart: Callable[[], None]) -> None:
        self._until, self._restart, self.count = until, restart, 0
        self._newest, self._span = -np.inf, 0.0

    def skipped(
        self, records: Iterable[NumberedRecord], messages: TextIO
    ) -> Iterator[NumberedRecord]:
        """Yield the other records, and count these; report the first."""
        for numbered in records:
            if not self._contains(numbered.record):
                yield numbered
                continue
            self.count += 1
            if self.count == 1:
                at = f"{self._until:.3f} s"
                write_message(
                    messages,
                    f"data before the checkpoint ({at}) are not used; if the clock began again, run"
                    f" without --resume, or wait {NEW_CLOCK:.0f} s",
                )
            if self._span > NEW_CLOCK:
                self._until = -np.inf
                write_message(
                    messages,
                    f"the clock began again; navigation restarts at {self._newest:.3f} s, without"
                    " the state of the checkpoint",
                )
                self._restart()

    def _contains(self, record: Record | None) -> bool:
        """Return whether a record is one of them; the first newer one ends them."""
        streams = () if record is None else _streams(record)
        newest = max((float(np.max(times)) for _, times in streams), default=-np.inf)
        if newest >= self._until:
            self._until = -np.inf
        older = -np.inf < newest < self._until
        if older:
            step = newest - self._newest
            far = newest < self._until - MAX_JUMP
            single = not abs(step) < MAX_JUMP
            self._span = self._span + max(step, 0.0) if far and not single else 0.0
            self._newest = newest if single else max(newest, self._newest)
        return older

    def report(self, messages: TextIO) -> None:
        """Write how many there were."""
        if self.count:
            write_message(messages, f"{self.count} records before the checkpoint are not used")


def _streams(record: Record) -> Iterator[tuple[str, Array]]:
    """Yield name and stamps of the measurements in a record."""
    for kind in ("imu", "magnetometer", "fields"):
        part = getattr(record, kind)
        if part is not None and np.size(part.time):
            yield _name(record, kind), np.atleast_1d(part.time)


def _name(record: Record, kind: str) -> str:
    """Return the stream of a part of a record: of several magnetometers each has its own."""
    own = getattr(getattr(record, kind), "magnetometer", None)
    return kind if own is None else f"{kind} {own}"
