"""A stream of a log of any length, piece by piece: hours of samples in the memory of a minute."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from magfusion.errors import InputError
from magfusion.files.bag_topics import Topics
from magfusion.files.inertial_tables import FIELD_LAYOUT, HALF_LAYOUTS, IMU_LAYOUT
from magfusion.files.log_header import is_log, read_header
from magfusion.files.open import open_log
from magfusion.files.parquet_bounds import BATCH, refuse_unfolding
from magfusion.files.table import (
    TIME,
    Span,
    Table,
    TableLayout,
    check_times,
    find_table,
    refuse_jump,
)
from magfusion.units import Array, IntArray

# Name of each stream, its file and its columns.
STREAMS = {"imu": IMU_LAYOUT, "magnetometer": FIELD_LAYOUT, **HALF_LAYOUTS}


@dataclass(frozen=True, eq=False)
class SampleBlock:
    """Consecutive samples of a stream.

    `time` (n,): seconds since the log's epoch, sorted. `values` (n, columns): NaN where a number is
    missing.
    """

    time: Array
    values: Array


def pieces(
    path: Path,
    stream: str,
    start: float | None = None,
    end: float | None = None,
    topics: Topics | None = None,
) -> Iterator[SampleBlock]:
    """Yield a stream of a log, ``imu`` or ``magnetometer``; nothing where the log has none.

    A log's own tables are read piece by piece; an EuRoC folder and a bag are read whole first.
    """
    if not is_log(path):
        yield from _whole(path, stream, start, end, topics)
        return
    header = read_header(path)
    table = find_table(path, stream)
    if table is not None:
        for part in table_pieces(table, STREAMS[stream], Span(header.epoch_ns, start, end)):
            yield SampleBlock(part.time, part.numbers(STREAMS[stream].numbers, nan=True))


def _whole(
    path: Path, stream: str, start: float | None, end: float | None, topics: Topics | None
) -> Iterator[SampleBlock]:
    log = open_log(path, start, end, topics)
    if stream in HALF_LAYOUTS:
        return
    if stream == "imu":
        time, values = log.imu.time, np.hstack([log.imu.gyro_body, log.imu.accel_body])
    elif log.waveform is None:
        return
    else:
        time, values = log.waveform.time, log.waveform.measured_sensor
    for first in range(0, len(time), BATCH):
        yield SampleBlock(time[first : first + BATCH], values[first : first + BATCH])


def table_pieces(path: Path, layout: TableLayout, span: Span) -> Iterator[Table]:
    """Yield the rows of a span, in tables of at most `BATCH` rows."""
    begin, end = span.bounds_ns
    row, last = 0, None
    try:
        for batch in _batches(path, layout):
            data = pa.Table.from_batches([batch])
            empty = np.empty(len(data), dtype=np.int64)
            whole = Table(path, data, empty, np.empty(len(data)), row)
            time_ns = whole.integers(TIME)
            check_times(whole, time_ns, layout, span)
            _check_order(whole, time_ns, last)
            first, beyond = np.searchsorted(time_ns, [begin, end])
            if beyond > first:
                within = time_ns[first:beyond]
                part = data.slice(first, beyond - first)
                table = Table(path, part, within, span.seconds(within), row + int(first))
                refuse_jump(table, last if last is not None and last >= begin else None)
                yield table
            if beyond < len(time_ns):
                return
            row, last = row + len(data), int(time_ns[-1])
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: cannot be read ({reason}); write the file again.") from error


def _check_order(whole: Table, time_ns: IntArray, last: int | None) -> None:
    if last is not None and time_ns[0] < last:
        before = np.zeros(len(time_ns), dtype=bool)
        before[0] = True
        remedy = "which is before the row above: sort the rows by time"
        whole.refuse(before, TIME, time_ns, remedy)


def _batches(path: Path, layout: TableLayout) -> Iterator[pa.RecordBatch]:
    if path.suffix == ".csv":
        types = {name: layout.csv_type(name) for name in (TIME, *layout.numbers)}
        convert = pa.csv.ConvertOptions(column_types=types)
        with pa.csv.open_csv(path, convert_options=convert) as reader:
            names = layout.chosen([name.strip() for name in reader.schema.names], path)
            for batch in reader:
                if len(batch):
                    yield batch.select(names)
        return
    options = {"page_checksum_verification": True, "pre_buffer": False}  # else all of it is read
    with pa.parquet.ParquetFile(path, **options) as file:
        names = layout.chosen(file.schema_arrow.names, path)
        groups = [file.metadata.row_group(g) for g in range(file.num_row_groups)]
        refuse_unfolding(file, names, groups, path)
        for batch in file.iter_batches(BATCH, columns=names):
            if len(batch):
                yield batch
