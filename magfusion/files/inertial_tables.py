"""Tables of inertial and magnetometer samples."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa

from magfusion.errors import InputError
from magfusion.files.drive_columns import angle_columns_of, column_names, current_columns_of
from magfusion.files.lost_rows import LostRows, coarse_text
from magfusion.files.plausible import check_field, check_imu
from magfusion.files.row_stamps import batches_finding, separate_stamps
from magfusion.files.stray_stamps import stray_finding
from magfusion.files.table import TIME, Span, Table, TableLayout, read_table, write_table
from magfusion.model.drive import DriveSamples
from magfusion.model.rotor import RotorAngles
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding
from magfusion.units import NANOSECOND, Array

Stream = TypeVar("Stream", FieldSamples, Trajectory)

_GYRO = ("gyro_x", "gyro_y", "gyro_z")
_ACCEL = ("accel_x", "accel_y", "accel_z")
FIELD = ("field_x", "field_y", "field_z")
IMU_LAYOUT = TableLayout(numbers=(*_GYRO, *_ACCEL), repeats=True, strays=True)
HALF_LAYOUTS = {  # of a gyro or an accelerometer alone
    "gyro": TableLayout(numbers=_GYRO, repeats=True, strays=True),
    "accel": TableLayout(numbers=_ACCEL, repeats=True, strays=True),
}
FIELD_LAYOUT = TableLayout(numbers=FIELD, repeats=True, strays=True)
_SOME_AXES = TableLayout(numbers=(), repeats=True, some=FIELD, strays=True)


def read_imu(
    path: Path, span: Span, content: pa.Table | None = None
) -> tuple[ImuSamples, tuple[Finding, ...]]:
    """Read and check inertial samples; ``content`` as in `read_table`.

    Rows that hold NaN or of repeated time are omitted; the findings have their number.
    """
    table = read_table(path, IMU_LAYOUT, span, content)
    if not len(table):
        raise InputError(f"{path}: holds no row {span}; choose a span that the log covers.")
    time, values, findings = measured_rows(table, (*_GYRO, *_ACCEL), "IMU", spread=True)
    imu = ImuSamples(time, values[:, :3].copy(), values[:, 3:].copy())
    check_imu(imu, str(path))
    return imu, findings


def write_imu(imu: ImuSamples, path: Path, epoch_ns: int) -> None:
    """Write inertial samples as Parquet."""
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(imu.time)}
    columns |= dict(zip(_GYRO, imu.gyro_body.T, strict=True))
    columns |= dict(zip(_ACCEL, imu.accel_body.T, strict=True))
    write_table(columns, path)


def read_waveform(
    path: Path | None, span: Span, content: pa.Table | None = None
) -> tuple[Waveform | None, tuple[Finding, ...]]:
    """Read and check magnetometer samples; ``content`` as in `read_table`.

    A receiver of fewer axes leaves columns out. Omits rows as `read_imu`; returns
    None where there is no file or no row within the span.
    """
    if path is None:
        return None, ()
    table = read_table(path, _SOME_AXES, span, content)
    if not len(table):
        return None, ()
    columns = tuple(name for name in FIELD if table.has((name,)))
    alone = content is not None or {TIME, *FIELD}.issuperset(column_names(path))
    time, values, findings = measured_rows(table, columns, "magnetometer", alone)
    check_field(np.linalg.norm(values, axis=1), str(path))
    if columns == FIELD:
        return Waveform(time, values), findings
    whole = np.zeros((len(time), 3))
    whole[:, [FIELD.index(name) for name in columns]] = values
    axes = "".join(name[-1] for name in columns)
    return Waveform(time, whole, axes=axes), findings


def measured_rows(
    table: Table, names: tuple[str, ...], stream: str, spread: bool = False
) -> tuple[Array, Array, tuple[Finding, ...]]:
    """Return times (s) and columns of the rows that hold a sample, and what the others are.

    `spread`: whether samples of batches with one stamp are spread: where no other column has the
    stamps.
    """
    values = table.numbers(names, nan=True)
    separate = separate_stamps(table.time_ns, values) if spread else None
    findings = stray_finding(stream, [stamp for _, stamp in table.stray])
    if separate is not None:
        findings += (batches_finding(stream, table.time_ns),)
        time = table.time + (separate - table.time_ns) * NANOSECOND
        table = replace(table, time_ns=separate, time=time)
    lost_epochs = LostRows.of(table.time_ns, values)
    too_often, too_many = lost_epochs.too_many
    if too_often:
        twice = int(np.sum(lost_epochs.twice))
        kind = stream.partition(" ")[0].lower()
        raise InputError(coarse_text(str(table.path), kind, twice, len(table)))
    if too_many:
        name = next(n for n, v in zip(names, values.T, strict=True) if np.isnan(v).any())
        table.refuse(lost_epochs.absent, name, np.full(len(table), np.nan), "write a finite number")
    findings += lost_epochs.findings(stream)
    return table.time[lost_epochs.kept], values[lost_epochs.kept], findings


def write_waveform(
    waveform: Waveform,
    path: Path,
    epoch_ns: int,
    drive: DriveSamples | None = None,
    rotation: RotorAngles | None = None,
) -> None:
    """Write magnetometer samples, with their currents and angles, as Parquet."""
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(waveform.time)}
    values = dict(zip(FIELD, waveform.measured_sensor.T, strict=True))
    columns |= {name: value for name, value in values.items() if name[-1] in waveform.axes}
    columns |= {} if drive is None else current_columns_of(drive, waveform)
    columns |= {} if rotation is None else angle_columns_of(rotation, waveform)
    write_table(columns, path)


def read_if_there(
    path: Path | None, read: Callable[[Path, Span], Stream], span: Span
) -> Stream | None:
    """Return what a reader finds, or None where there is no file or no row within the span."""
    stream = None if path is None else read(path, span)
    return stream if stream is not None and len(stream) else None
