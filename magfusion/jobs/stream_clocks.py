"""Clocks of the records in a pipe: counters of 32 bits are unwrapped, steps are found."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.stream_buffer import LARGEST_JUMP
from magfusion.files.stream import Record
from magfusion.units import Array

LEAST_STEP = 1.0  # s back; a network delays a record by less
PERIODS = (2.0**32 * 1e-6, 2.0**32 * 1e-3)  # s; of counters of microseconds and milliseconds
NEAR_END = 1.0  # s; of a counter's period, before and after it wraps


class ClockJump(InputError):
    """Stamps of a record that are far from all others."""


class ClockStep(NamedTuple):
    """Step of a stream's clock: when on the new one, and by how much (s)."""

    stream: str
    time: float
    seconds: float


@dataclass
class _Clock:
    newest: float = -np.inf
    wrapped: float = 0.0
    unconfirmed: float | None = None


class StreamClocks:
    """Clocks of the streams of a pipe.

    Parameters
    ----------
    delay : float
        Largest delay of samples that are still sorted in (s).
    """

    def __init__(self, delay: float) -> None:
        self._least = max(LEAST_STEP, 2.0 * delay)
        self._clocks: dict[str, _Clock] = {}

    def unwrapped(self, record: Record) -> Record:
        """Return a record whose stamps go on where a counter of 32 bits began again."""
        changed = {}
        for name, kind, times in _streams(record):
            clock = self._of(name)
            first = float(times[0]) + clock.wrapped
            for period in PERIODS:
                near = abs((clock.newest + 0.5 * period) % period - 0.5 * period) < NEAR_END
                if near and abs(first - clock.newest + period) < 2.0 * NEAR_END:
                    clock.wrapped += period
            if clock.wrapped:
                part = getattr(record, kind)
                changed[kind] = part.model_copy(update={"time": part.time + clock.wrapped})
        return record.model_copy(update=changed) if changed else record

    def step_in(self, record: Record) -> ClockStep | None:
        """Return the step of a stream's clock: it is seen in the second record after it."""
        for name, _, times in _streams(record):
            clock, first = self._of(name), float(times[0])
            follows = (
                clock.unconfirmed is not None and 0.0 <= first - clock.unconfirmed < LARGEST_JUMP
            )
            if follows and self._is_far(clock, times):
                step = ClockStep(name, first, first - clock.newest)
                self._clocks.clear()
                return step
        return None

    def check(self, record: Record) -> None:
        """Note the stamps of a record.

        Raises
        ------
        InputError
            Where they are far from those before: the record is an error of its own, or the first
            after a step.
        """
        for name, _, times in _streams(record):
            clock, last = self._of(name), float(np.max(times))
            if not self._is_far(clock, times):
                clock.unconfirmed, clock.newest = None, max(clock.newest, last)
                continue
            clock.unconfirmed = last
            way, seen = ("back", clock.newest) if last < clock.newest else ("ahead", self._newest)
            by = abs(last - seen)
            raise ClockJump(f"{name}: its clock jumped {way} by {by:.4g} s; the record is left out")

    def _of(self, name: str) -> _Clock:
        return self._clocks.setdefault(name, _Clock())

    @property
    def _newest(self) -> float:
        return max((known.newest for known in self._clocks.values()), default=-np.inf)

    def _is_far(self, clock: _Clock, times: Array) -> bool:
        """Return whether all stamps are behind the newest, or ahead of those of all streams."""
        behind = float(np.max(times)) < clock.newest - self._least
        return behind or -np.inf < self._newest < float(np.min(times)) - LARGEST_JUMP


def _streams(record: Record) -> Iterator[tuple[str, str, Array]]:
    """Yield name, kind and stamps of the measurements in a record."""
    if record.imu is not None and len(record.imu.time):
        yield "imu", "imu", record.imu.time
    if record.magnetometer is not None and len(record.magnetometer.time):
        yield (
            record.magnetometer.magnetometer or "magnetometer",
            "magnetometer",
            (record.magnetometer.time),
        )
    if record.fields is not None:
        yield record.fields.magnetometer or "fields", "fields", np.array([record.fields.time])
