"""Alignment of an estimate with a truth: world, clock, and the tracked point of the body."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import gtsam
import numpy as np
from scipy.signal import correlate, correlation_lags
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.solve.bounded import minimise_between
from magfusion.model.field import skew
from magfusion.model.trajectory import Trajectory, interpolated
from magfusion.results.association import AssociatedPoses, associate
from magfusion.units import Array

Alignment = Literal["none", "se3", "yaw"]
MIN_CORRELATION = 0.6  # of the motions at the offset of the clocks; others are chance
MIN_OVERLAP = 0.2  # of the shorter one, at any offset that is tried
MIN_RATE = 0.05  # rad/s, standard deviation; a body that turns less shows no offset
MIN_EXTENT = 0.05  # m; of a path, whose rotation the noise of positions would otherwise make
MIN_STEP = 0.005  # s; of the search
TIME_TOLERANCE = 1e-5  # s; a walk moves by 10 um in it


def tracked_point(
    estimate: Trajectory, lever_body: Sequence[float], mounting: Rotation
) -> Trajectory:
    """Return the poses of the frame that the truth tracks, with their covariance.

    Parameters
    ----------
    lever_body : sequence of float
        From the body to the tracked point, three numbers (m).
    mounting : Rotation
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

    Parameters
    ----------
    truth : Trajectory
        Of a body forward, right, down in a world north, east, down.
    """
    enu_from_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    frd_from_flu = np.diag([1.0, -1.0, -1.0])
    rotation = enu_from_ned @ truth.world_from_body @ frd_from_flu
    return Trajectory(truth.time, rotation, truth.position_world @ enu_from_ned.T)


def align_world(estimate: Trajectory, pairs: AssociatedPoses, kind: Alignment) -> Trajectory:
    """Return an estimate moved to fit the positions of pairs best, or else their attitudes.

    Parameters
    ----------
    kind : {"none", "se3", "yaw"}
        Rotation and translation as evo's ``--align`` (Umeyama 1991, no scale), or a rotation about
        the vertical and a translation.

    Raises
    ------
    InputError
        Where the platform hardly moves.
    """
    if kind == "none":
        return estimate
    own, true = pairs.estimate, pairs.truth
    if own.has_position and true.has_position:
        centre, target = own.position_world.mean(axis=0), true.position_world.mean(axis=0)
        extent = float(np.max(np.linalg.norm(true.position_world - target, axis=1), initial=0.0))
        if extent < MIN_EXTENT:
            raise InputError(
                f"--align {kind}: the {len(true.time)} poses of the truth that it uses are within"
                f" {extent:.2g} m of their mean, and {MIN_EXTENT} m is needed; use more poses"
            )
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
    the offset to a step; the least error after alignment refines it.

    Raises
    ------
    InputError
        Where the motions do not determine it.
    """
    own, true = _rates(estimate, truth)
    step = max(MIN_STEP, 0.5 * min(_step(own[0]), _step(true[0])))
    first, second = _even(*own, step), _even(*true, step)
    ones = np.ones_like(first), np.ones_like(second)
    energy = correlate(second**2, ones[0]) * correlate(ones[1], first**2)
    shared = correlate(ones[1], ones[0])
    scale = np.sqrt(np.maximum(energy, 1e-9 * np.max(energy)))
    score = correlate(second, first) / np.where(scale > 0.0, scale, np.inf)
    score[shared < MIN_OVERLAP * min(len(first), len(second))] = 0.0
    best = int(np.argmax(score))
    if score[best] < MIN_CORRELATION:
        raise InputError(
            f"--align-time: the motions of estimate and truth correlate by {score[best]:.2f} at"
            f" most, and {MIN_CORRELATION} is needed; give a part with more motion, or omit it"
        )
    lag = step * float(correlation_lags(len(second), len(first))[best])
    offset = lag + true[0][0] - own[0][0]
    width = 2.0 * max(_step(own[0]), _step(true[0]))

    def cost(change: float) -> float:
        pairs = associate(replace(estimate, time=estimate.time + offset + change), truth)
        return _aligned_rms(pairs) if len(pairs.truth) >= 3 else np.inf

    change, _ = minimise_between(cost, -width, width, TIME_TOLERANCE)
    return offset + change


def _aligned_rms(pairs: AssociatedPoses) -> float:
    moved, true = align_world(pairs.estimate, pairs, "se3"), pairs.truth
    if moved.has_position and true.has_position:
        away = np.linalg.norm(moved.position_world - true.position_world, axis=1)
    else:
        away = (true.rotation.inv() * moved.rotation).magnitude()
    return float(np.sqrt(np.mean(away**2)))


def _rates(
    estimate: Trajectory, truth: Trajectory
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return times and rates of both: of rotation (rad/s) where they show it, or speeds (m/s)."""
    if min(len(estimate), len(truth)) < 3:
        raise InputError("--align-time: estimate and truth need three poses each")
    attitudes = estimate.has_attitude and truth.has_attitude
    positions = estimate.has_position and truth.has_position
    if attitudes:
        both = _turn_rate(estimate), _turn_rate(truth)
        if not positions or min(np.std(rate) for _, rate in both) > MIN_RATE:
            return both
    return _speed(estimate), _speed(truth)


def _turn_rate(poses: Trajectory) -> tuple[Array, Array]:
    turn = (poses.rotation[:-1].inv() * poses.rotation[1:]).magnitude()
    return _middles(poses.time), turn / np.diff(poses.time)


def _speed(poses: Trajectory) -> tuple[Array, Array]:
    moved = np.linalg.norm(np.diff(poses.position_world, axis=0), axis=1)
    return _middles(poses.time), moved / np.diff(poses.time)


def _middles(time: Array) -> Array:
    return 0.5 * (time[:-1] + time[1:])


def _step(time: Array) -> float:
    return float(np.median(np.diff(time)))


def _even(time: Array, value: Array, step: float) -> Array:
    """Return a series at even steps, without its mean."""
    even = np.arange(time[0], time[-1], step)
    result = interpolated(even, time, value[:, None])[:, 0]
    return result - np.mean(result)
