"""Alignment of an estimate with a truth: world, clock, and the tracked point of the body."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.solve.bounded import minimise_between
from magfusion.model.field import skew
from magfusion.model.trajectory import Trajectory
from magfusion.model.truth_poses import truth_poses
from magfusion.results.association import AssociatedPoses, select_poses
from magfusion.units import Array

Alignment = Literal["none", "se3", "yaw"]
MIN_CORRELATION = 0.6  # of the motions at the offset of the clocks; others are chance
MIN_OVERLAP = 0.5  # of the shorter one, at any offset that is tried
MIN_VARIANCE = 0.1  # of the quieter series; where less moves, the correlation is chance
MIN_RATE = 0.05  # rad/s, standard deviation; a body that turns less shows no offset
MIN_EXTENT = 0.05  # m; of a path, whose rotation the noise of positions would otherwise make
MIN_STEP = 0.005  # s; of the search
TIME_TOLERANCE = 1e-5  # s; a walk moves by 10 um in it


def tracked_point(
    estimate: Trajectory, lever_body: Sequence[float], mounting: Rotation
) -> Trajectory:
    """Return the poses of the frame that the truth tracks, with their covariance.

    `lever_body`: from the body to the tracked point, three numbers (m). `mounting`:
    ``body_from_tracked``.
    """
    lever, body_from_tracked = np.asarray(lever_body), mounting.as_matrix()
    cov = estimate.pose_cov
    if cov is not None:
        jacobian = np.eye(6)
        jacobian[3:, :3] = -skew(lever)
        jacobian = np.kron(np.eye(2), body_from_tracked.T) @ jacobian
        cov = jacobian @ cov @ jacobian.T
    return Trajectory(
        estimate.time,
        estimate.world_from_body @ body_from_tracked,
        estimate.position_world + estimate.world_from_body @ lever,
        pose_cov=cov,
    )


def from_ned(truth: Trajectory) -> Trajectory:
    """Return poses with z up: of a body forward, left, up in a world east, north, up.

    `truth`: of a body forward, right, down in a world north, east, down.
    """
    enu_from_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    frd_from_flu = np.diag([1.0, -1.0, -1.0])
    rotation = enu_from_ned @ truth.world_from_body @ frd_from_flu
    return Trajectory(truth.time, rotation, truth.position_world @ enu_from_ned.T)


def align_world(estimate: Trajectory, pairs: AssociatedPoses, kind: Alignment) -> Trajectory:
    """Return an estimate moved to fit the positions of pairs best, or else their attitudes.

    `kind`: rotation and translation as evo's ``--align`` (Umeyama 1991, no scale), or a rotation
    about the vertical and a translation. Raises InputError where the platform hardly moves.
    """
    if kind == "none":
        return estimate
    if pairs.estimate.has_position and pairs.truth.has_position:
        place = pairs.truth.position_world
        away = np.linalg.norm(place - place.mean(axis=0), axis=1)
        if np.max(away) < MIN_EXTENT:
            raise InputError(
                f"--align {kind}: the {len(place)} poses of the truth that it uses are within"
                f" {np.max(away):.2g} m of their mean, and {MIN_EXTENT} m is needed; use more poses"
            )
    return _moved(estimate, pairs, kind)


def _moved(estimate: Trajectory, pairs: AssociatedPoses, kind: Alignment) -> Trajectory:
    own, true = pairs.estimate, pairs.truth
    if own.has_position and true.has_position:
        centre, target = own.position_world.mean(axis=0), true.position_world.mean(axis=0)
        spread = (true.position_world - target).T @ (own.position_world - centre)
    else:
        centre = target = np.zeros(3)
        spread = np.sum(true.world_from_body @ np.swapaxes(own.world_from_body, 1, 2), axis=0)
    turn = gtsam.Rot3.ClosestTo(spread).matrix() if kind == "se3" else _yaw(spread)
    return replace(
        estimate,
        world_from_body=turn @ estimate.world_from_body,
        position_world=(estimate.position_world - centre) @ turn.T + target,
    )


def _yaw(spread: Array) -> Array:
    angle = np.arctan2(spread[1, 0] - spread[0, 1], spread[0, 0] + spread[1, 1])
    return Rotation.from_euler("z", angle).as_matrix()


def clock_offset(estimate: Trajectory, truth: Trajectory) -> float:
    """Return the constant to add to the estimate's times (s).

    The rates of rotation, or else the speeds, are the same in all frames: their correlation gives
    the offset to a step; the least error after alignment refines it. Raises InputError where the
    motions do not determine it.
    """
    if min(len(estimate), len(truth)) < 3:
        raise InputError("--align-time: estimate and truth need three poses each")
    if _step(estimate.time) < _step(truth.time):
        return -_offset(truth, estimate)
    return _offset(estimate, truth)


def _offset(coarse: Trajectory, fine: Trajectory) -> float:
    """Return the constant to add to the times of the coarser one (s)."""
    span = _step(coarse.time)
    first, second = _rates(coarse, fine, span)
    step = max(MIN_STEP, 0.5 * _step(fine.time))
    score = _correlation(_sparse(*first, step), _even(*second, step))
    best = int(np.argmax(score))
    if score[best] < MIN_CORRELATION:
        raise InputError(
            f"--align-time: the motions of estimate and truth correlate by {score[best]:.2f} at"
            f" most, and {MIN_CORRELATION} is needed; give a part with more motion, or omit it"
        )
    cells = round((first[0][-1] - first[0][0]) / step)
    offset = step * (best - cells) + second[0][0] - first[0][0]

    def cost(change: float) -> float:
        moved = replace(coarse, time=coarse.time + offset + change)
        there, covered, _ = truth_poses(fine, moved.time, any_motion=True)
        pairs = AssociatedPoses(select_poses(moved, covered), there, covered)
        return _aligned_rms(pairs) if len(there) >= 3 else np.inf

    change, _ = minimise_between(cost, -span, span, TIME_TOLERANCE)
    return float(offset + change)


def _correlation(first: tuple[Array, Array], second: Array) -> Array:
    """Return the coefficient of correlation at every lag, of what both series share there.

    `first`: values, and where there is one; at the same even steps as ``second``.
    """
    from scipy.signal import correlate  # takes as long as all else to import

    values, there = first
    ones = np.ones_like(second)
    count = np.maximum(np.rint(correlate(ones, there)), 1.0)
    mean, other_mean = correlate(ones, values) / count, correlate(second, there) / count
    variance = correlate(ones, values**2) / count - mean**2
    other_variance = correlate(second**2, there) / count - other_mean**2
    shared = correlate(second, values) / count - mean * other_mean
    least = MIN_VARIANCE * min(np.var(values[there > 0.0]), np.var(second))
    moves = (variance > least) & (other_variance > least)
    lengths = np.sum(there), len(second) * np.mean(there)
    moves &= count >= MIN_OVERLAP * min(lengths)
    scale = np.sqrt(np.where(moves, variance * other_variance, np.inf))
    return np.asarray(shared / scale)


def _aligned_rms(pairs: AssociatedPoses) -> float:
    moved, true = _moved(pairs.estimate, pairs, "se3"), pairs.truth
    if moved.has_position and true.has_position:
        away = np.linalg.norm(moved.position_world - true.position_world, axis=1)
    else:
        away = (true.rotation.inv() * moved.rotation).magnitude()
    return float(np.sqrt(np.mean(away**2)))


def _rates(
    coarse: Trajectory, fine: Trajectory, span: float
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return times and rates of both: of rotation (rad/s) where they show it, or speeds (m/s)."""
    positions = coarse.has_position and fine.has_position
    if coarse.has_attitude and fine.has_attitude:
        both = _turn_rate(coarse, span), _turn_rate(fine, span)
        if not positions or min(np.std(rate) for _, rate in both) > MIN_RATE:
            return both
    elif not positions:
        raise InputError("--align-time: estimate and truth have neither part of a pose in common")
    return _speed(coarse, span), _speed(fine, span)


def _ends(poses: Trajectory, span: float) -> tuple[slice, slice, Array, Array]:
    """Return first and last rows of spans, their middles and their lengths (s)."""
    rows = min(max(1, round(span / _step(poses.time))), len(poses) - 2)
    begin, end = slice(None, -rows), slice(rows, None)
    first, last = poses.time[begin], poses.time[end]
    return begin, end, 0.5 * (first + last), last - first


def _turn_rate(poses: Trajectory, span: float) -> tuple[Array, Array]:
    begin, end, middle, length = _ends(poses, span)
    return middle, (poses.rotation[begin].inv() * poses.rotation[end]).magnitude() / length


def _speed(poses: Trajectory, span: float) -> tuple[Array, Array]:
    begin, end, middle, length = _ends(poses, span)
    moved = np.linalg.norm(poses.position_world[end] - poses.position_world[begin], axis=1)
    return middle, moved / length


def _step(time: Array) -> float:
    return float(np.median(np.diff(time)))


def _even(time: Array, value: Array, step: float) -> Array:
    """Return a series at even steps, without its mean, which would only round the sums."""
    even = np.arange(time[0], time[-1], step)
    return np.interp(even, time, value) - np.mean(value)


def _sparse(time: Array, value: Array, step: float) -> tuple[Array, Array]:
    """Return a series at even steps with zeros between its samples, and where these are."""
    cells = np.rint((time - time[0]) / step).astype(np.int64)
    values, there = np.zeros(cells[-1] + 1), np.zeros(cells[-1] + 1)
    values[cells], there[cells] = value - np.mean(value), 1.0
    return values, there
