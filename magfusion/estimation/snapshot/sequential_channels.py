"""Predictions of a fix for channels measured in turn, each in its own axes."""

import numpy as np

from magfusion.estimation.snapshot.problem import FixProblem, FixState
from magfusion.model.noise import stacked
from magfusion.model.parameters import linearize_channels, predict_channels
from magfusion.units import Array


def predicted(problem: FixProblem, state: FixState) -> Array:
    """Return the phasors of states, shape (m, channels, 6) (T)."""
    known = problem.at(state)
    if not _is_sequential(problem):
        phasor = predict_channels(known, problem.time, state.rotation, state.position)
        return stacked(phasor)
    out = np.empty_like(problem.measured)
    for k in range(out.shape[1]):
        phasor = predict_channels(known, problem.time, *_pose(problem, state, k))
        out[:, k] = stacked(phasor[:, k])
    return out


def linearized(problem: FixProblem, state: FixState) -> tuple[Array, Array, Array]:
    """Return the phasors of states, and their derivatives by pose and nuisances.

    Returns `value` (m, channels, 6) (T); `by_pose` (m, channels, 6, 6): by rotation and translation
    in the body's axes; `by_nuisance` (m, channels, 6, nuisances).
    """
    known, blocks, time = problem.at(state), problem.blocks, problem.time
    if not _is_sequential(problem):
        return linearize_channels(known, blocks, time, state.rotation, state.position)
    parts = []
    for k in range(problem.measured.shape[1]):
        value, by_pose, by_nuisance = linearize_channels(
            known, blocks, time, *_pose(problem, state, k)
        )
        own = by_pose[:, k]
        if problem.channel_rotation is not None:
            # Convert the step from the body's axes of the epoch to those of the measurement.
            back = np.swapaxes(problem.channel_rotation[:, k], 1, 2)[:, None]
            own = (own.reshape(len(own), 6, 2, 3) @ back).reshape(own.shape)
        parts.append((value[:, k], own, by_nuisance[:, k]))
    value, by_pose, by_nuisance = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
    return value, by_pose, by_nuisance


def by_motion(problem: FixProblem, state: FixState, by_pose: Array) -> Array:
    """Return the effect of one sigma of the motion on the phasors, shape (m, channels, 6, 3).

    `by_pose` (m, channels, 6, 6): as of `linearized`.
    """
    assert problem.motion is not None
    by_place = by_pose[..., 3:] @ np.swapaxes(state.rotation, 1, 2)[:, None]
    return np.asarray(problem.motion.spread[..., None, None] * by_place)


def _is_sequential(problem: FixProblem) -> bool:
    """Return whether channels have separate poses."""
    return problem.channel_rotation is not None or problem.motion is not None


def _pose(problem: FixProblem, state: FixState, channel: int) -> tuple[Array, Array]:
    """Return attitudes and positions at the measurement of a channel."""
    rotation, position = state.rotation, state.position
    if problem.channel_rotation is not None:
        rotation = rotation @ problem.channel_rotation[:, channel]
    if problem.motion is not None:
        position = position + problem.motion.shift_world[:, channel]
    return rotation, position
