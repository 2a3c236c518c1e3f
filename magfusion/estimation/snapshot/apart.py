"""What a fix predicts of channels that were measured one after the other, each in its own axes."""

import numpy as np

from magfusion.estimation.snapshot.problem import Problem, State
from magfusion.model.noise import stacked
from magfusion.model.parameters import linearize_channels, predict_channels
from magfusion.units import Array


def predicted(problem: Problem, state: State) -> Array:
    """Return the phasors of states, shape (m, channels, 6) (T)."""
    known = problem.at(state)
    if problem.turned is None:
        phasor = predict_channels(known, problem.time, state.rotation, state.position)
        return stacked(phasor)
    out = np.empty_like(problem.measured)
    for k in range(out.shape[1]):
        rotation = state.rotation @ problem.turned[:, k]
        phasor = predict_channels(known, problem.time, rotation, state.position)
        out[:, k] = stacked(phasor[:, k])
    return out


def linearized(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    """Return the phasors of states, and their derivatives by poses and by nuisances.

    Returns
    -------
    value : ndarray, shape (m, channels, 6)
        (T)
    by_pose : ndarray, shape (m, channels, 6, 6)
        By a turn and a shift in the body's axes.
    by_nuisance : ndarray, shape (m, channels, 6, nuisances)
    """
    known, blocks, time = problem.at(state), problem.blocks, problem.time
    if problem.turned is None:
        return linearize_channels(known, blocks, time, state.rotation, state.position)
    parts = []
    for k in range(problem.turned.shape[1]):
        turn = problem.turned[:, k]
        value, by_pose, by_nuisance = linearize_channels(
            known, blocks, time, state.rotation @ turn, state.position
        )
        # A step in the body's axes of the epoch is another one in those of then.
        halves = by_pose[:, k].reshape(len(turn), 6, 2, 3) @ np.swapaxes(turn, 1, 2)[:, None]
        parts.append((value[:, k], halves.reshape(len(turn), 6, 6), by_nuisance[:, k]))
    value, by_pose, by_nuisance = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
    return value, by_pose, by_nuisance
