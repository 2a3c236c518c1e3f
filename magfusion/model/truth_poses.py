"""Poses of a truth between its samples, wherever the motion allows that at the truth's rate.

Cubic interpolation: positions and rotation vectors within a step, with the slopes of the parabola
through three samples (Catmull and Rom 1974, for uneven steps).
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.hermite import hermite
from magfusion.model.trajectory import Trajectory
from magfusion.units import DEGREE, Array, BoolArray

SHORT_STEP = 0.1  # s; across which the pose of a body is interpolated whatever its motion
MAX_STEPS = 2.5  # usual steps; across a longer gap the motion is unknown
MAX_POSITION_ERROR = 0.002  # m; of the interpolation, small against what is compared with it
MAX_ROTATION_ERROR = 0.1 * DEGREE
ORDER = 3  # of the error in the step


def truth_poses(
    truth: Trajectory, time: Array, *, any_motion: bool = False
) -> tuple[Trajectory, BoolArray, str]:
    """Interpolate a truth of any rate at those times where its motion allows it.

    `time` (n,): strictly increasing (s). `any_motion`: whether only gaps are not interpolated
    across, whatever the error. Returns `poses`: at the m times that the truth covers; a part that
    the truth lacks is NaN; `covered` (n,): which times these are; `reason`: why others are not
    covered; empty where all are.
    """
    known = truth.time
    if len(known) == 0 or len(time) == 0:
        empty = Trajectory(np.zeros(0), np.empty((0, 3, 3)), np.empty((0, 3)))
        return empty, np.zeros(len(time), dtype=bool), "The truth has no pose."
    truth, lacking = _completed(truth)
    inside = (time >= known[0]) & (time <= known[-1])
    if any_motion:
        covered = in_short_steps(truth, time)
    else:
        covered = inside & (np.isin(time, known) | _usable_steps(truth)[_step_of(known, time)])
    poses = _cubic(truth, time[covered])
    poses = replace(poses, **{name: np.full_like(getattr(poses, name), np.nan) for name in lacking})
    return poses, covered, _reason(truth, time, inside, covered)


def in_short_steps(truth: Trajectory, time: Array) -> BoolArray:
    """Return which times (n,) are within the truth and not in one of its gaps."""
    known = truth.time
    short = np.diff(known) <= MAX_STEPS * np.median(np.diff(known))
    return (time >= known[0]) & (time <= known[-1]) & short[_step_of(known, time)]


def _completed(truth: Trajectory) -> tuple[Trajectory, list[str]]:
    """Return a truth with a constant for the part that it lacks, and the name of that part."""
    parts = {}
    if not truth.has_attitude:
        parts["world_from_body"] = np.tile(np.eye(3), (len(truth), 1, 1))
    if not truth.has_position:
        parts["position_world"] = np.zeros((len(truth), 3))
    return replace(truth, **parts), list(parts)


def _step_of(known: Array, time: Array) -> Array:
    return np.clip(known.searchsorted(time, side="right") - 1, 0, max(len(known) - 2, 0))


def _usable_steps(truth: Trajectory) -> BoolArray:
    """Return which steps (n - 1, at least 1) may be interpolated across.

    A sample that is left out shows the error over two steps, of which that of one follows.
    """
    step = np.diff(truth.time)
    if len(step) < 4:
        return np.append(step, np.inf)[: max(len(step), 1)] <= SHORT_STEP
    errors = np.full((len(truth), 2), np.nan)
    for first in (0, 1):
        others = slice(1 - first, None, 2)
        kept = truth.rows(slice(first, None, 2))
        predicted = _cubic(kept, truth.time[others])
        turn = np.swapaxes(truth.world_from_body[others], 1, 2) @ predicted.world_from_body
        off = predicted.position_world - truth.position_world[others]
        errors[others, 0] = np.linalg.norm(off, axis=1)
        errors[others, 1] = Rotation.from_matrix(turn).magnitude()
    span = np.concatenate([[np.inf], step[:-1] + step[1:], [np.inf]])
    before = errors[:-1] * ((step / span[:-1]) ** ORDER)[:, None]
    after = errors[1:] * ((step / span[1:]) ** ORDER)[:, None]
    error = np.maximum(before, after)
    small = np.all(error <= [MAX_POSITION_ERROR, MAX_ROTATION_ERROR], axis=1)
    return (step <= SHORT_STEP) | (small & (step <= MAX_STEPS * float(np.median(step))))


def _reason(truth: Trajectory, time: Array, inside: BoolArray, covered: BoolArray) -> str:
    """Return why some times are not covered."""
    parts = []
    if not np.all(inside):
        parts.append(
            f"{np.sum(~inside)} are outside of its {_shown(truth.time)} s (the estimate:"
            f" {_shown(time)} s)"
        )
    if np.any(inside & ~covered):
        longest = float(np.max(np.diff(truth.time), initial=0.0))
        parts.append(
            f"{np.sum(inside & ~covered)} are in steps of up to {longest:.3g} s, in which the"
            f" platform moves too much to interpolate to {1e3 * MAX_POSITION_ERROR:.0f} mm and"
            f" {MAX_ROTATION_ERROR / DEGREE:.1g} deg"
        )
    return " and ".join(parts)


def _shown(time: Array) -> str:
    """Return first and last of times to the millisecond: dates have ten digits before it."""
    return " to ".join(f"{t:.3f}".rstrip("0").rstrip(".") for t in (time[0], time[-1]))


def _cubic(truth: Trajectory, time: Array) -> Trajectory:
    """Return the cubics between samples; beyond the ends they are extrapolated."""
    known = truth.time
    if len(known) == 1 or len(time) == 0:
        rows = np.zeros(len(time), dtype=np.int64)
        return Trajectory(time, truth.world_from_body[rows], truth.position_world[rows])
    step = np.diff(known)[:, None]
    slope = _slopes(known, np.diff(truth.position_world, axis=0) / step)
    position, _ = hermite(known, truth.position_world, slope, time)
    turn = np.swapaxes(truth.world_from_body[:-1], 1, 2) @ truth.world_from_body[1:]
    vector = Rotation.from_matrix(turn).as_rotvec()
    rate = _slopes(known, vector / step)
    own = _step_of(known, time)
    own_vector, width = vector[own], step[own]
    share = (time[:, None] - known[own][:, None]) / width
    begin, end = rate[own] * width, _vector_rate(own_vector, rate[own + 1]) * width
    square, cube = 3.0 * own_vector - 2.0 * begin - end, begin + end - 2.0 * own_vector
    bent = share * (begin + share * (square + share * cube))
    rotation = truth.world_from_body[own] @ Rotation.from_rotvec(bent).as_matrix()
    return Trajectory(time, rotation, position)


def _slopes(known: Array, mean: Array) -> Array:
    """Return slopes at samples (n, 3) from the mean ones of the steps (n - 1, 3)."""
    if len(mean) == 1:
        return np.repeat(mean, 2, axis=0)
    step = np.diff(known)[:, None]
    inner = (step[1:] * mean[:-1] + step[:-1] * mean[1:]) / (step[1:] + step[:-1])
    ends = 2.0 * mean[[0, -1]] - inner[[0, -1]]
    return np.concatenate([ends[:1], inner, ends[1:]])


def _vector_rate(vector: Array, rate_body: Array) -> Array:
    """Return the rate of a rotation vector from the angular rate, by the inverse right Jacobian."""
    rotated = np.cross(vector, rate_body)
    return np.asarray(rate_body + 0.5 * rotated + np.cross(vector, rotated) / 12.0)
