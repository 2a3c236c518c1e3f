"""Currents and rotor angles with the samples of a magnetometer: ``drive_NAME``, ``rotor_NAME``."""

import csv
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from magfusion.files.table import Span, TableLayout, read_table
from magfusion.model.drive import DriveSamples
from magfusion.model.rotor import RotorAngles
from magfusion.model.samples import Waveform
from magfusion.units import Array

COLUMN = "drive"
_OF, _OF_ROTOR = f"{COLUMN}_", "rotor_"


def beacon_of(column: str) -> str:
    """Return the beacon of a column; an empty name means all without one of their own."""
    return column.removeprefix(_OF) if column != COLUMN else ""


def column_of(beacon: str) -> str:
    """Return the column of a beacon's current."""
    return f"{_OF}{beacon}" if beacon else COLUMN


def drive_columns(path: Path) -> tuple[str, ...]:
    """Return the columns of currents that a table has; none of what is no table."""
    names = column_names(path)
    return tuple(n for n in names if n == COLUMN or (n.startswith(_OF) and n != _OF))


def column_names(path: Path) -> list[str]:
    """Return the columns that a table has; none of what is no table."""
    try:
        if path.suffix == ".csv":
            with path.open(newline="", encoding="utf-8-sig") as stream:
                return [name.strip() for name in next(csv.reader(stream), [])]
        return list(pyarrow.parquet.read_schema(path).names)
    except (pa.ArrowException, OSError, ValueError, csv.Error):  # refused where it is read
        return []


def read_drive(path: Path | None, span: Span) -> DriveSamples | None:
    """Read the currents recorded with a magnetometer's samples; None where there are none."""
    time, values = _read_columns(path, () if path is None else drive_columns(path), span)
    own = {beacon_of(name): column for name, column in values.items()}
    return DriveSamples(time, own) if len(time) else None


def current_columns_of(drive: DriveSamples, waveform: Waveform) -> dict[str, Array]:
    """Return the columns of currents at a magnetometer's samples, NaN where there was none."""
    columns = {column_of(beacon): values for beacon, values in drive.current.items()}
    return _at_samples(drive.time, columns, waveform)


def rotor_columns(path: Path) -> tuple[str, ...]:
    """Return the columns of angles that a table has."""
    return tuple(n for n in column_names(path) if n.startswith(_OF_ROTOR) and n != _OF_ROTOR)


def read_rotation(path: Path | None, span: Span) -> RotorAngles | None:
    """Read the angles recorded with a magnetometer's samples (rad); None where there are none."""
    time, values = _read_columns(path, () if path is None else rotor_columns(path), span)
    own = {name.removeprefix(_OF_ROTOR): column for name, column in values.items()}
    return RotorAngles(time, own) if len(time) else None


def angle_columns_of(rotation: RotorAngles, waveform: Waveform) -> dict[str, Array]:
    """Return the columns of angles at a magnetometer's samples, NaN where there was none."""
    columns = {_OF_ROTOR + name: values for name, values in rotation.angle.items()}
    return _at_samples(rotation.time, columns, waveform)


def _read_columns(
    path: Path | None, names: tuple[str, ...], span: Span
) -> tuple[Array, dict[str, Array]]:
    """Return times (s) and columns of the rows that have all of them."""
    if path is None or not names:
        return np.zeros(0), {}
    table = read_table(path, TableLayout(numbers=names, repeats=True, strays=True), span)
    values = table.numbers(names, nan=True)
    kept = (np.diff(table.time, prepend=-np.inf) > 0.0) & np.isfinite(values).all(axis=1)
    return table.time[kept], dict(zip(names, values[kept].T.copy(), strict=True))


def _at_samples(time: Array, columns: dict[str, Array], waveform: Waveform) -> dict[str, Array]:
    at = np.minimum(np.searchsorted(time, waveform.time), len(time) - 1)
    same = time[at] == waveform.time
    return {name: np.where(same, values[at], np.nan) for name, values in columns.items()}
