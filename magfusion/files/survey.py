"""A fingerprint survey: what a magnetometer measured at points with a known pose."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from scipy.spatial.transform import Rotation

from magfusion.files.atomic import whole_file
from magfusion.files.plain_table import (
    POSITION,
    QUATERNION,
    column,
    integers,
    numbers,
    poses,
    read_whole,
    refuse_rows,
)
from magfusion.model.magnetometer import Magnetometer
from magfusion.units import Array, ComplexArray, IntArray

_PHASOR = ("re_x", "re_y", "re_z", "im_x", "im_y", "im_z")
_POSE = (*POSITION, *QUATERNION)


@dataclass(frozen=True, eq=False)
class Survey:
    """Fields at surveyed points; a channel is one tone of one beacon, NaN where it is missing."""

    point: IntArray  # (n,), number of each point
    position_world: Array  # (n, 3) (m)
    world_from_body: Array  # (n, 3, 3)
    channels: tuple[tuple[str, int], ...]  # beacon name and tone
    sigma: Array  # (n, channels), standard deviation of each component, or of the amplitude (T)
    phasor_sensor: ComplexArray | None = None  # (n, channels, 3) (T)
    # (n, channels), root mean square of the field over time (T), in a survey that holds no phasors
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


def read_survey(path: Path, list_of_poses: Path | None = None) -> Survey:
    """Read and check a survey in Parquet or CSV.

    `list_of_poses`: table with the pose of each ``point``, as a turntable or a robot gives them,
    where the survey's rows have none. Raises InputError where a column is missing or of the wrong
    type, a number is not finite, an amplitude or sigma is not positive, a quaternion is not of unit
    length, a row is repeated, the rows of one point disagree on its pose, or a point is not in the
    list of poses.
    """
    table = read_whole(path, "survey")
    pose = None if list_of_poses is not None else poses(table, path)
    values = ("amplitude",) if "amplitude" in table.column_names else _PHASOR
    number = {name: numbers(table, name, path) for name in (*values, "sigma")}
    for name in {"amplitude", "sigma"} & number.keys():
        refuse_rows(number[name] <= 0.0, path, f"column {name}", number[name], "a positive number")
    for name, value in number.items():
        large = np.abs(value) > Magnetometer.field_range
        wanted = f"a field in T, at most {Magnetometer.field_range:g}"
        refuse_rows(large, path, f"column {name}", value, wanted)
    point, tone = (integers(table, name, path) for name in ("point", "tone"))
    refuse_rows(tone < 0, path, "column tone", tone, "an integer from 0")
    names = [str(name) for name in column(table, "beacon", path).to_pylist()]
    if list_of_poses is not None:
        pose = _listed(point, path, list_of_poses)
    assert pose is not None
    return _arranged(path, point, list(zip(names, tone.tolist(), strict=True)), number, *pose)


def _listed(point: IntArray, path: Path, list_of_poses: Path) -> tuple[Array, Array]:
    """Return the poses of points by a list of them."""
    table = read_whole(list_of_poses, "list of poses")
    known = integers(table, "point", list_of_poses)
    position, attitude = poses(table, list_of_poses)
    repeated = np.ones(len(known), dtype=bool)
    repeated[np.unique(known, return_index=True)[1]] = False
    refuse_rows(repeated, list_of_poses, "column point", known, "one row per point")
    wanted = f"a point that {list_of_poses} has"
    refuse_rows(~np.isin(point, known), path, "column point", point, wanted)
    order = np.argsort(known)
    rows = order[np.searchsorted(known[order], point)]
    return position[rows], attitude[rows]


def _arranged(
    path: Path,
    point: IntArray,
    channel: list[tuple[str, int]],
    number: dict[str, Array],
    position: Array,
    attitude: Array,
) -> Survey:
    channels = tuple(dict.fromkeys(channel))
    points, first, row = np.unique(point, return_index=True, return_inverse=True)
    own = np.array([channels.index(c) for c in channel])
    cell = row * len(channels) + own
    repeated = np.ones(len(cell), dtype=bool)
    repeated[np.unique(cell, return_index=True)[1]] = False
    wanted = "one row per point and channel"
    refuse_rows(repeated, path, "columns point, beacon, tone", point, wanted)
    pose = np.hstack([position, attitude.reshape(-1, 9)])
    moved = (pose != pose[first][row]).any(axis=1)
    refuse_rows(moved, path, "pose of column point", point, "the same pose in all rows of a point")

    def grid(value: Array | ComplexArray) -> Array | ComplexArray:
        filled = np.full((len(points), len(channels), *value.shape[1:]), np.nan, dtype=value.dtype)
        filled[row, own] = value
        return filled

    phasor = None
    if "amplitude" not in number:
        real, imaginary = (np.stack([number[k] for k in h], 1) for h in (_PHASOR[:3], _PHASOR[3:]))
        phasor = np.asarray(grid(real + 1j * imaginary), dtype=np.complex128)
    return Survey(
        point=points,
        position_world=position[first],
        world_from_body=attitude[first],
        channels=channels,
        sigma=np.asarray(grid(number["sigma"]).real),
        phasor_sensor=phasor,
        amplitude=np.asarray(grid(number["amplitude"]).real) if phasor is None else None,
    )
