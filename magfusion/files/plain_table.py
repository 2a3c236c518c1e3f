"""A table that is read whole, Parquet or CSV: columns that are checked, and refused by the row."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.units import Array, IntArray

MAX_POSITION = 1e7  # m; no survey leaves the Earth
POSITION = ("position_x", "position_y", "position_z")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")  # R = Rz(yaw) Ry(pitch) Rx(roll)


def refuse_damaged_text(table: pa.Table) -> None:
    """Refuse names of columns, and texts in them, that are not UTF-8."""
    table.validate(full=True)
    if not table.column_names:  # which are decoded here
        raise pa.ArrowInvalid("it has no columns")


def read_whole(path: Path, what: str) -> pa.Table:
    """Read a table that must have a row.

    `what`: the table is, for a refusal: "survey".
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the path of a {what}.")
    try:
        table = pa.csv.read_csv(path) if path.suffix == ".csv" else pa.parquet.read_table(path)
        refuse_damaged_text(table)
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: is no readable {what} ({reason}); write it again.") from error
    if table.num_rows == 0:
        raise InputError(f"{path}: holds no rows; a {what} needs at least one measurement.")
    return table


def column(table: pa.Table, name: str, path: Path) -> pa.ChunkedArray:
    """Return a column that must be there."""
    if name not in table.column_names:
        result = ", ".join(table.column_names)
        raise InputError(f"{path}: column {name} is missing (found {result}); add it.")
    return table[name]


def numbers(table: pa.Table, name: str, path: Path) -> Array:
    """Return a column of finite numbers."""
    result = column(table, name, path)
    if not (pa.types.is_floating(result.type) or pa.types.is_integer(result.type)):
        raise InputError(f"{path}: column {name} holds {result.type}; write numbers.")
    value = np.asarray(result.to_numpy(), dtype=np.float64)
    refuse_rows(~np.isfinite(value), path, f"column {name}", value, "a finite number")
    return value


def integers(table: pa.Table, name: str, path: Path) -> IntArray:
    """Return a column of integers."""
    value = numbers(table, name, path)
    refuse_rows(value != np.round(value), path, f"column {name}", value, "an integer")
    return value.astype(np.int64)


def refuse_rows(bad: np.ndarray, path: Path, place: str, value: np.ndarray, wanted: str) -> None:
    """Refuse a table for its first row that is bad."""
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"{path}: {place}, row {row}: found {value[row]}; write {wanted}.")


def has_angles(names: list[str]) -> bool:
    """Return whether attitudes are roll, pitch and yaw rather than quaternions."""
    return bool(set(ANGLES) & set(names)) and not set(QUATERNION) & set(names)


def poses(table: pa.Table, path: Path) -> tuple[Array, Array]:
    """Return positions (n, 3) (m) and attitudes (n, 3, 3), by quaternions or by angles.

    Raises InputError where a column is missing, a position is beyond the Earth, or a quaternion is
    not of unit length.
    """
    position = np.stack([numbers(table, name, path) for name in POSITION], axis=1)
    farthest = np.max(np.abs(position), axis=1)
    wanted = f"a position in m, at most {MAX_POSITION:g}"
    refuse_rows(farthest > MAX_POSITION, path, "columns of the position", farthest, wanted)
    if has_angles(table.column_names):
        angles = np.stack([numbers(table, name, path) for name in ANGLES], axis=1)
        return position, Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    quaternion = np.stack([numbers(table, name, path) for name in QUATERNION], axis=1)
    length = np.linalg.norm(quaternion, axis=1)
    place = "columns qw to qz"
    refuse_rows(np.abs(length - 1.0) > 1e-3, path, place, length, "unit length")
    return position, Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
