"""A log as the stream that it once was: small pieces in the order of their arrival."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from magfusion.fusion.online import Navigator
from magfusion.records.samples import FieldSamples, ImuSamples, Log, Waveform
from magfusion.units import Array, IntArray

PIECE = 0.05  # s


@dataclass(frozen=True, eq=False)
class Piece:
    """What arrives together.

    Parameters
    ----------
    arrival : float
        When all of it has been measured (s).
    imu : ImuSamples
    waveform : Waveform, optional
    fields : tuple of FieldSamples
        One epoch each.
    """

    arrival: float
    imu: ImuSamples
    waveform: Waveform | None
    fields: tuple[FieldSamples, ...]


class Replay:
    """The pieces of a log.

    Parameters
    ----------
    log : Log
        A phasor arrives when its window ends.
    """

    def __init__(self, log: Log) -> None:
        self.log = log
        self._field_arrival = _field_arrival(log.fields)
        streams = [log.imu.time, self._field_arrival]
        streams += [] if log.waveform is None else [log.waveform.time]
        known = [s for s in streams if len(s)]
        first = min(float(s[0]) for s in known)
        last = max(float(s[-1]) for s in known)
        count = int((last - first) / PIECE) + 2
        self._edges: Array = first + PIECE * np.arange(count, dtype=float)
        self._imu = _places(log.imu.time, self._edges)
        none = np.empty(0)
        self._waveform = _places(none if log.waveform is None else log.waveform.time, self._edges)
        self._fields = _places(self._field_arrival, self._edges)

    def __len__(self) -> int:
        return len(self._edges) - 1

    def piece(self, k: int) -> Piece:
        """Return one piece."""
        imu, waveform = self.log.imu, self.log.waveform
        own = slice(*self._imu[k : k + 2])
        part = slice(*self._waveform[k : k + 2])
        rows = range(*self._fields[k : k + 2])
        return Piece(
            arrival=float(self._edges[k + 1]),
            imu=ImuSamples(imu.time[own], imu.gyro_body[own], imu.accel_body[own]),
            waveform=None
            if waveform is None
            else Waveform(waveform.time[part], waveform.measured_sensor[part]),
            fields=tuple(_epoch(self.log.fields, i) for i in rows),
        )


def feed(navigator: Navigator, piece: Piece) -> None:
    """Give a piece to a navigator."""
    if len(piece.imu):
        navigator.add_imu(piece.imu.time, piece.imu.gyro_body, piece.imu.accel_body)
    if piece.waveform is not None and len(piece.waveform):
        navigator.add_magnetometer(piece.waveform.time, piece.waveform.measured_sensor)
    for samples in piece.fields:
        navigator.add_fields(samples)


def paced(replay: Replay, first: int, realtime: bool) -> Iterator[tuple[int, Piece]]:
    """Yield the pieces from the first on with their number, by the log's clock where asked."""
    began = 0.0
    for k in range(first, len(replay)):
        piece = replay.piece(k)
        now = time.monotonic()
        if k == first:
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


def _epoch(fields: FieldSamples | None, i: int) -> FieldSamples:
    assert fields is not None
    row = slice(i, i + 1)
    return FieldSamples(
        fields.time[row],
        fields.window[row],
        fields.channels,
        fields.phasor_sensor[row],
        fields.phasor_cov[row],
    )
