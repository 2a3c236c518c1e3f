"""Tables of inertial and magnetometer samples."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from magfusion.errors import InputError
from magfusion.files.plausible import check_field, check_imu
from magfusion.files.table import TIME, Layout, Span, read_table, write_table
from magfusion.model.samples import FieldSamples, ImuSamples, Waveform
from magfusion.model.trajectory import Trajectory

Stream = TypeVar("Stream", Waveform, FieldSamples, Trajectory)

_GYRO = ("gyro_x", "gyro_y", "gyro_z")
_ACCEL = ("accel_x", "accel_y", "accel_z")
_FIELD = ("field_x", "field_y", "field_z")
_IMU_LAYOUT = Layout(numbers=(*_GYRO, *_ACCEL))
_FIELD_LAYOUT = Layout(numbers=_FIELD)


def read_imu(path: Path, span: Span, names: tuple[str, ...] = ()) -> ImuSamples:
    """Read and check inertial samples; ``names`` as in `read_table`.

    Raises
    ------
    InputError
        As `read_table` and `check_imu`; or where the span holds no sample.
    """
    table = read_table(path, _IMU_LAYOUT, span, names)
    if not len(table):
        raise InputError(f"{path}: holds no row {span}; choose a span that the log covers.")
    imu = ImuSamples(table.time, table.numbers(_GYRO), table.numbers(_ACCEL))
    check_imu(imu, str(path))
    return imu


def write_imu(imu: ImuSamples, path: Path, epoch_ns: int) -> None:
    """Write inertial samples as Parquet."""
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(imu.time)}
    columns |= dict(zip(_GYRO, imu.gyro_body.T, strict=True))
    columns |= dict(zip(_ACCEL, imu.accel_body.T, strict=True))
    write_table(columns, path)


def read_waveform(path: Path, span: Span, names: tuple[str, ...] = ()) -> Waveform:
    """Read and check magnetometer samples; ``names`` as in `read_table`.

    Raises
    ------
    InputError
        As `read_table` and `check_field`.
    """
    table = read_table(path, _FIELD_LAYOUT, span, names)
    waveform = Waveform(table.time, table.numbers(_FIELD))
    check_field(np.linalg.norm(waveform.measured_sensor, axis=1), str(path))
    return waveform


def write_waveform(waveform: Waveform, path: Path, epoch_ns: int) -> None:
    """Write magnetometer samples as Parquet."""
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(waveform.time)}
    columns |= dict(zip(_FIELD, waveform.measured_sensor.T, strict=True))
    write_table(columns, path)


def read_if_there(
    path: Path | None, read: Callable[[Path, Span], Stream], span: Span
) -> Stream | None:
    """Return what a reader finds, or None where there is no file or no row within the span."""
    stream = None if path is None else read(path, span)
    return stream if stream is not None and len(stream) else None
