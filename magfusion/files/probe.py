"""Readings of a probe at points about an antenna whose coils are driven one by one."""

from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pyarrow as pa

from magfusion.errors import InputError
from magfusion.files.plain_table import POSITION, column, integers, numbers, read_whole, refuse_rows
from magfusion.model.probe import ProbeReadings
from magfusion.units import Array

Side = Literal["transmitter", "receiver"]
AXIS = ("axis_x", "axis_y", "axis_z")
FIELD = ("field_x", "field_y", "field_z")


def read_probe(path: Path) -> dict[Side, ProbeReadings]:
    """Read and check what a probe of one or three axes read, in Parquet or CSV.

    Raises InputError where a column is missing or of the wrong type, a number is not finite, a coil
    is none of three, an axis has no direction, or a sigma is not positive. Returns the readings by
    the antenna next to which it was placed.
    """
    table = read_whole(path, "table of probe readings")
    coil = integers(table, "coil", path)
    refuse_rows((coil < 0) | (coil > 2), path, "column coil", coil, "0, 1 or 2")
    sigma = numbers(table, "sigma", path)
    refuse_rows(sigma <= 0.0, path, "column sigma", sigma, "a positive number")
    position = np.stack([numbers(table, name, path) for name in POSITION], axis=1)
    reach = np.linalg.norm(position, axis=1)
    refuse_rows(reach == 0.0, path, "columns position_x to position_z", reach, "another place")
    result = ProbeReadings(coil, position, *_readings(table, path), sigma)
    if result.axis.ndim == 3:
        result = _each_axis(result)
    side = _sides(table, path)
    side = np.repeat(side, len(result) // len(side))
    present: tuple[Side, ...] = get_args(Side)
    return {name: result.rows(side == name) for name in present if np.any(side == name)}


def _readings(table: pa.Table, path: Path) -> tuple[Array, Array]:
    """Return axes (n, 3) and readings (n,), or, of a probe of three axes, one axis more."""
    names = table.column_names
    if set(FIELD) & set(names):
        if "reading" in names:
            raise InputError(
                f"{path}: has reading and field_x to field_z; keep the one that was read."
            )
        field = np.stack([numbers(table, name, path) for name in FIELD], axis=1)
        return np.broadcast_to(np.eye(3), (len(field), 3, 3)), field
    axis = np.stack([numbers(table, name, path) for name in AXIS], axis=1)
    length = np.linalg.norm(axis, axis=1)
    refuse_rows(length < 1e-6, path, "columns axis_x to axis_z", length, "a direction")
    return axis / length[:, None], numbers(table, "reading", path)


def _each_axis(result: ProbeReadings) -> ProbeReadings:
    return ProbeReadings(
        np.repeat(result.coil, 3),
        np.repeat(result.position, 3, axis=0),
        result.axis.reshape(-1, 3),
        result.reading.ravel(),
        np.repeat(result.sigma, 3),
    )


def _sides(table: pa.Table, path: Path) -> np.ndarray:
    if "antenna" not in table.column_names:
        return np.full(table.num_rows, "transmitter")
    side = np.array([str(value) for value in column(table, "antenna", path).to_pylist()])
    wrong = ~np.isin(side, get_args(Side))
    refuse_rows(wrong, path, "column antenna", side, "transmitter or receiver")
    return side
