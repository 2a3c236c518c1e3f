"""Score test: the gain and the step of estimating a fixed parameter.

At the optimum, one elimination of the linear system yields the information of all fixed parameters
and the gradient of the cost by them (the score).  A Gauss-Newton step then gives the change of
each, the decrease of the cost, and the change of the poses, without solving again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from scipy.linalg import solve_triangular

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.graph.considered import steps_of_others
from magfusion.estimation.graph.factors import CALIBRATION_KEY, CONSIDERED_KEY, NUISANCE_KEY
from magfusion.estimation.graph.graph import GraphEstimate
from magfusion.estimation.graph.measurement import Rows
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.integrity.fault_candidates import TOLERANCE, fixed_blocks
from magfusion.estimation.integrity.fixed_parameter_columns import InertialColumns, inertial_columns
from magfusion.estimation.integrity.score_chain import (
    FixedParameterResidual,
    Responses,
    left_of_chain,
    responses_of_chain,
)
from magfusion.estimation.measurements.earth import EarthField
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior.marginals import is_chain
from magfusion.estimation.posterior.native_rows import NativeRows
from magfusion.estimation.solve.bordered import eliminate_partial
from magfusion.estimation.solve.sparse_rows import sparse_if_wide
from magfusion.model.parameters import Block, Calibration, dimension, placed, prior_sigma, retract
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.samples import ImuSamples
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Score:
    """Score of all fixed parameters, in units of their typical errors."""

    fixed: tuple[Block, ...]  # their sigmas are those units
    information: Array  # (h, h), of the fixed parameters, with all estimated ones eliminated
    gradient: Array  # (h,), downhill: a step is the information's inverse times this
    # (h, k), a root of the covariance of their errors that the site declares; zero where it
    # declares them known
    spread: Array
    # (states, 15 or 6, h), effect of a unit of them on pose, velocity and biases; or on the pose
    # only
    by_state: Array
    by_calibration: Array  # (dimension, h), effect of a unit of them on the estimated calibration

    @property
    def by_pose(self) -> Array:
        """Effect of a unit of them on the poses, shape (states, 6, h)."""
        return self.by_state[:, :6]

    def with_declared(self, *, tolerance: bool) -> tuple[Array, Array]:
        """Let uncertain parameters vary within their declared sigma.

        `tolerance`: whether all of them vary within their tolerance, too. Returns
        `information` (h, h): of errors beyond that; `gradient` (h,).
        """
        spread = self.spread
        if tolerance:
            spread = np.concatenate([spread, tolerance_of(self.fixed)], axis=1)
        return self._beyond(spread)

    def within_tolerance(self) -> Array:
        """Return the information with all tolerances applied, shape (h, h)."""
        return self._beyond(tolerance_of(self.fixed))[0]

    def _beyond(self, spread: Array) -> tuple[Array, Array]:
        """Return information and gradient of errors beyond those of a spread."""
        thin = sparse_if_wide(spread[:, spread.any(axis=0)])  # most parameters are known
        across = thin.T @ np.column_stack([self.information, self.gradient])
        inner = np.eye(len(across)) + thin.T @ across[:, :-1].T
        half = solve_triangular(np.linalg.cholesky(inner), across, lower=True)
        by = half[:, :-1].T
        return self.information - by @ by.T, self.gradient - by @ half[:, -1]

    def allowed(self, step: Array) -> Array:
        """Return a step with the changes of all others that their declared sigmas allow."""
        return step + self._applied(self.spread) @ (self.gradient - self.information @ step)

    def _applied(self, spread: Array) -> Array:
        spread = spread[:, spread.any(axis=0)]
        inner = np.eye(spread.shape[1]) + spread.T @ self.information @ spread
        return np.asarray(spread @ np.linalg.solve(inner, spread.T))


def tolerance_of(fixed: tuple[Block, ...]) -> Array:
    """Return a root of the covariance of the tolerances, in typical errors."""
    own = [TOLERANCE.get(b.parameter, 0.0) / b.sigma for b in fixed]
    return np.diag(np.concatenate(own))


class Scores(NamedTuple):
    """The score of all fixed parameters, and of additional ones."""

    fixed: Score
    every: Score  # its responses may be those of the first of its parameters only: see `answered`


def scores_of(
    result: Smoothed, imu: ImuSamples, columns: Sequence[Block] = (), *, responses: bool = False
) -> Scores | None:
    """Return the score of all fixed parameters of a result; None if there is nothing to test.

    `imu`: as recorded. `columns`: additional parameters to test in the same sweep. `responses`:
    whether the responses of the states include those to these.
    """
    graph = result.graph
    if not graph.measurements or result.fix_response is not None:
        return None
    known = result.declared.site
    if not known.platform.inertial and len(known.beacons) == 1:
        return None  # a single beacon is only contradicted by the smoothness of the path
    static = any(isinstance(m, EarthField) for m in graph.measurements)
    fixed = fixed_blocks(known, result.blocks, static=static)
    if not fixed:
        return None
    every = placed((*fixed, *columns))
    inertial = inertial_columns(result, every, imu)
    estimate = _by_chain(result, every if responses else fixed, every, inertial)
    if estimate is None:
        estimate = _by_elimination(result, every, inertial.of(slice(None)))
    residual, by = estimate
    wide = Score(every, *residual, _declared(result, every), *by)
    return Scores(_first(wide, fixed), wide)


def _first(score: Score, fixed: tuple[Block, ...]) -> Score:
    """Return the score of the first of its parameters."""
    own = slice(0, dimension(fixed))
    return Score(
        fixed,
        score.information[own, own],
        score.gradient[own],
        score.spread[own],
        score.by_state[..., own],
        score.by_calibration[:, own],
    )


def _by_chain(
    result: Smoothed, fixed: tuple[Block, ...], every: tuple[Block, ...], inertial: InertialColumns
) -> tuple[FixedParameterResidual, Responses] | None:
    """Return the score of all, and the responses of the states to the first, for one chain."""
    if not is_chain(result.graph, every):
        return None
    native = NativeRows(result.graph, result.estimate)
    residual = left_of_chain(result, every, inertial, native)
    if residual is None:
        return None
    own = inertial.part(slice(0, dimension(fixed)))
    responses = responses_of_chain(result, fixed, own, native)
    return None if responses is None else (residual, responses)


def answered(result: Smoothed, score: Score, imu: ImuSamples) -> Score:
    """Return a score with the responses of the poses to all its parameters."""
    if score.by_calibration.shape[1] == dimension(score.fixed):
        return score
    inertial = inertial_columns(result, score.fixed, imu)
    native = NativeRows(result.graph, result.estimate)
    known = Responses(score.by_state, score.by_calibration)
    responses = responses_of_chain(result, score.fixed, inertial, native, known)
    if responses is None:
        residual, responses = _by_elimination(result, score.fixed, inertial.of(slice(None)))
        score = replace(score, information=residual.information, gradient=residual.gradient)
    by_state, by_calibration = responses
    return replace(score, by_state=by_state, by_calibration=by_calibration)


def _by_elimination(
    result: Smoothed, fixed: tuple[Block, ...], by_others: Array
) -> tuple[FixedParameterResidual, Responses]:
    """Return the same for any graph."""
    graph, estimate, size = result.graph, result.estimate, dimension(fixed)
    unit = np.diag(prior_sigma(fixed))
    errors = result.field_errors
    linear = graph.with_fixed_columns(
        estimate, fixed, unit, by_others, explaining=True, nuisance=errors
    )
    conditional, rest = eliminate_partial(linear, graph.ordering)
    if errors:
        # A field error that is constant in place resembles some of them; their effect on the
        # estimate, which ignores such errors, is that of none.
        nuisance = gtsam.Ordering()
        nuisance.push_back(NUISANCE_KEY)
        _, rest = eliminate_partial(rest, nuisance)
    order = gtsam.Ordering()
    order.push_back(CONSIDERED_KEY)
    information, gradient = rest.hessian(order)
    keys = [key for i in range(graph.epochs) for key in (X(i), V(i), B(i))]
    by_state = np.empty((graph.epochs, MOTION, size))
    by_calibration = np.zeros((dimension(result.blocks), size))
    steps = steps_of_others(_without_error(conditional), size, dimension(errors))
    for k, step in enumerate(steps):
        by_state[:, :, k] = step.vector(keys).reshape(-1, MOTION)
        if result.blocks:
            by_calibration[:, k] = step.at(CALIBRATION_KEY)
    return FixedParameterResidual(information, gradient), Responses(by_state, by_calibration)


def _without_error(net: gtsam.GaussianBayesNet) -> gtsam.GaussianBayesNet:
    for i in range(net.size()):
        net.at(i).getb()[...] = 0.0
    return net


def _declared(result: Smoothed, fixed: tuple[Block, ...]) -> Array:
    """Return a root of the declared covariance of the fixed parameters, in typical errors."""
    size = dimension(fixed)
    if not result.considered:
        return np.zeros((size, 0))
    spread = prior_sqrt_covariance(result.declared.site, result.considered)
    at = {b.key: b.columns for b in fixed}
    out = np.zeros((size, spread.shape[1]))
    for block in result.considered:
        if block.key in at:  # one from outside is not tested
            out[at[block.key]] = spread[block.columns]
    return out / prior_sigma(fixed)[:, None]


def moved_estimate(result: Smoothed, score: Score, step: Array) -> GraphEstimate:
    """Return the estimate after a step of the fixed parameters.

    `step` (h,): in typical errors.
    """
    estimate, change = result.estimate, gtsam.VectorValues()
    for i, own in enumerate(score.by_state @ step):
        for key, part in ((X(i), own[:6]), (V(i), own[6:9]), (B(i), own[9:])):
            change.insert(key, part)
    by_blocks = score.by_calibration @ step
    own_step = prior_sigma(score.fixed) * step

    def moved(calibration: Calibration) -> Calibration:
        return retract(retract(calibration, result.blocks, by_blocks), score.fixed, own_step)

    segments = tuple(moved(calibration) for calibration in estimate.segments)
    values = estimate.values.retract(change)
    return GraphEstimate(values, moved(estimate.calibration), segments, estimate.own)


def field_residual(result: Smoothed, estimate: GraphEstimate, *, raw: bool = False) -> Array:
    """Return the whitened residual of the fields at an estimate, NaN where missing.

    Shape (n, channels, 6); with the weights of a robust loss unless it is raw.
    """
    graph = result.graph
    fields = next((m for m in graph.measurements if isinstance(m, FieldPhasors)), None)
    if fields is None:
        return np.full_like(result.residual, np.nan)
    alone = fields.alone()
    loss = None if raw else alone.loss
    error = Rows(graph.residual(alone, estimate)).weighed(loss)[0].error
    return np.where(result.fields.is_measured, error, np.nan)
