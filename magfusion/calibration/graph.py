"""The graph of a calibration: uncertain poses or attitudes, and one dense calibration.

GTSAM's own factors constrain the poses.  The instruments' readings at all poses are linearised in
one batched call and enter as Jacobian factors, because a Python factor is called with a copy of
all values.
"""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from magfusion.errors import EstimationError
from magfusion.estimation.solve.bordered import Optimised, eliminate, last_marginal, optimise
from magfusion.units import Array

CALIBRATION_KEY = gtsam.symbol("c", 0)


@dataclass(frozen=True, eq=False)
class CalibrationEstimate:
    """The estimate that the optimiser updates."""

    # pose or attitude X(i) of each reading, and the other variables of the native factors
    values: gtsam.Values
    calibration: Array  # (k,)


Rows = Callable[[CalibrationEstimate], tuple[Array, Array, Array]]


@dataclass(frozen=True, eq=False)
class CalibrationGraph:
    """A `magfusion.estimation.solve.bordered.BorderedProblem`."""

    # returns whitened residuals (n, m) with derivatives by pose (n, m, d) and by calibration
    # (n, m, k)
    rows: Rows
    native: gtsam.NonlinearFactorGraph  # prior factors of the poses, linearised by GTSAM
    # declared, cov: (k,) and (k, k), prior of the calibration
    declared: Array
    cov: Array
    # each key of the values, in the order of elimination, with the step scale of unit damping
    steps: dict[int, Array]

    @property
    def ordering(self) -> gtsam.Ordering:
        """Elimination order: the calibration last."""
        out = gtsam.Ordering()
        for key in (*self.steps, CALIBRATION_KEY):
            out.push_back(key)
        return out

    def _prior(self, estimate: CalibrationEstimate) -> tuple[Array, Array]:
        sqrt_information = np.linalg.inv(np.linalg.cholesky(self.cov))
        return sqrt_information, sqrt_information @ (estimate.calibration - self.declared)

    def cost(self, estimate: CalibrationEstimate) -> float:
        """Return half the sum of squared whitened residuals, priors included."""
        error, (_, step) = self.rows(estimate)[0], self._prior(estimate)
        return float(0.5 * (np.sum(error**2) + step @ step) + self.native.error(estimate.values))

    def linearized(self, estimate: CalibrationEstimate) -> gtsam.GaussianFactorGraph:
        """Return the linear graph at an estimate."""
        graph = self.native.linearize(estimate.values)
        error, by_pose, by_calibration = self.rows(estimate)
        unit = gtsam.noiseModel.Unit.Create(error.shape[1])
        for i, (rest, own, shared) in enumerate(zip(error, by_pose, by_calibration, strict=True)):
            graph.push_back(gtsam.JacobianFactor(X(i), own, CALIBRATION_KEY, shared, -rest, unit))
        sqrt_information, step = self._prior(estimate)
        unit = gtsam.noiseModel.Unit.Create(len(step))
        graph.push_back(gtsam.JacobianFactor(CALIBRATION_KEY, sqrt_information, -step, unit))
        return graph

    def moved(self, estimate: CalibrationEstimate, step: gtsam.VectorValues) -> CalibrationEstimate:
        """Return the estimate updated by a step of every variable."""
        return CalibrationEstimate(
            estimate.values.retract(step), estimate.calibration + step.at(CALIBRATION_KEY)
        )

    def damping_scales(self) -> list[tuple[int, Array]]:
        """Return, for each key, the step scale of unit damping."""
        return [*self.steps.items(), (CALIBRATION_KEY, np.sqrt(np.diag(self.cov)))]


def solve(
    graph: CalibrationGraph,
    start: CalibrationEstimate,
    name: str,
    iterations: int,
    tolerance: float,
) -> tuple[Optimised[CalibrationEstimate], Array]:
    """Return the best estimate, and the covariance of its calibration, shape (k, k).

    `name`: of the calibrated device, for the messages. `iterations`, `tolerance`: as in
    `magfusion.estimation.solve.bordered.optimise`. Raises EstimationError where the loop does not
    converge, or the graph leaves a variable undetermined.
    """
    result = optimise(graph, start, iterations=iterations, tolerance=tolerance)
    if not result.converged:
        raise EstimationError(
            f"the calibration of the {name} does not converge in {iterations} iterations: readings"
            " and priors are inconsistent by far more than their sigmas allow"
        )
    linear, ordering = graph.linearized(result.estimate), graph.ordering
    try:
        return result, last_marginal(eliminate(linear, ordering), linear, ordering)
    except (RuntimeError, np.linalg.LinAlgError) as failure:
        raise EstimationError(
            f"the calibration of the {name} cannot be solved: its poses are not determined"
        ) from failure
