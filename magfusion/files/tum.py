"""Trajectories as text, as the TUM RGB-D benchmark lays them out: time x y z qx qy qz qw.

Positions alone are lines of time x y z.
"""

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file
from magfusion.files.lost_rows import copied_rows, copies_findings, copies_text
from magfusion.files.pose_rows import PoseRows
from magfusion.files.table import MAX_NUMBER, MAX_TIME_NS, Span
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict
from magfusion.units import NS_PER_S

# Exponents of ten of a second; a stamp beyond the year 2100 in seconds is in a smaller unit.
TIME_UNITS = {"s": 0, "ms": -3, "us": -6, "ns": -9}
_MAX_UNIX_S = 4.1e9
_COLUMNS = "time_s x y z qx qy qz qw"
_POSITIONS = "time_s x y z"
_EIGHT = f"eight numbers: {_COLUMNS}"


def write_tum(trajectory: Trajectory, path: Path, epoch_ns: int) -> None:
    """Write the poses as a TUM file, which evo reads; times are on the log's clock."""
    stamps = Span(epoch_ns).stamps(trajectory.time).tolist()
    parts = [trajectory.position_world]
    if trajectory.has_attitude:
        parts.append(trajectory.rotation.as_quat())
    poses = np.hstack(parts).tolist()
    with whole_file(path) as unfinished, unfinished.open("w", encoding="utf-8") as stream:
        stream.write(f"# {_COLUMNS if trajectory.has_attitude else _POSITIONS}\n")
        for stamp, pose in zip(stamps, poses, strict=True):
            # A double cannot hold today's date to the nanosecond, decimal digits can.
            time = f"{Decimal(stamp).scaleb(-9):.9f}"
            stream.write(" ".join([time, *(f"{value:.9f}" for value in pose)]) + "\n")


def read_tum(path: Path, epoch_ns: int = 0, findings: list[Finding] | None = None) -> Trajectory:
    """Read and check a TUM file; times are seconds since ``epoch_ns``.

    Attitudes of a file with positions alone are NaN. Raises InputError where the file is absent,
    not text, empty, a line does not hold eight numbers (or four, of positions alone: as many as the
    first line), no line or too few a pose, or the times do not increase. `findings`: receives the
    number of lines without a pose, or that were written twice, which are left out; without it they
    are refused.
    """
    lines = _lines(path)
    count = len(_POSITIONS.split() if len(lines[0][1].split()) == 4 else _COLUMNS.split())
    numbers = np.array([_numbers(path, number, text, count) for number, text in lines])
    values, unit = numbers[:, 1:], tum_time_unit(np.max(np.abs(numbers[:, 0])))
    stamps = np.array([_stamp(path, number, text, unit) for number, text in lines], dtype=np.int64)
    if findings is not None and (copies := copied_rows(stamps, values)).any():
        findings += copies_findings([copies_text(str(path), copies)])
        lines = [line for line, copy in zip(lines, copies, strict=True) if not copy]
        values, stamps = values[~copies], stamps[~copies]
    time = Span(epoch_ns).seconds(stamps)
    for k in np.flatnonzero(np.diff(time) <= 0.0)[:1]:
        _refuse(path, lines[k + 1][0], f"time {lines[k + 1][1].split()[0]}", "increasing times")
    poses = PoseRows.of(values[:, :3], None if count == 4 else values[:, 3:])
    for k in np.flatnonzero(poses.refused)[:1]:
        result = f"a quaternion of length {poses.length[k]:.6g}"
        _refuse(path, lines[k][0], result, "one of length 1")
    for k in np.flatnonzero(~poses.kept & (findings is None))[:1]:
        _refuse(path, lines[k][0], repr(lines[k][1][:60]), "a pose")
    if not poses.kept.any():
        raise InputError(f"{path}: none of its {len(lines)} lines has a pose; record it again.")
    if findings is not None:
        if unit != "s":
            text = f"{path.name}: its times are read as {unit}; in s they are no dates."
            findings.append(Finding("stamp_resolution", text, Verdict.TRUSTWORTHY))
        findings += poses.findings(path.name)
    time, position = time[poses.kept], values[poses.kept, :3]
    if poses.quaternion is None:
        return Trajectory(time, np.full((len(time), 3, 3), np.nan), position)
    rotation = Rotation.from_quat(poses.quaternion[poses.kept]).as_matrix()
    return Trajectory(time, rotation, position)


def tum_time_unit(largest: float) -> str:
    """Return the unit in which the largest stamp of a file is no date beyond 2100; else s."""
    fitting = [name for name, power in TIME_UNITS.items() if largest * 10.0**power < _MAX_UNIX_S]
    return fitting[0] if fitting else "s"


def _lines(path: Path) -> list[tuple[int, str]]:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the path of a TUM trajectory.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error}); give a TUM file.") from error
    numbered = enumerate(text.splitlines(), 1)
    lines = [(n, t) for n, line in numbered if (t := line.strip()) and not t.startswith("#")]
    if not lines:
        raise InputError(f"{path}: holds no poses; write lines of {_COLUMNS}.")
    return lines


def _numbers(path: Path, number: int, text: str, count: int) -> list[float]:
    """Return time, position and quaternion; NaN for what is not finite."""
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not abs(values[0]) < MAX_NUMBER:
        wanted = f"four numbers: {_POSITIONS}" if count == 4 else _EIGHT
        _refuse(path, number, repr(text[:60]), wanted)
    return [value if abs(value) < MAX_NUMBER else np.nan for value in values]


def _stamp(path: Path, number: int, text: str, unit: str) -> int:
    try:
        stamp = round(Decimal(text.split()[0]).scaleb(TIME_UNITS[unit]) * NS_PER_S)
    except InvalidOperation:
        stamp = MAX_TIME_NS + 1
    if abs(stamp) > MAX_TIME_NS:
        _refuse(path, number, f"time {text.split()[0]}", "seconds")
    return stamp


def _refuse(path: Path, number: int, result: str, wanted: str) -> None:
    raise InputError(f"{path}: line {number}: found {result}; write {wanted}.")
