"""Refinement of given poses on the one measurement model, all epochs and hypotheses at once.

Levenberg-Marquardt, a row for each pose; a row that has converged costs nothing more.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.fixes.fix import Fixes, Gravity
from magfusion.fixes.problem import GAIN_SIGMA, Problem, State, epochs_of
from magfusion.fixes.survey import honest_covariance, survey_jacobians, whitened
from magfusion.observation import skew
from magfusion.parameters import Calibration, dimension, linearize_channels, predict_channels
from magfusion.records.samples import FieldSamples
from magfusion.trajectory import Trajectory
from magfusion.units import Array, BoolArray
from magfusion.weights import block_diagonal, stacked

Columns = tuple[Array, Array]  # Jacobian (m, rows, 6 + nuisances) and residual (m, rows)
ITERATIONS = 100  # a bound; the few that creep along a valley need more than 25


class Solved(NamedTuple):
    """Where the rows ended."""

    state: State
    cost: Array  # (m,)
    information: Array  # (m, 6 + nuisances, 6 + nuisances)


def refine(
    samples: FieldSamples,
    calibration: Calibration,
    start: Trajectory,
    *,
    gravity: Gravity | None = None,
    prior: Trajectory | None = None,
    survey_error: bool = True,
    free: tuple[str, ...] = (),
    gain_sigma: float = GAIN_SIGMA,
) -> Fixes:
    """Refine the pose at every epoch from where it is thought to be.

    It ends in the minimum next to the start; mirrored poses are not looked for.

    Parameters
    ----------
    samples : FieldSamples
        Channels in the site's order.
    calibration : Calibration
    start : Trajectory
        Poses at the same times.
    gravity, prior, survey_error, free, gain_sigma
        As in `magfusion.fixes.likelihood.fix_epochs`.

    Returns
    -------
    Fixes
        With one hypothesis.

    Raises
    ------
    EstimationError
        Where there is no epoch.
    """
    parts, first = [], 0
    for epochs in epochs_of(
        samples,
        calibration,
        gravity=gravity,
        prior=prior,
        survey_error=survey_error,
        free=free,
        gain_sigma=gain_sigma,
    ):
        problem, rows = epochs.problem, slice(first, first + len(epochs.samples))
        first = rows.stop
        at = problem.start(start.world_from_body[rows], start.position_world[rows])
        solved = levenberg_marquardt(problem, at)
        again = epochs.reweighed(solved.state.rotation, solved.state.position)
        if again is not None:
            problem, solved = again, levenberg_marquardt(again, solved.state)
        parts.append(as_fixes(problem, solved, 1))
    return joined(parts)


def joined(parts: list[Fixes]) -> Fixes:
    """Return the fixes of chunks as one."""
    return Fixes(
        *(np.concatenate([getattr(p, f) for p in parts]) for f in Fixes.__dataclass_fields__)
    )


def as_fixes(problem: Problem, solved: Solved, count: int) -> Fixes:
    """Return rows as fixes of so many hypotheses each, in the order in which they are.

    Parameters
    ----------
    problem : Problem
        Every epoch repeated for each of its hypotheses.
    solved : Solved
    count : int
    """
    state = solved.state
    pose_cov, determined = posterior(problem, solved)

    def split(rows: Array) -> Array:
        return rows.reshape(-1, count, *rows.shape[1:])

    return Fixes(
        time=problem.time[::count],
        world_from_body=split(state.rotation),
        position_world=split(state.position),
        pose_cov=split(pose_cov),
        cost=split(solved.cost),
        residual_rms=split(np.sqrt(solved.cost / problem.residuals)),
        phase=split(state.phase),
        determined=determined.reshape(-1, count),
        log_gain=split(state.log_gain),
        gravity_cost=split(_cost_of(_gravity(problem, state), problem)),
        prior_cost=split(_cost_of(_prior_pose(problem, state), problem)),
    )


def _cost_of(known: Columns | None, problem: Problem) -> Array:
    return np.zeros(len(problem.time)) if known is None else np.sum(known[1] ** 2, axis=1)


def cost(problem: Problem, state: State) -> Array:
    """Return the squared residual of each row, shape (m,), in units of its sigma."""
    phasor = predict_channels(problem.at(state), problem.time, state.rotation, state.position)
    error = whitened(problem.root, (stacked(phasor) - problem.measured)[..., None])
    total = np.einsum("mij,mij->m", error, error)
    for _, known in _known(problem, state):
        total += np.einsum("mi,mi->m", known, known)
    return np.asarray(total)


def _gravity(problem: Problem, state: State) -> Columns | None:
    if problem.gravity is None:
        return None
    up, share = state.rotation[:, 2], 1.0 / problem.gravity.sigma
    block = np.zeros((len(up), 3, 6 + dimension(problem.blocks)))
    block[:, :, :3] = share[:, None, None] * skew(up)
    return block, share[:, None] * (up - problem.gravity.up_body)


def _prior_pose(problem: Problem, state: State) -> Columns | None:
    prior = problem.prior
    if prior is None or prior.root is None:
        return None
    step = _pose_difference(prior.rotation, prior.position, state.rotation, state.position)
    block = np.zeros((len(step), 6, 6 + dimension(problem.blocks)))
    block[:, :, :6] = prior.root
    return block, (prior.root @ step[..., None])[..., 0]


def _known(problem: Problem, state: State) -> Iterator[Columns]:
    """Yield Jacobian and residual of what is no field."""
    for known in (_gravity(problem, state), _prior_pose(problem, state)):
        if known is not None:
            yield known
    m, width = len(problem.time), 6 + dimension(problem.blocks)
    names = [name for name, _ in problem.calibration.site.channels]
    for gain in problem.blocks:
        if gain.kind == "gain":
            block = np.zeros((m, 1, width))
            block[:, 0, 6 + gain.columns.start] = 1.0 / gain.sigma[0]
            yield block, state.log_gain[:, [names.index(gain.owner)]] / gain.sigma[0]


def _pose_difference(rotation0: Array, position0: Array, rotation: Array, position: Array) -> Array:
    """Perturbation from the first pose to the second, small-angle in its translation."""
    inverse = np.swapaxes(rotation0, -1, -2)
    turn = Rotation.from_matrix(inverse @ rotation).as_rotvec()
    shift = (inverse @ (position - position0)[..., None])[..., 0]
    return np.concatenate([turn, shift], axis=-1)


def _normal(problem: Problem, state: State) -> Array:
    """Return ``[J e]^T [J e]`` of each row: information, gradient, and the cost in the corner."""
    value, by_pose, by_nuisance = linearize_channels(
        problem.at(state), problem.blocks, problem.time, state.rotation, state.position
    )
    error = (value - problem.measured)[..., None]
    columns = whitened(problem.root, np.concatenate([by_pose, by_nuisance, error], axis=-1))
    normal = np.swapaxes(columns, 1, 2) @ columns
    for block, known in _known(problem, state):
        rows = np.concatenate([block, known[..., None]], axis=-1)
        normal += np.swapaxes(rows, 1, 2) @ rows
    return np.asarray(normal)


def _spread(problem: Problem, kind: str) -> Array:
    """Return which channels a nuisance's column moves, shape (nuisances, channels)."""
    names = np.array([name for name, _ in problem.calibration.site.channels])
    out = np.zeros((dimension(problem.blocks), len(names)))
    for block in problem.blocks:
        if block.kind == kind:
            mine = np.flatnonzero(names == block.owner)
            columns = np.arange(block.columns.start, block.columns.stop)
            out[columns if kind == "phase" else columns[0], mine] = 1.0
    return out


def levenberg_marquardt(problem: Problem, start: State) -> Solved:
    """Move every row to the minimum next to its start.

    Parameters
    ----------
    problem : Problem
    start : State
        Of the same rows.

    Returns
    -------
    Solved
    """
    spread = _spread(problem, "phase"), _spread(problem, "gain")
    state, normal = start, _normal(problem, start)
    found, last = State(*(part.copy() for part in start)), normal.copy()
    active = np.arange(len(problem.time))
    damping = np.full(len(active), 1e-3)
    for _ in range(ITERATIONS):
        trial = _moved(state, _step(normal, damping), *spread)
        new = _normal(problem, trial)
        gain = normal[:, -1, -1] - new[:, -1, -1]
        better = gain > 0.0
        state, normal = trial.where(better, state), np.where(better[:, None, None], new, normal)
        damping = damping * np.where(better, 0.2, 10.0)
        small = gain < 1e-4 * (1.0 + 1e-3 * new[:, -1, -1])
        going = ~((damping > 1e8) | (better & small))
        if not np.all(going):
            done = active[~going]
            for kept, part in zip(found, state, strict=True):
                kept[done] = part[~going]
            last[done] = normal[~going]
            active, damping, normal = active[going], damping[going], normal[going]
            state, problem = state.rows(going), problem.rows(going)
        if not len(active):
            break
    for kept, part in zip(found, state, strict=True):
        kept[active] = part
    last[active] = normal
    return Solved(found, last[:, -1, -1].copy(), last[:, :-1, :-1])


def _step(normal: Array, damping: Array) -> Array:
    """Return the damped step of each row, at most a radian, shape (m, 6 + nuisances)."""
    information, gradient = normal[:, :-1, :-1], normal[:, :-1, -1:]
    diagonal = np.einsum("mii->mi", information)
    largest = np.max(diagonal, axis=1, keepdims=True)
    # An epoch without any channel has no information at all: it stays where it is.
    floor = np.where(largest > 0.0, 1e-9 * largest, 1.0)
    damped = information.copy()
    np.einsum("mii->mi", damped)[...] += damping[:, None] * np.maximum(diagonal, floor)
    step = -np.linalg.solve(damped, gradient)[..., 0]
    angle = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, 1.0 / np.maximum(angle, 1e-12)))


def _moved(state: State, step: Array, by_phase: Array, by_gain: Array) -> State:
    return State(
        rotation=state.rotation @ Rotation.from_rotvec(step[:, :3]).as_matrix(),
        position=state.position + (state.rotation @ step[:, 3:6, None])[..., 0],
        phase=state.phase + step[:, 6:] @ by_phase,
        log_gain=state.log_gain + step[:, 6:] @ by_gain,
    )


def posterior(problem: Problem, solved: Solved) -> tuple[Array, BoolArray]:
    """Return the covariance of each row's pose, (m, 6, 6), and whether it is determined."""
    inverse, determined = _inverse(solved.information)
    if problem.noise is not None:
        carried = _with_survey(problem, solved, inverse)
        # Where a direction is open there is nothing for the survey to make worse.
        inverse = np.where(determined[..., None, None], carried, inverse)
    return inverse[..., :6, :6], determined


def _with_survey(problem: Problem, solved: Solved, inverse: Array) -> Array:
    """Covariance with the error of the survey carried through, rather than taken for noise."""
    assert problem.noise is not None
    state = solved.state
    by_found, by_survey = survey_jacobians(
        problem.at(state),
        problem.blocks,
        problem.time,
        state.rotation,
        state.position,
        problem.root,
    )
    noise = block_diagonal(np.repeat(problem.noise, 2, axis=1))
    return honest_covariance(by_found, by_survey, noise, inverse, solved.information)


def _inverse(information: Array) -> tuple[Array, BoolArray]:
    """Return the covariance of pose and nuisances; flat directions are wide, not infinite."""
    value, vector = np.linalg.eigh(information)
    largest = value[..., -1:]
    # The phase of a channel that is missing is open too, but is no direction of the pose.
    in_pose = np.sum(vector[..., :6, :] ** 2, axis=-2) > 1e-6
    open_direction = (value <= 1e-10 * largest) & in_pose
    safe = np.maximum(value, 1e-10 * largest + 1e-300)
    cov = (vector / safe[..., None, :]) @ np.swapaxes(vector, -1, -2)
    return cov, ~np.any(open_direction, axis=-1)
