"""Angles of rotors in a magnetometer's table: columns ``rotor_`` and a beacon's name."""

from pathlib import Path

import numpy as np

from magfusion.files.drive_columns import column_names
from magfusion.files.table import Span, TableLayout, read_table
from magfusion.model.rotor import RotorAngles
from magfusion.model.samples import Waveform
from magfusion.units import Array

_OF = "rotor_"


def rotor_columns(path: Path) -> tuple[str, ...]:
    """Return the columns of angles that a table has."""
    return tuple(n for n in column_names(path) if n.startswith(_OF) and n != _OF)


def read_rotation(path: Path | None, span: Span) -> RotorAngles | None:
    """Read the angles recorded with a magnetometer's samples (rad); None where there are none."""
    names = () if path is None else rotor_columns(path)
    if path is None or not names:
        return None
    table = read_table(path, TableLayout(numbers=names, repeats=True, strays=True), span)
    values = table.numbers(names, nan=True)
    kept = (np.diff(table.time, prepend=-np.inf) > 0.0) & np.isfinite(values).all(axis=1)
    own = {n.removeprefix(_OF): v for n, v in zip(names, values[kept].T.copy(), strict=True)}
    return RotorAngles(table.time[kept], own) if np.any(kept) else None


def angle_columns_of(rotation: RotorAngles, waveform: Waveform) -> dict[str, Array]:
    """Return the columns of angles at a magnetometer's samples, NaN where there was none."""
    at = np.minimum(np.searchsorted(rotation.time, waveform.time), len(rotation.time) - 1)
    same = rotation.time[at] == waveform.time
    return {_OF + name: np.where(same, v[at], np.nan) for name, v in rotation.angle.items()}
