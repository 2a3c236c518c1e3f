"""Samples of the records in a pipe: missing, impossible and false ones are left out and counted."""

from collections import Counter
from collections.abc import Iterator
from typing import TextIO

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.pauses import PauseFilter
from magfusion.estimation.data_checks.spike_filter import SpikeFilter
from magfusion.files.plausible import RANGE_KEYS, beyond_range, declared_range, exceeds
from magfusion.files.standard_streams import write_message
from magfusion.model.site import Site
from magfusion.receiver.running_clock import RunningClock
from magfusion.receiver.slots import has_schedule
from magfusion.units import Array

FIRST = 50  # samples; bit errors do not make as many in a row
_INSTRUMENTS = {"imu": ("gyroscope", "accelerometer"), "magnetometer": ("magnetometer",)}
_STAMPS = {"counted": "those of batches or bursts", "rounded": "rounded"}
_UNITS = {"imu": "rad/s and m/s^2", "magnetometer": "tesla", "reference": "tesla"}


class StreamSamples:
    """Samples of each stream: those of the IMU, and of each magnetometer by its name.

    `patient`: whether the first samples wait until their stamps and values can be tested.
    """

    def __init__(self, site: Site, *, patient: bool = True) -> None:
        self._site, self._patient = site, patient
        self._missing: Counter[str] = Counter()
        self._beyond: Counter[str] = Counter()
        self._used: Counter[str] = Counter()
        self._false: Counter[str] = Counter()
        self._replaced: dict[str, str] = {}
        self._clocks: dict[tuple[str, str | None], RunningClock] = {}
        self._filters: dict[tuple[str, str | None], SpikeFilter] = {}
        self._pauses: dict[tuple[str, str | None], PauseFilter] = {}
        self._repeated: Counter[str] = Counter()

    def whole(
        self, stream: str, time: Array, *values: Array, name: str | None = None
    ) -> tuple[Array, Array]:
        """Return the samples that are whole and within range, values in one array; count others.

        `name`: of one of several magnetometers. Raises InputError where the first `FIRST` are all
        larger than any instrument measures, or than declared.
        """
        rows = np.hstack(values)
        large = beyond_range(rows)
        missing = large | ~np.isfinite(rows).all(axis=1)
        self._missing[stream] += int(np.sum(missing))
        absent = self._missing[stream]
        for instrument, own in zip(_INSTRUMENTS.get(stream, ()), values, strict=False):
            beyond = exceeds(own, declared_range(instrument, self._site.platform, name)) & ~missing
            self._beyond[instrument] += int(np.sum(beyond))
            absent += self._beyond[instrument]
            missing |= beyond
            large |= beyond
        kept = ~missing
        self._used[stream] += int(np.sum(kept))
        if large.any() and not self._used[stream] and absent >= FIRST:
            raise InputError(
                f"{stream}: no sample so far is within the range of the instrument: another unit is"
                f" probably meant; give {_UNITS[stream]}, or correct the range in the site"
            )
        return time[kept], rows[kept]

    def tested(
        self, stream: str, time: Array, rows: Array, name: str | None = None
    ) -> tuple[Array, Array]:
        """Return the samples at their times that pass the test for single false ones.

        It needs the next two; stamps that are not of samples wait for their clock at the beginning.
        `name`: of one of several magnetometers.
        """
        key = stream, name
        if key not in self._filters:
            known = not self._patient or has_schedule(self._site)
            self._clocks[key] = RunningClock("stamps" if known else None)
            self._filters[key] = SpikeFilter(
                _INSTRUMENTS[stream], self._site, patient=self._patient
            )
            if stream == "magnetometer":
                self._pauses[key] = PauseFilter(patient=self._patient)
        time, rows = self._clocks[key].push(time, rows)
        if key in self._pauses:
            time, rows = self._pauses[key].push(time, rows)
        return self._filters[key].push(time, rows)

    def end(self) -> Iterator[tuple[str, str | None, Array, Array]]:
        """Yield the samples that wait for others, by stream and name, at the end of the streams.

        What comes after is another stream.
        """
        filters, self._filters = self._filters, {}
        for (stream, name), own in filters.items():
            clock = self._clocks.pop((stream, name))
            last = clock.end()
            if (pauses := self._pauses.pop((stream, name), None)) is not None:
                last = pauses.push(*last, final=True)
                self._repeated[stream] += pauses.left_out
            for time, rows in (own.push(*last), own.end()):
                if len(time):
                    yield stream, name, time, rows
            self._false[stream] += own.left_out
            if clock.stamping in _STAMPS:
                self._replaced[stream] = (
                    f"the stamps are {_STAMPS[clock.stamping]}; an even clock of"
                    f" {1.0 / clock.step:.4g} Hz replaces them"
                )

    def report(self, messages: TextIO) -> None:
        """Write how many samples are left out, after the end."""
        for stream, count in (+self._missing).items():
            text = f"{count} samples are NaN, or larger than any instrument measures"
            write_message(messages, f"{stream}: {text}. They are left out.")
        for instrument, count in (+self._beyond).items():
            text = f"{count} samples are beyond the range in platform.{RANGE_KEYS[instrument]}"
            write_message(messages, f"{instrument}: {text}. They are left out.")
        for stream, text in self._replaced.items():
            write_message(messages, f"{stream}: {text}.")
        for stream, count in (+self._repeated).items():
            text = (
                f"{count} samples repeat the last one, as while a multiplexer reads another channel"
            )
            write_message(messages, f"{stream}: {text}. They are left out.")
        for stream, count in (+self._false).items():
            text = f"{count} isolated samples are off their neighbours, probably by bit errors"
            write_message(messages, f"{stream}: {text}. They are left out.")
