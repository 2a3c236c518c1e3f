"""A log too long for memory: its raw streams are read while they are used."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet

from magfusion.files.drive_columns import column_names, drive_columns, rotor_columns
from magfusion.files.fields import read_fields
from magfusion.files.inertial_tables import read_if_there
from magfusion.files.log_header import is_log, read_header
from magfusion.files.lost_rows import MAX_MISSING
from magfusion.files.marks_table import SLOT
from magfusion.files.named_samples import MAGNETOMETER
from magfusion.files.plausible import beyond_range, check_field, check_imu
from magfusion.files.readings_table import read_temperatures
from magfusion.files.table import Span, find_table
from magfusion.files.table_stream import SampleBlock, pieces
from magfusion.model.aiding import QUANTITIES
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.temperature import Temperatures
from magfusion.units import Array

LONG = 1 << 20  # rows; a shorter stream is read whole
_COLUMNS = {"imu": 6, "magnetometer": 3}


class Samples:
    """A raw stream, taken up to one time after the other; what is no sample is left out.

    `place`: what a refusal calls it. `columns`: of a row. Attribute `first`: when it begins (s);
    None of one without samples.
    """

    def __init__(self, place: str, source: Iterator[SampleBlock], columns: int) -> None:
        self._place, self._source = place, source
        self._time, self._values = np.empty(0), np.empty((0, columns))
        self._newest, self._checked, self._at = -np.inf, False, 0
        self.first = float(self._time[0]) if self._filled() else None

    @property
    def ended(self) -> bool:
        """Whether no sample is left."""
        return not self._filled()

    def until(self, time: float) -> tuple[Array, Array]:
        """Return the samples that are left before a time (s), times (n,) and rows (n, columns)."""
        times, values = [self._time[:0]], [self._values[:0]]
        while self._filled():
            end = self._at + int(np.searchsorted(self._time[self._at :], time))
            times.append(self._time[self._at : end])
            values.append(self._values[self._at : end])
            self._at = end
            if end < len(self._time):
                break
        return np.concatenate(times), np.concatenate(values)

    def _filled(self) -> bool:
        """Read on where all has been taken; return whether there is a sample."""
        while self._at == len(self._time):
            piece = next(self._source, None)
            if piece is None:
                return False
            self._take(piece)
        return True

    def _take(self, piece: SampleBlock) -> None:
        kept = np.diff(piece.time, prepend=self._newest) > 0.0
        beyond = beyond_range(piece.values)
        # Else the unit is wrong.
        kept &= ~(np.isnan(piece.values).any(axis=1) | (beyond & (np.mean(beyond) <= MAX_MISSING)))
        self._time, self._values, self._at = piece.time[kept], piece.values[kept], 0
        if not len(self._time):
            return
        self._newest = float(self._time[-1])
        if not self._checked:  # a mistake of the unit is one from the first sample on
            self._check()

    def _check(self) -> None:
        self._checked = True
        if self._values.shape[1] == _COLUMNS["imu"]:
            samples = ImuSamples(self._time, self._values[:, :3], self._values[:, 3:])
            check_imu(samples, self._place)
        else:
            check_field(np.linalg.norm(self._values, axis=1), self._place)


@dataclass(frozen=True, eq=False)
class LongLog:
    """A log with long raw streams.

    `fields`: phasors of a table of them, which are few.
    """

    path: Path
    span: Span
    fields: FieldSamples | None
    temperatures: Temperatures | None = None

    def imu(self) -> Samples:
        """Return the inertial stream from its beginning: rate, then specific force."""
        return self._stream("imu")

    def waveform(self) -> Samples:
        """Return the magnetometer's samples from their beginning."""
        return self._stream("magnetometer")

    def _stream(self, name: str) -> Samples:
        source = pieces(self.path, name, self.span.start, self.span.end)
        place = find_table(self.path, name) or self.path / name
        return Samples(str(place), source, _COLUMNS[name])


def long_log(path: Path, start: float | None = None, end: float | None = None) -> LongLog | None:
    """Return a log of magfusion with a stream of more than `LONG` rows; None of any other.

    `start`, `end`: the part with start <= time < end, in seconds since the log's epoch.
    """
    if not is_log(path) or max(_rows(path, name) for name in _COLUMNS) <= LONG:
        return None
    header = read_header(path)
    if header.audio is not None:
        return None
    tables = {name: find_table(path, name) for name in (*_COLUMNS, "fields")}
    if tables["imu"] is None or tables["magnetometer"] is tables["fields"] is None:
        return None  # which is refused where it is read whole
    raw = tables["magnetometer"]
    if any(find_table(path, name) is not None for name in ("marks", "reference", *QUANTITIES)) or (
        raw is not None
        and (
            drive_columns(raw)
            or {SLOT, MAGNETOMETER} & set(column_names(raw))
            or rotor_columns(raw)
        )
    ):
        return None
    span = Span(header.epoch_ns, start, end)
    fields = read_if_there(tables["fields"], read_fields, span)
    temperatures = read_temperatures(find_table(path, "temperature"), span.epoch_ns)
    return LongLog(path, span, fields, temperatures)


def _rows(path: Path, stream: str) -> int:
    """Return how many rows the table of a stream has, as far as it is known beforehand."""
    table = find_table(path, stream)
    if table is None or table.suffix == ".csv":
        return 0
    try:
        return int(pyarrow.parquet.read_metadata(table).num_rows)
    except (pyarrow.ArrowException, OSError, ValueError):  # refused where it is read
        return 0
