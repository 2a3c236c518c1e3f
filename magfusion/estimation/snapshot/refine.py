"""Refinement of given poses on the measurement model, all epochs and hypotheses at once."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.snapshot.fix import Fixes, Gravity
from magfusion.estimation.snapshot.problem import GAIN_SIGMA, FixProblem, FixState, epochs_of
from magfusion.estimation.snapshot.sequential_channels import by_motion, linearized, predicted
from magfusion.estimation.snapshot.survey_error import honest_covariance, survey_jacobians, whitened
from magfusion.estimation.solve.batched import NormalEquations, minimise, open_inverse
from magfusion.model.field import skew
from magfusion.model.field_map import block_diagonal
from magfusion.model.parameters import GAIN, PHASE, Calibration, Parameter, dimension
from magfusion.model.samples import FieldSamples
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray

Columns = tuple[Array, Array]  # Jacobian (m, rows, 6 + nuisances) and residual (m, rows)


class RefinedFixes(NamedTuple):
    """Converged rows."""

    state: FixState
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
    free_parameters: tuple[str, ...] = (),
    gain_sigma: float = GAIN_SIGMA,
) -> Fixes:
    """Refine the pose at every epoch from an initial guess.

    It converges to the minimum next to the start; mirrored poses are not searched. `samples`:
    channels in the site's order. `start`: poses at the same times. `gravity`, `prior`,
    `survey_error`, `free_parameters`, `gain_sigma`: as in
    `magfusion.estimation.snapshot.likelihood.fix_epochs`. Returned with one hypothesis. Raises
    EstimationError where there is no epoch.
    """
    parts, first = [], 0
    for epochs in epochs_of(
        samples,
        calibration,
        gravity=gravity,
        prior=prior,
        survey_error=survey_error,
        free_parameters=free_parameters,
        gain_sigma=gain_sigma,
    ):
        problem, rows = epochs.problem, slice(first, first + len(epochs.samples))
        first = rows.stop
        at = problem.start(start.world_from_body[rows], start.position_world[rows])
        solved = solved_from(problem, at)
        again = epochs.reweighed(solved.state.rotation, solved.state.position)
        if again is not None:
            problem, solved = again, solved_from(again, solved.state)
        parts.append(as_fixes(problem, solved, 1))
    return joined(parts)


def joined(parts: list[Fixes]) -> Fixes:
    """Concatenate the fixes of chunks."""
    return Fixes(
        *(np.concatenate([getattr(p, f) for p in parts]) for f in Fixes.__dataclass_fields__)
    )


def as_fixes(problem: FixProblem, solved: RefinedFixes, count: int) -> Fixes:
    """Return rows as fixes of so many hypotheses each, in the given order.

    `problem`: every epoch repeated for each of its hypotheses.
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


def _cost_of(known: Columns | None, problem: FixProblem) -> Array:
    return np.zeros(len(problem.time)) if known is None else np.sum(known[1] ** 2, axis=1)


def cost(problem: FixProblem, state: FixState) -> Array:
    """Return the squared residual of each row, shape (m,), in units of its sigma."""
    error = whitened(
        problem.sqrt_information, (predicted(problem, state) - problem.measured)[..., None]
    )
    total = np.einsum("mij,mij->m", error, error)
    for _, known in _known(problem, state):
        total += np.einsum("mi,mi->m", known, known)
    return total


def _gravity(problem: FixProblem, state: FixState) -> Columns | None:
    if problem.gravity is None:
        return None
    up, share = state.rotation[:, 2], 1.0 / problem.gravity.sigma
    block = np.zeros((len(up), 3, 6 + dimension(problem.blocks)))
    block[:, :, :3] = share[:, None, None] * skew(up)
    return block, share[:, None] * (up - problem.gravity.up_body)


def _prior_pose(problem: FixProblem, state: FixState) -> Columns | None:
    prior = problem.prior
    if prior is None or prior.sqrt_information is None:
        return None
    step = _pose_difference(prior.rotation, prior.position, state.rotation, state.position)
    block = np.zeros((len(step), 6, 6 + dimension(problem.blocks)))
    block[:, :, :6] = prior.sqrt_information
    return block, (prior.sqrt_information @ step[..., None])[..., 0]


def _known(problem: FixProblem, state: FixState) -> Iterator[Columns]:
    """Yield Jacobian and residual of gravity and prior."""
    for known in (_gravity(problem, state), _prior_pose(problem, state)):
        if known is not None:
            yield known
    m, width = len(problem.time), 6 + dimension(problem.blocks)
    names = [name for name, _ in problem.calibration.site.channels]
    for gain in problem.blocks:
        if gain.parameter == GAIN:
            block = np.zeros((m, 1, width))
            block[:, 0, 6 + gain.columns.start] = 1.0 / gain.sigma[0]
            yield block, state.log_gain[:, [names.index(gain.owner)]] / gain.sigma[0]


def _pose_difference(rotation0: Array, position0: Array, rotation: Array, position: Array) -> Array:
    """Return the perturbation from the first pose to the second, for a small translation."""
    inverse = np.swapaxes(rotation0, -1, -2)
    turn = Rotation.from_matrix(inverse @ rotation).as_rotvec()
    shift = (inverse @ (position - position0)[..., None])[..., 0]
    return np.concatenate([turn, shift], axis=-1)


def _columns(problem: FixProblem, state: FixState) -> Array:
    """Return the whitened rows of the field: Jacobian, then residual as the last column."""
    value, by_pose, by_nuisance = linearized(problem, state)
    error = (value - problem.measured)[..., None]
    return whitened(
        problem.sqrt_information, np.concatenate([by_pose, by_nuisance, error], axis=-1)
    )


def _normal(problem: FixProblem, state: FixState) -> NormalEquations:
    columns = _columns(problem, state)
    normal = np.swapaxes(columns, 1, 2) @ columns
    for block, known in _known(problem, state):
        rows = np.concatenate([block, known[..., None]], axis=-1)
        normal += np.swapaxes(rows, 1, 2) @ rows
    return NormalEquations(normal[:, -1, -1], normal[:, :-1, -1], normal[:, :-1, :-1])


def rows_at(problem: FixProblem, state: FixState) -> tuple[Array, Array, Array | None]:
    """Return every whitened row at a state, six of each channel, then gravity and prior.

    Returns `jacobian` (m, rows, 6 + nuisances); `error` (m, rows); `covariance` (m, rows, rows): of
    the error, including the survey's, if the whitening only approximates it.
    """
    parts = [_columns(problem, state)]
    parts += [np.concatenate([by, e[..., None]], axis=-1) for by, e in _known(problem, state)]
    columns = np.concatenate(parts, axis=1)
    if problem.noise is None:
        return columns[..., :-1], columns[..., -1], None
    m, rows, of_field = len(columns), columns.shape[1], parts[0].shape[1]
    _, by_survey = _survey(problem, state)
    covariance = np.broadcast_to(np.eye(rows), (m, rows, rows)).copy()
    noise = block_diagonal(np.repeat(problem.noise, 2, axis=1))
    covariance[:, :of_field, :of_field] = noise + by_survey @ np.swapaxes(by_survey, 1, 2)
    return columns[..., :-1], columns[..., -1], covariance


def _spread(problem: FixProblem, kind: Parameter) -> Array:
    """Return the channels affected by a nuisance's column, shape (nuisances, channels)."""
    names = np.array([name for name, _ in problem.calibration.site.channels])
    out = np.zeros((dimension(problem.blocks), len(names)))
    for block in problem.blocks:
        if block.parameter == kind:
            columns = np.arange(block.columns.start, block.columns.stop)
            mine = np.flatnonzero(names == block.owner)
            out[columns if len(columns) == 1 else np.resize(columns, len(mine)), mine] = 1.0
    return out


def solved_from(problem: FixProblem, start: FixState) -> RefinedFixes:
    """Move every row to the minimum next to its start.

    `start`: of the same rows.
    """
    spread = _spread(problem, PHASE), _spread(problem, GAIN)
    count = start.phase.shape[1]
    kept, narrowed = np.arange(len(problem.time)), problem

    def model(rows: IntArray, flat: Array) -> NormalEquations:
        nonlocal kept, narrowed
        if len(rows) < len(kept):  # rows only ever converge
            narrowed, kept = narrowed.rows(np.isin(kept, rows)), rows
        return _normal(narrowed, _state(flat, count))

    def moved(flat: Array, step: Array) -> Array:
        return _flat(_moved(_state(flat, count), step, *spread))

    result = minimise(model, _flat(start), moved, relative=1e-7, absolute=1e-4)
    return RefinedFixes(_state(result.state, count), result.cost, result.information)


def _flat(state: FixState) -> Array:
    return np.concatenate([part.reshape(len(part), -1) for part in state], axis=1)


def _state(flat: Array, channels: int) -> FixState:
    rotation, position, phase, log_gain = np.split(flat, [9, 12, 12 + channels], axis=1)
    return FixState(rotation.reshape(-1, 3, 3), position, phase, log_gain)


def _moved(state: FixState, step: Array, by_phase: Array, by_gain: Array) -> FixState:
    """Return the state moved by a step, limited to one radian."""
    angle = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    step = step * np.minimum(1.0, 1.0 / np.maximum(angle, 1e-12))
    return FixState(
        rotation=state.rotation @ Rotation.from_rotvec(step[:, :3]).as_matrix(),
        position=state.position + (state.rotation @ step[:, 3:6, None])[..., 0],
        phase=state.phase + step[:, 6:] @ by_phase,
        log_gain=state.log_gain + step[:, 6:] @ by_gain,
    )


def posterior(problem: FixProblem, solved: RefinedFixes) -> tuple[Array, BoolArray]:
    """Return the covariance of each row's pose, (m, 6, 6), and whether it is determined."""
    inverse, determined = open_inverse(solved.information)
    if problem.noise is not None:
        propagated = _with_survey(problem, solved, inverse)
        # The survey error has no effect on an open direction.
        inverse = np.where(determined[..., None, None], propagated, inverse)
    if problem.motion is not None:
        moved = _by_motion(problem, solved)
        inverse = inverse + np.where(determined[..., None, None], moved, 0.0)
    return inverse[..., :6, :6], determined


def _by_motion(problem: FixProblem, solved: RefinedFixes) -> Array:
    """Return the covariance due to motion within the cycle, (m, found, found)."""
    _, by_pose, by_nuisance = linearized(problem, solved.state)
    by_found = np.concatenate([by_pose, by_nuisance], axis=-1)
    by_shift = by_motion(problem, solved.state, by_pose)
    rows, shifts = (whitened(problem.sqrt_information, part) for part in (by_found, by_shift))
    inverse, _ = open_inverse(solved.information)
    moved = inverse @ np.swapaxes(rows, 1, 2) @ shifts
    return np.asarray(moved @ np.swapaxes(moved, 1, 2))


def _with_survey(problem: FixProblem, solved: RefinedFixes, inverse: Array) -> Array:
    """Return the covariance with the survey error propagated, rather than treated as noise."""
    assert problem.noise is not None
    by_found, by_survey = _survey(problem, solved.state)
    noise = block_diagonal(np.repeat(problem.noise, 2, axis=1))
    return honest_covariance(by_found, by_survey, noise, inverse, solved.information)


def _survey(problem: FixProblem, state: FixState) -> tuple[Array, Array]:
    return survey_jacobians(
        problem.at(state),
        problem.blocks,
        problem.time,
        state.rotation,
        state.position,
        problem.sqrt_information,
    )
