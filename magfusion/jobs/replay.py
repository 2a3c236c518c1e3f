"""Replays a log as a real-time stream: small pieces in the order of their arrival."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from magfusion.estimation.demodulation.drive_reference import cosines
from magfusion.files.long_log import LongLog, long_log
from magfusion.files.open import open_log
from magfusion.files.site import load_site
from magfusion.files.standard_streams import binary_output, until_closed
from magfusion.files.stream import Format
from magfusion.files.stream_contents import (
    aiding_content,
    drive_content,
    fields_contents,
    imu_content,
    magnetometer_content,
    marks_content,
    reference_content,
    temperature_content,
    write_record,
)
from magfusion.jobs.settings import Command, PartSettings, ReplayedSettings, option
from magfusion.model.aiding import AidingSamples
from magfusion.model.drive import DriveSamples
from magfusion.model.marks import Marks
from magfusion.model.samples import FieldSamples, ImuSamples, Log, Waveform
from magfusion.model.temperature import Temperatures
from magfusion.units import Array, IntArray

if TYPE_CHECKING:
    from magfusion.estimation.online.navigator import Navigator


PIECE = 0.05  # s


@dataclass(frozen=True, eq=False)
class Packet:
    """Data that arrive together."""

    arrival: float  # end of the last measurement (s)
    imu: ImuSamples
    waveform: Waveform | None
    fields: tuple[FieldSamples, ...]  # one epoch each
    # of several magnetometers, those with samples or marks in it
    waveforms: tuple[tuple[str, Waveform], ...] = ()
    aiding: tuple[tuple[str, AidingSamples], ...] = ()  # of the aiding sensors with samples in it

    @property
    def waves(self) -> Iterator[tuple[str | None, Waveform]]:
        """The samples with the name of their magnetometer, None for a single one."""
        if self.waveform is not None:
            yield None, self.waveform
        yield from self.waveforms


class Replay:
    """The pieces of a log.

    `log`: a phasor arrives when its window ends. Samples of aiding sensors outside the others are
    omitted.
    """

    def __init__(self, log: Log) -> None:
        self.log = log
        self._field_arrival = _field_arrival(log.fields)
        streams = [log.imu.time, self._field_arrival]
        streams += [] if log.waveform is None else [log.waveform.time]
        streams += [wave.time for wave in log.waveforms.values()]
        known = [s for s in streams if len(s)]
        first = min(float(s[0]) for s in known)
        last = max(float(s[-1]) for s in known)
        count = int((last - first) / PIECE) + 2
        self._edges: Array = first + PIECE * np.arange(count, dtype=float)
        self._imu = _places(log.imu.time, self._edges)
        none = np.empty(0)
        self._waveform = _places(none if log.waveform is None else log.waveform.time, self._edges)
        self._each = {n: _places(w.time, self._edges) for n, w in log.waveforms.items()}
        self._fields = _places(self._field_arrival, self._edges)
        self._aiding = {n: _places(s.time, self._edges) for n, s in log.aiding.items()}

    def __len__(self) -> int:
        return len(self._edges) - 1

    def piece(self, k: int) -> Packet:
        """Return one piece."""
        imu, waveform = self.log.imu, self.log.waveform
        own = slice(*self._imu[k : k + 2])
        part = slice(*self._waveform[k : k + 2])
        fields, rows = self.log.fields, range(*self._fields[k : k + 2])
        return Packet(
            arrival=float(self._edges[k + 1]),
            imu=ImuSamples(imu.time[own], imu.gyro_body[own], imu.accel_body[own]),
            waveform=None
            if waveform is None
            else replace(waveform.rows(part), marks=self._marks(waveform, k)),
            fields=() if fields is None else tuple(fields.rows(slice(i, i + 1)) for i in rows),
            waveforms=self._of_several(k),
            aiding=tuple(
                (name, samples.rows(slice(*self._aiding[name][k : k + 2])))
                for name, samples in self.log.aiding.items()
                if np.ptp(self._aiding[name][k : k + 2])
            ),
        )

    def _of_several(self, k: int) -> tuple[tuple[str, Waveform], ...]:
        """Return the samples of each of several magnetometers; the first has the marks."""
        result: list[tuple[str, Waveform]] = []
        for name, wave in self.log.waveforms.items():
            marks = None if result else self._marks(wave, k)
            part = wave.rows(slice(*self._each[name][k : k + 2]))
            result.append((name, replace(part, marks=marks)))
        return tuple(result)

    def _marks(self, waveform: Waveform | None, k: int) -> Marks | None:
        """Return the bursts that have ended since the piece before."""
        if waveform is None or waveform.marks is None:
            return None
        first, last = _places(waveform.marks.end, self._edges[k : k + 2]).tolist()
        return waveform.marks.rows(slice(first if k else 0, last))

    def pieces(self, first: int = 0) -> Iterator[tuple[int, Packet]]:
        """Yield the pieces from the first on, with their index."""
        for k in range(first, len(self)):
            yield k, self.piece(k)


def feed(navigator: Navigator, piece: Packet) -> None:
    """Feed a piece to a navigator."""
    if len(piece.imu) and navigator.site.platform.inertial:
        navigator.propagate_imu(piece.imu.time, piece.imu.gyro_body, piece.imu.accel_body)
    for name, wave in piece.waves:
        if wave.marks:
            navigator.add_marks(wave.marks)
        if len(wave):
            navigator.add_magnetometer(wave.time, wave.measured_sensor, name)
    for sensor, aiding in piece.aiding:
        navigator.add_aiding(sensor, aiding)
    for samples in piece.fields:
        navigator.add_fields(samples)
    navigator.advance()


def paced(pieces: Iterable[tuple[int, Packet]], realtime: bool) -> Iterator[tuple[int, Packet]]:
    """Yield pieces with their index, in real time if requested."""
    began: float | None = None
    for k, piece in pieces:
        now = time.monotonic()
        if began is None:
            began = now - piece.arrival
        if realtime and piece.arrival > now - began:
            time.sleep(piece.arrival - (now - began))
        yield k, piece


def _places(stamps: Array, edges: Array) -> IntArray:
    return np.searchsorted(stamps, edges)


def _field_arrival(fields: FieldSamples | None) -> Array:
    if fields is None:
        return np.empty(0)
    return np.asarray(np.maximum.accumulate(fields.time + fields.window / 2.0))


def _of_long(log: LongLog) -> Iterator[tuple[int, Packet]]:
    """Yield the pieces of a log that is read concurrently."""
    imu, waveform = log.imu(), log.waveform()
    arrival = _field_arrival(log.fields)
    known = [first for first in (imu.first, waveform.first) if first is not None]
    first, k, row = min([*known, *arrival[:1].tolist()]), 0, 0
    while not (imu.ended and waveform.ended and row == len(arrival)):
        edge = first + PIECE * float(k + 1)
        due = int(np.searchsorted(arrival, edge))
        fields = () if log.fields is None else tuple(log.fields.rows(slice(row, due)).epochs())
        time_imu, values = imu.until(edge)
        yield (
            k,
            Packet(
                arrival=edge,
                imu=ImuSamples(time_imu, values[:, :3], values[:, 3:]),
                waveform=Waveform(*waveform.until(edge)),
                fields=fields,
            ),
        )
        k, row = k + 1, due


def _currents(log: Log | LongLog) -> DriveSamples | None:
    """Return the currents of coils, or those that represent the angles of rotors."""
    if isinstance(log, LongLog) or log.drive is not None or log.rotation is None:
        return None if isinstance(log, LongLog) else log.drive
    return cosines(log.rotation)


def _contents(piece: Packet) -> Iterator[dict[str, Any]]:
    """Yield a piece as records."""
    if len(piece.imu):
        yield imu_content(piece.imu)
    for name, wave in piece.waves:
        if wave.marks:
            yield marks_content(wave.marks)
        if len(wave):
            yield magnetometer_content(wave, name)
    if piece.aiding:
        yield aiding_content(piece.aiding)
    for samples in piece.fields:
        yield from fields_contents(samples)


class _Companions:
    """Data with the samples of a log that are known before them."""

    def __init__(self, log: Log | LongLog) -> None:
        degrees = log.temperatures or Temperatures()
        self._readings = deque(sorted(degrees.each()))
        self._currents = _currents(log)
        self._reference = None if isinstance(log, LongLog) else log.reference

    def until(self, arrival: float) -> Iterator[dict[str, Any]]:
        """Yield the records up to a time (s)."""
        while self._readings and self._readings[0][0] < arrival:
            yield temperature_content(*self._readings.popleft())
        if self._currents is not None:
            due = int(np.searchsorted(self._currents.time, arrival))
            if due:
                yield drive_content(self._currents.rows(slice(0, due)))
            self._currents = self._currents.rows(slice(due, None))
        if self._reference is not None:
            due = int(np.searchsorted(self._reference.time, arrival))
            if due:
                yield reference_content(self._reference.rows(slice(0, due)))
            self._reference = self._reference.rows(slice(due, None))


def run_replay(log: Log | LongLog, sink: BinaryIO, form: Format, realtime: bool) -> None:
    """Write a log as the records of a stream, in the order of their arrival."""
    pieces = _of_long(log) if isinstance(log, LongLog) else Replay(log).pieces()
    others = _Companions(log)
    for _, piece in paced(pieces, realtime):
        for content in (*others.until(piece.arrival), *_contents(piece)):
            write_record(content, sink, form)
        if realtime:
            sink.flush()
    sink.flush()


@dataclass(frozen=True, kw_only=True)
class ReplaySettings(PartSettings, ReplayedSettings):
    """Settings of the replay."""

    site: Path | None = option(None, "Site file, for a bag's topics of aiding sensors")


def run(settings: ReplaySettings) -> None:
    """Print a log as records; see `run_replay`."""
    from magfusion.jobs.inputs import topics_option

    sink = binary_output()
    part, topics = (settings.start, settings.end), topics_option(settings.topics)
    site = (
        None
        if settings.site is None
        else load_site(settings.site, unknown=True, without=True, several=True)
    )
    result = long_log(settings.log, *part) or open_log(settings.log, *part, topics, site=site)
    with until_closed():
        run_replay(result, sink, settings.form, settings.realtime)


COMMAND = Command(
    ReplaySettings,
    run,
    reports=False,
    example="magfusion replay log --end 12 | magfusion navigate - --site site.yaml",
)
