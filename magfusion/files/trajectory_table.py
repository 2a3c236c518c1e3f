"""Trajectories as tables: the truth of a log, and the estimate."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from magfusion.files.lost_rows import copied_rows, copies_findings, copies_text
from magfusion.files.pose_rows import QUATERNION_TOLERANCE, PoseRows
from magfusion.files.table import TIME, TWICE, Span, Table, TableLayout, read_table, write_table
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, StateTrust
from magfusion.units import Array, IntArray

_POSITION = ("position_x", "position_y", "position_z")
QUATERNION = ("qw", "qx", "qy", "qz")
_VELOCITY = ("velocity_x", "velocity_y", "velocity_z")
_GYRO_BIAS = ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")
_ACCEL_BIAS = ("accel_bias_x", "accel_bias_y", "accel_bias_z")
_UPPER = np.triu_indices(6)
_COV = tuple(f"cov_{i}{j}" for i, j in zip(*_UPPER, strict=True))
_LAYOUT = TableLayout(
    numbers=(),
    some=(*_POSITION, *QUATERNION),
    optional=(_POSITION, QUATERNION, _VELOCITY, _GYRO_BIAS, _ACCEL_BIAS, _COV),
)
_UNIT_LENGTH = "the length of a rotation's quaternion is 1: scale it"


def write_trajectory(
    trajectory: Trajectory, path: Path, epoch_ns: int, trust: StateTrust | None = None
) -> None:
    """Write a trajectory as Parquet: ``trajectory.parquet`` of a run, ``truth.parquet`` of a log.

    Parts that the trajectory does not have are left out. `trust`: of each state: ``verdict``,
    ``protection_level_m`` and ``protection_level_deg`` (null where there is none), and ``excluded``
    (names of beacons).
    """
    columns = trajectory_columns(trajectory, epoch_ns)
    if trust is not None:
        columns |= trust_columns(trust, np.arange(len(trust.verdict)))
    write_table(columns, path)


def trajectory_columns(trajectory: Trajectory, epoch_ns: int) -> dict[str, object]:
    """Return the columns of a trajectory's table; parts that it does not have are left out."""
    quaternion = None
    if trajectory.has_attitude:
        quaternion = trajectory.rotation.as_quat(scalar_first=True)
    parts: list[tuple[tuple[str, ...], Array | None]] = [
        (_POSITION, trajectory.position_world if trajectory.has_position else None),
        (QUATERNION, quaternion),
        (_VELOCITY, trajectory.velocity_world),
        (_GYRO_BIAS, trajectory.gyro_bias_body),
        (_ACCEL_BIAS, trajectory.accel_bias_body),
        (_COV, None if trajectory.pose_cov is None else trajectory.pose_cov[:, *_UPPER]),
    ]
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(trajectory.time)}
    for names, values in parts:
        if values is not None:
            columns |= dict(zip(names, values.T, strict=True))
    return columns


def trust_columns(trust: StateTrust, rows: IntArray) -> dict[str, object]:
    """Return verdict, levels and exclusions of some states as columns of a table."""
    chosen = rows.tolist()
    return {
        "verdict": [str(trust.verdict[i]) for i in chosen],
        "protection_level_m": pa.array(trust.protection_level_m[rows], from_pandas=True),
        "protection_level_deg": pa.array(trust.protection_level_deg[rows], from_pandas=True),
        "excluded": pa.array([trust.excluded[i] for i in chosen], type=pa.list_(pa.string())),
    }


def read_trajectory(
    path: Path,
    epoch_ns: int,
    start: float | None = None,
    end: float | None = None,
    content: pa.Table | None = None,
    findings: list[Finding] | None = None,
) -> Trajectory:
    """Read and check a trajectory in Parquet or CSV, within start <= time < end (s).

    A truth may have positions alone or attitudes alone; the other part is NaN then.

    ``content`` as in `read_table`. `findings`: receives the number of rows without a pose, or that
    are copies of others, which are left out; without it they are refused.
    """
    layout = _LAYOUT._replace(repeats=findings is not None)
    table = read_table(path, layout, Span(epoch_ns, start, end), content)
    if findings is not None:
        table = _with_poses(_without_copies(table, findings), findings)
    rotation, position = np.full((len(table), 3, 3), np.nan), _numbers(table, _POSITION)
    if table.has(QUATERNION):
        rotation = unit_rotation(table).as_matrix()
    cov = _numbers(table, _COV)
    return Trajectory(
        time=table.time,
        world_from_body=rotation,
        position_world=np.full((len(table), 3), np.nan) if position is None else position,
        velocity_world=_numbers(table, _VELOCITY),
        gyro_bias_body=_numbers(table, _GYRO_BIAS),
        accel_bias_body=_numbers(table, _ACCEL_BIAS),
        pose_cov=None if cov is None else _symmetric(cov),
    )


def _without_copies(table: Table, findings: list[Finding]) -> Table:
    """Return a table without rows that were written twice; refuse others of one time."""
    names = [name for name in table.data.column_names if name != TIME]
    copies = copied_rows(table.time_ns, table.numbers(names, nan=True))
    twice = (np.diff(table.time_ns, prepend=table.time_ns[:1] - 1) == 0) & ~copies
    table.refuse(twice, TIME, table.time_ns, TWICE)
    if not copies.any():
        return table
    findings += copies_findings([copies_text(str(table.path), copies)])
    once = ~copies
    data = table.data.filter(pa.array(once))
    return replace(table, data=data, time_ns=table.time_ns[once], time=table.time[once])


def unit_rotation(table: Table) -> Rotation:
    """Return the rotations of a table's rows; refuse quaternions that are not of unit length."""
    quaternion = table.numbers(QUATERNION)
    length = np.linalg.norm(quaternion, axis=1)
    off = np.abs(length - 1.0) > QUATERNION_TOLERANCE
    table.refuse(off, "qw to qz", length, _UNIT_LENGTH)
    return Rotation.from_quat(quaternion, scalar_first=True)


def _with_poses(table: Table, findings: list[Finding]) -> Table:
    """Return the rows of a table that have a pose, with quaternions of unit length."""
    names = _POSITION if table.has(_POSITION) else ()
    quaternion = table.numbers(QUATERNION, nan=True) if table.has(QUATERNION) else None
    poses = PoseRows.of(table.numbers(names, nan=True), quaternion)
    table.refuse(poses.refused, "qw to qz", poses.length, _UNIT_LENGTH)
    findings += poses.findings("truth" if table.path.stem in ("truth", "data") else table.path.name)
    data = table.data
    quaternions = () if poses.quaternion is None else poses.quaternion.T
    for name, values in zip(QUATERNION, quaternions, strict=False):
        data = data.set_column(data.column_names.index(name), name, pa.array(values.copy()))
    stamps, omitted = table.time_ns, np.flatnonzero(~poses.kept)
    return replace(
        table,
        data=data.filter(pa.array(poses.kept)),
        time_ns=stamps[poses.kept],
        time=table.time[poses.kept],
        stray=tuple(
            zip((table.first_row + omitted).tolist(), stamps[omitted].tolist(), strict=True)
        ),
    )


def _numbers(table: Table, names: tuple[str, ...]) -> Array | None:
    return table.numbers(names) if table.has(names) else None


def _symmetric(upper: Array) -> Array:
    matrix = np.zeros((len(upper), 6, 6))
    matrix[:, *_UPPER] = upper
    matrix[:, _UPPER[1], _UPPER[0]] = upper
    return matrix
