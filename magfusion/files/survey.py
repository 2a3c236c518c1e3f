"""A fingerprint survey: what a magnetometer measured at points with a known pose."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file
from magfusion.units import Array, ComplexArray, IntArray

_POSITION = ("position_x", "position_y", "position_z")
_QUATERNION = ("qw", "qx", "qy", "qz")
_PHASOR = ("re_x", "re_y", "re_z", "im_x", "im_y", "im_z")
_POSE = (*_POSITION, *_QUATERNION)


@dataclass(frozen=True, eq=False)
class Survey:
    """Fields at surveyed points; a channel is one tone of one beacon, NaN where it is missing.

    Parameters
    ----------
    point : ndarray of int, shape (n,)
        Number of each point.
    position_world : ndarray, shape (n, 3)
        (m)
    world_from_body : ndarray, shape (n, 3, 3)
    channels : tuple of (str, int)
        Beacon name and tone.
    sigma : ndarray, shape (n, channels)
        Standard deviation of each component, or of the amplitude (T).
    phasor_sensor : complex ndarray, shape (n, channels, 3), optional
        (T)
    amplitude : ndarray, shape (n, channels), optional
        Root mean square of the field over time (T), in a survey that holds no phasors.
    """

    point: IntArray
    position_world: Array
    world_from_body: Array
    channels: tuple[tuple[str, int], ...]
    sigma: Array
    phasor_sensor: ComplexArray | None = None
    amplitude: Array | None = None

    def __post_init__(self) -> None:
        n, c = len(self.point), len(self.channels)
        shapes = {"position_world": (n, 3), "world_from_body": (n, 3, 3), "sigma": (n, c)}
        shapes |= {"phasor_sensor": (n, c, 3), "amplitude": (n, c)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"{name} must have shape {shape}; got {value.shape}")
        if (self.phasor_sensor is None) == (self.amplitude is None):
            raise ValueError("a survey must hold either phasors or amplitudes")

    def __len__(self) -> int:
        return len(self.point)


def write_survey(survey: Survey, path: Path) -> None:
    """Write a survey, one row per point and channel, as Parquet or as CSV by the path's suffix."""
    rows, columns = np.nonzero(np.isfinite(survey.sigma))
    quaternion = Rotation.from_matrix(survey.world_from_body).as_quat(scalar_first=True)
    pose = np.hstack([survey.position_world, quaternion])[rows]
    data: dict[str, object] = {"point": survey.point[rows]}
    data |= dict(zip(_POSE, pose.T, strict=True))
    data["beacon"] = [survey.channels[c][0] for c in columns]
    data["tone"] = [survey.channels[c][1] for c in columns]
    if survey.phasor_sensor is None:
        assert survey.amplitude is not None
        data["amplitude"] = survey.amplitude[rows, columns]
    else:
        phasor = survey.phasor_sensor[rows, columns]
        parts = np.hstack([phasor.real, phasor.imag]).T
        data |= dict(zip(_PHASOR, parts, strict=True))
    data["sigma"] = survey.sigma[rows, columns]
    table = pa.table(data)
    with whole_file(path) as unfinished:
        if path.suffix == ".csv":
            pa.csv.write_csv(table, unfinished)
        else:
            pa.parquet.write_table(table, unfinished)


def read_survey(path: Path) -> Survey:
    """Read and check a survey in Parquet or CSV.

    Raises
    ------
    InputError
        Where a column is missing or of the wrong type, a number is not finite, an amplitude or
        sigma is not positive, a quaternion is not of unit length, a row is repeated, or the rows
        of one point disagree on its pose.
    """
    table = _read_table(path)
    values = ("amplitude",) if "amplitude" in table.column_names else _PHASOR
    number = {name: _numbers(table, name, path) for name in (*_POSE, *values, "sigma")}
    for name in {"amplitude", "sigma"} & number.keys():
        _refuse(number[name] <= 0.0, path, f"column {name}", number[name], "a positive number")
    point, tone = (_integers(table, name, path) for name in ("point", "tone"))
    _refuse(tone < 0, path, "column tone", tone, "an integer from 0")
    names = [str(name) for name in _column(table, "beacon", path).to_pylist()]
    return _arranged(path, point, list(zip(names, tone.tolist(), strict=True)), number)


def _arranged(
    path: Path, point: IntArray, channel: list[tuple[str, int]], number: dict[str, Array]
) -> Survey:
    channels = tuple(dict.fromkeys(channel))
    points, first, row = np.unique(point, return_index=True, return_inverse=True)
    column = np.array([channels.index(c) for c in channel])
    cell = row * len(channels) + column
    repeated = np.ones(len(cell), dtype=bool)
    repeated[np.unique(cell, return_index=True)[1]] = False
    _refuse(repeated, path, "columns point, beacon, tone", point, "one row per point and channel")
    pose = np.stack([number[name] for name in _POSE], axis=1)
    moved = (pose != pose[first][row]).any(axis=1)
    _refuse(moved, path, "pose of column point", point, "the same pose in all rows of a point")
    quaternion = pose[:, 3:]
    length = np.linalg.norm(quaternion, axis=1)
    _refuse(np.abs(length - 1.0) > 1e-3, path, "columns qw to qz", length, "unit length")

    def grid(value: Array | ComplexArray) -> Array | ComplexArray:
        filled = np.full((len(points), len(channels), *value.shape[1:]), np.nan, dtype=value.dtype)
        filled[row, column] = value
        return filled

    phasor = None
    if "amplitude" not in number:
        real, imaginary = (np.stack([number[k] for k in h], 1) for h in (_PHASOR[:3], _PHASOR[3:]))
        phasor = np.asarray(grid(real + 1j * imaginary), dtype=np.complex128)
    return Survey(
        point=points,
        position_world=pose[first, :3],
        world_from_body=Rotation.from_quat(quaternion[first], scalar_first=True).as_matrix(),
        channels=channels,
        sigma=np.asarray(grid(number["sigma"]).real),
        phasor_sensor=phasor,
        amplitude=np.asarray(grid(number["amplitude"]).real) if phasor is None else None,
    )


def _read_table(path: Path) -> pa.Table:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the path of a survey.")
    try:
        table = pa.csv.read_csv(path) if path.suffix == ".csv" else pa.parquet.read_table(path)
    except (pa.ArrowInvalid, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: is no readable survey ({reason}); write it again.") from error
    if table.num_rows == 0:
        raise InputError(f"{path}: holds no rows; a survey needs at least one measurement.")
    return table


def _column(table: pa.Table, name: str, path: Path) -> pa.ChunkedArray:
    if name not in table.column_names:
        found = ", ".join(table.column_names)
        raise InputError(f"{path}: column {name} is missing (found {found}); add it.")
    return table[name]


def _numbers(table: pa.Table, name: str, path: Path) -> Array:
    column = _column(table, name, path)
    if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
        raise InputError(f"{path}: column {name} holds {column.type}; write numbers.")
    value = np.asarray(column.to_numpy(), dtype=np.float64)
    _refuse(~np.isfinite(value), path, f"column {name}", value, "a finite number")
    return value


def _integers(table: pa.Table, name: str, path: Path) -> IntArray:
    value = _numbers(table, name, path)
    _refuse(value != np.round(value), path, f"column {name}", value, "an integer")
    return value.astype(np.int64)


def _refuse(bad: np.ndarray, path: Path, place: str, value: np.ndarray, wanted: str) -> None:
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"{path}: {place}, row {row}: found {value[row]}; write {wanted}.")
