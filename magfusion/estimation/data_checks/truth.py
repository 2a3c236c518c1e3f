"""Check of a truth with the gyroscope, the specific force and the direction of gravity.

A truth is no part of an estimate: what is wrong with it is a remark that explains the errors.
"""

from collections.abc import Iterator

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation, Slerp

from magfusion.model.samples import Log
from magfusion.model.strapdown import attitude_from_gyro_at
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict
from magfusion.units import DEGREE, Array, IntArray

SPAN = 0.5  # s; between two attitudes that are compared
MIN_SPANS = 10
MAX_GAP = 2.0  # s; between them, over which the bias of a gyroscope makes no rotation
MAX_IMU_STEP = 0.1  # s; of inertial samples, in a gap of which nothing is compared
MIN_ROTATION = 0.03  # rad in a span; a body that turns less shows nothing
FROZEN = 0.05  # of the gyroscope's rotation; a truth that turns less has stopped
FROZEN_SHARE = 0.1  # of the spans with a rotation
TOLERANCE, TOLERANCE_SHARE = 0.02, 0.25  # rad, and of the rotation; gyroscopes do better
MAX_TILT = 5.0 * DEGREE  # of the mean specific force; accelerometers and motion do better
DOWN = 150.0 * DEGREE
DOWN_AXES = np.diag([1.0, -1.0, -1.0])
CONVENTION = 15.0 * DEGREE  # from the axes of a convention
BODY_DOWN = "its body axes are forward, right, down (as with NED). Turn them to z up."
NED = (
    "its world is north, east, down and its body forward, right, down (NED). Turn both to z up, or"
    " evaluate with --truth-axes ned."
)
MAX_DELAY, DELAY_STEP = 1.0, 0.01  # s; searched either way, and in steps
MIN_DELAY = 0.03  # s; filters of gyroscopes delay by less
EXPLAINED = 0.5  # of the squared errors that a delay leaves
MIN_CORRELATION = 0.8  # of accelerations along the axis of least motion; noise has none
# The components w, x, y, z that are meant, by their places among those that were read.
ORDERS = {
    "w, x, y, z read as x, y, z, w": ((1, 2, 3, 0), "wxyz"),
    "x, y, z, w read as w, x, y, z": ((3, 0, 1, 2), "xyzw"),
}


def truth_findings(log: Log) -> Iterator[Finding]:
    """Yield the remarks on a log's truth that contradicts its inertial samples."""
    truth = log.truth
    if truth is None or not truth.has_attitude or not log.inertial or len(log.imu) < MIN_SPANS:
        return
    after = np.searchsorted(log.imu.time, truth.time).clip(1, len(log.imu) - 1)
    before, later = log.imu.time[after - 1], log.imu.time[after]
    inside = (truth.time >= before) & (truth.time <= later) & (later - before < MAX_IMU_STEP)
    poses = _rows(truth, np.flatnonzero(inside))
    rows = attitude_spans(poses.time)
    turn = attitude_from_gyro_at(log.imu.time, log.imu.gyro_body, poses.time)
    text = ""
    if len(rows) >= MIN_SPANS:
        gyro = (turn[rows[:, 0]].inv() * turn[rows[:, 1]]).as_rotvec()
        text = _delay_text(log, poses, rows) or _rotation_text(poses.rotation, rows, gyro)
    text = text or _gravity_text(log, poses) or _mirrored_text(log, poses, rows)
    if text == BODY_DOWN and _tilt(log, _z_up(poses)) > DOWN:
        text = NED
    if text and np.array_equal(truth.world_from_body, np.tile(np.eye(3), (len(truth), 1, 1))):
        text = "it never rotates, so it is a truth of positions alone. Omit its quaternion."
    if text:
        yield _finding(text)


def _finding(text: str) -> Finding:
    return Finding(
        "truth_inconsistent",
        f"truth: {text} Errors against it are not those of the estimate.",
        Verdict.TRUSTWORTHY,
        50.0,
    )


def _rows(truth: Trajectory, rows: IntArray) -> Trajectory:
    return Trajectory(truth.time[rows], truth.world_from_body[rows], truth.position_world[rows])


def attitude_spans(time: Array) -> IntArray:
    """Return pairs of samples about `SPAN` apart, shape (m, 2)."""
    after = np.searchsorted(time, time + SPAN)
    first = np.flatnonzero(after < len(time))
    pairs = np.stack([first, after[first]], axis=1)
    return pairs[time[pairs[:, 1]] - time[pairs[:, 0]] < MAX_GAP]


def _delay_text(log: Log, truth: Trajectory, rows: IntArray) -> str:
    """Return by how much the truth's clock is late, where that makes its turn the gyroscope's."""
    time, gyro = log.imu.time, log.imu.gyro_body
    begin, end = truth.time[rows].T
    inside = (begin > time[0] + MAX_DELAY) & (end < time[-1] - MAX_DELAY)
    rows, begin, end = rows[inside], begin[inside], end[inside]
    if len(rows) < MIN_SPANS or end[-1] - begin[0] < MIN_SPANS * SPAN:
        return ""
    angle = cumulative_trapezoid(gyro, time, axis=0, initial=0.0)
    change = rotation_changes(truth.rotation, rows)
    delays = np.arange(-MAX_DELAY, MAX_DELAY + 0.5 * DELAY_STEP, DELAY_STEP)
    errors = np.empty(len(delays))
    for k, delay in enumerate(delays):
        turn = (
            np.interp(end - delay, time, axis) - np.interp(begin - delay, time, axis)
            for axis in angle.T
        )
        off = change - np.stack(list(turn), axis=1)
        errors[k] = np.mean(np.var(off, axis=0))  # a bias of the gyroscope is the mean
    best, now = int(np.argmin(errors)), errors[len(delays) // 2]
    before, least, after = errors[np.clip([best - 1, best, best + 1], 0, len(delays) - 1)]
    bend = max(before - 2.0 * least + after, 1e-30)
    delay = float(delays[best] + 0.5 * DELAY_STEP * (before - after) / bend)
    if abs(delay) < MIN_DELAY or abs(delay) > MAX_DELAY - DELAY_STEP:
        return ""
    if least > EXPLAINED * now or now - least < np.var(change) / len(rows):
        return ""
    return (
        f"its clock is {1e3 * abs(delay):.0f} ms {'late' if delay > 0.0 else 'early'} against the"
        f" gyroscope. Import it with --offset truth={-delay:.3f}, or evaluate with --align-time."
    )


def _mirrored_text(log: Log, truth: Trajectory, rows: IntArray) -> str:
    """Return whether its positions accelerate as the mirror image of the specific force."""
    if not truth.has_position or len(rows) < MIN_SPANS:
        return ""
    imu, known = log.imu, truth.time
    between = (imu.time >= known[0]) & (imu.time <= known[-1])
    if not np.any(between):
        return ""
    time = imu.time[between]
    force = Slerp(known, truth.rotation)(time).apply(imu.accel_body[between])
    path = force - force.mean(axis=0)
    for _ in range(2):
        path = cumulative_trapezoid(path, time, axis=0, initial=0.0)
    inertial = np.stack([np.interp(known, time, axis) for axis in path.T], axis=1)
    length = int(np.median(rows[:, 1] - rows[:, 0]))
    span = known[2 * length :] - known[: -2 * length]
    even = np.abs(span - np.median(span)) < 0.01 * SPAN
    if np.sum(even) < MIN_SPANS or known[-1] - known[0] < MIN_SPANS * SPAN:
        return ""
    bends = (
        p[2 * length :] - 2.0 * p[length:-length] + p[: -2 * length]
        for p in (truth.position_world, inertial)
    )
    moved, expected = (bend[even] - bend[even].mean(axis=0) for bend in bends)
    columns, size, rows_t = np.linalg.svd(moved.T @ expected)
    axes = columns @ rows_t
    norms = np.linalg.norm(moved @ columns[:, 2]) * np.linalg.norm(expected @ rows_t[2])
    if np.linalg.det(axes) > 0.0 or size[2] < MIN_CORRELATION * norms:
        return ""
    axis = "xyz"[int(np.argmin(np.diag(axes)))]
    return (
        f"its positions are mirrored along {axis}: they accelerate as a left-handed copy of the"
        f" specific force. Change the sign of its {axis}, e.g. by --map."
    )


def _rotation_text(attitude: Rotation, rows: IntArray, gyro: Array) -> str:
    """Return how rotations of the truth differ from those of the gyroscope (m, 3) (rad)."""
    size = np.linalg.norm(gyro, axis=1)
    active = (size > MIN_ROTATION) & (size < 0.5 * np.pi)
    if np.sum(active) < MIN_SPANS:
        return ""
    rows, gyro, size = rows[active], gyro[active], size[active]
    change = rotation_changes(attitude, rows)
    still = np.linalg.norm(change, axis=1) < FROZEN * size
    if np.mean(still) > FROZEN_SHARE:
        return (
            f"its attitude is frozen in {100.0 * np.mean(still):.0f} % of the time in which the"
            " gyroscope turns. Use another part of it, or repair its recording."
        )
    rows, gyro, change = rows[~still], gyro[~still], change[~still]
    if _agrees(change, gyro):
        return ""
    return _cause(attitude, rows, gyro, change) or (
        "its rotation is not that of the gyroscope. Check the order of its quaternion, its"
        " clock, and whether it is world_from_body."
    )


def _cause(attitude: Rotation, rows: IntArray, gyro: Array, change: Array) -> str:
    """Return the convention that makes rotations of the truth those of the gyroscope."""
    convention = quaternion_text(attitude, rows, gyro)
    if convention:
        return convention
    columns, _, rows_t = np.linalg.svd(change.T @ gyro)
    body = columns @ np.diag([1.0, 1.0, np.linalg.det(columns @ rows_t)]) @ rows_t
    if not _agrees(change @ body, gyro):
        return ""
    angle = float(Rotation.from_matrix(body).magnitude()) / DEGREE
    from_down = Rotation.from_matrix(body @ DOWN_AXES).magnitude()
    if from_down < CONVENTION:
        return BODY_DOWN
    return (
        f"its body axes are turned against the IMU's by {angle:.0f} deg. Turn its attitudes"
        " into the axes of the IMU."
    )


def quaternion_text(attitude: Rotation, rows: IntArray, rotations: Array) -> str:
    """Return the order or the direction of its quaternion in which a truth turns as others do.

    `rows`: pairs of its samples, shape (m, 2). `rotations`: rotation vectors between them in body
    axes, of a gyroscope or an estimate, shape (m, 3) (rad).
    """
    size = np.linalg.norm(rotations, axis=1)
    active = (size > MIN_ROTATION) & (size < 0.5 * np.pi)
    rows, rotations = rows[active], rotations[active]
    if len(rows) < MIN_SPANS or _agrees(rotation_changes(attitude, rows), rotations):
        return ""
    for name, (places, order) in ORDERS.items():
        meant = Rotation.from_quat(
            attitude.as_quat(scalar_first=True)[:, places], scalar_first=True
        )
        if _agrees(rotation_changes(meant, rows), rotations):
            return (
                f"its quaternion is in another order: {name}. Import it with --map"
                f" 'truth.quaternion=NAMES[{order}]'."
            )
    if _agrees(rotation_changes(attitude.inv(), rows), rotations):
        return (
            "its attitudes are body_from_world. Import it with inverted signs: --map"
            " 'truth.quaternion=-QX,-QY,-QZ,QW[xyzw]', with the names of its columns."
        )
    return ""


def rotation_changes(attitude: Rotation, rows: IntArray) -> Array:
    """Return rotation vectors over spans in body axes, shape (m, 3) (rad)."""
    return np.asarray((attitude[rows[:, 0]].inv() * attitude[rows[:, 1]]).as_rotvec())


def _agrees(change: Array, gyro: Array) -> bool:
    limit = np.maximum(TOLERANCE, TOLERANCE_SHARE * np.linalg.norm(gyro, axis=1))
    return float(np.mean(np.linalg.norm(change - gyro, axis=1) < limit)) > 0.5


def _gravity_text(log: Log, truth: Trajectory) -> str:
    """Return how the mean specific force in the truth's world differs from the vertical."""
    if len(truth) < MIN_SPANS or truth.time[-1] - truth.time[0] < MIN_SPANS * SPAN:
        return ""
    tilt = _tilt(log, truth)
    if tilt > DOWN:
        return "the z axis of its world points down (as in NED). Turn it to z up."
    if tilt > MAX_TILT:
        other = _tilt(log, _z_up(truth))
        if min(other, np.pi - other) < MAX_TILT:
            return NED if other > MAX_TILT else BODY_DOWN
        return (
            f"the vertical of its world is turned by {tilt / DEGREE:.0f} deg from gravity. Turn"
            " its poses into the world of the site, z up."
        )
    return ""


def _tilt(log: Log, truth: Trajectory) -> float:
    """Return the angle between the mean specific force in the truth's world and its z (rad)."""
    force = [np.interp(truth.time, log.imu.time, axis) for axis in log.imu.accel_body.T]
    mean = np.mean(truth.rotation.apply(np.stack(force, axis=1)), axis=0)
    return float(np.arccos(np.clip(mean[2] / np.linalg.norm(mean), -1.0, 1.0)))


def _z_up(truth: Trajectory) -> Trajectory:
    """Return poses of a body forward, left, up, where those of one forward, right, down are."""
    return Trajectory(truth.time, truth.world_from_body @ DOWN_AXES, truth.position_world)
