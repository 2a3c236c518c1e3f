"""Drive currents in a magnetometer's table: columns ``drive``, or ``drive_`` and a name."""

import csv
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from magfusion.files.table import Span, TableLayout, read_table
from magfusion.model.drive import DriveSamples
from magfusion.model.samples import Waveform
from magfusion.units import Array

COLUMN = "drive"
_OF = f"{COLUMN}_"


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
    names = () if path is None else drive_columns(path)
    if path is None or not names:
        return None
    table = read_table(path, TableLayout(numbers=names, repeats=True, strays=True), span)
    values = table.numbers(names, nan=True)
    kept = (np.diff(table.time, prepend=-np.inf) > 0.0) & np.isfinite(values).all(axis=1)
    if not np.any(kept):
        return None
    own = {beacon_of(n): v for n, v in zip(names, values[kept].T.copy(), strict=True)}
    return DriveSamples(table.time[kept], own)


def current_columns_of(drive: DriveSamples, waveform: Waveform) -> dict[str, Array]:
    """Return the columns of currents at a magnetometer's samples, NaN where there was none."""
    at = np.minimum(np.searchsorted(drive.time, waveform.time), len(drive.time) - 1)
    same = drive.time[at] == waveform.time
    return {
        column_of(beacon): np.where(same, values[at], np.nan)
        for beacon, values in drive.current.items()
    }
