"""The optimisation loop of sparse poses with a dense calibration, over GTSAM's linear layer.

Independent of the problem, which linearises itself in batched calls; GTSAM eliminates.  The only
fallback from Cholesky to QR is here.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import gtsam
import numpy as np

from magfusion.errors import EstimationError
from magfusion.units import Array

S = TypeVar("S")

DAMPING_START, DAMPING_STOP = 1e-2, 1e10
STALLED = 1e-9  # relative increase of the cost that is rounding
UNDETERMINED = 1e12  # variance of a variable that is too badly determined to invert


class BorderedProblem(Protocol[S]):
    """A sum of squares as a function of an estimate ``S``."""

    @property
    def ordering(self) -> gtsam.Ordering:
        """Elimination order: the calibration last."""
        ...

    def cost(self, estimate: S) -> float:
        """Return half the sum of squared whitened residuals, priors included."""
        ...

    def linearized(self, estimate: S) -> gtsam.GaussianFactorGraph:
        """Return the linear graph at an estimate."""
        ...

    def moved(self, estimate: S, step: gtsam.VectorValues) -> S:
        """Return the estimate moved by a step of every variable."""
        ...

    def damping_scales(self) -> Iterable[tuple[int, Array]]:
        """Return, for each key, the step that a unit damping allows."""
        ...


@dataclass(frozen=True, eq=False)
class Optimised(Generic[S]):
    """Result of the loop."""

    estimate: S
    cost: float  # half the sum of squares
    iterations: int
    converged: bool


def eliminate(
    graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> gtsam.GaussianBayesTree:
    """Return the Bayes tree of a linear graph: by Cholesky, or by QR where that fails.

    Raises RuntimeError from GTSAM, for a singular system.
    """
    try:
        return graph.eliminateMultifrontal(ordering)
    except RuntimeError:  # an ill-conditioned stretch: QR needs half the digits
        return graph.eliminateMultifrontal(ordering, gtsam.EliminateQR)


def eliminate_in_sequence(
    graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> gtsam.GaussianBayesNet | None:
    """Return the conditionals of a linear graph, to be solved with other right-hand sides.

    None where Cholesky fails: with QR's triangle alone such solutions have half the digits.
    """
    try:
        return graph.eliminateSequential(ordering)
    except RuntimeError:
        return None


def eliminate_partial(
    graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, *, orthogonal: bool = False
) -> tuple[gtsam.GaussianBayesNet, gtsam.GaussianFactorGraph]:
    """Return the conditionals of some variables, and the Schur complement of the others.

    `orthogonal`: use QR directly: the Schur complement is then a square root. Raises RuntimeError
    from GTSAM, for a singular system.
    """
    if not orthogonal:
        try:
            return graph.eliminatePartialSequential(ordering)
        except RuntimeError:  # as in eliminate
            pass
    return graph.eliminatePartialSequential(ordering, gtsam.EliminateQR)


def marginal(tree: gtsam.GaussianBayesTree, key: int, size: int) -> Array:
    """Return the covariance of a variable; `UNDETERMINED` where the tree cannot be inverted."""
    try:
        return np.array(tree.marginalCovariance(key))
    except RuntimeError:  # a tree supports Cholesky only
        return UNDETERMINED * np.eye(size)


def last_marginal(
    tree: gtsam.GaussianBayesTree, graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> Array:
    """Return the covariance of the last variable of an ordering.

    `tree`: of the graph, in this ordering.
    """
    kept, others = gtsam.Ordering(), gtsam.Ordering()
    kept.push_back(ordering.at(ordering.size() - 1))
    try:
        return np.array(tree.marginalCovariance(kept.at(0)))
    except RuntimeError:  # a tree supports Cholesky only
        for i in range(ordering.size() - 1):
            others.push_back(ordering.at(i))
        _, rest = eliminate_partial(graph, others, orthogonal=True)
        return np.array(np.linalg.inv(rest.hessian(kept)[0]))


def optimise(
    problem: BorderedProblem[S],
    estimate: S,
    *,
    iterations: int = 30,
    tolerance: float = 1e-6,
    report: Callable[[int, float], None] | None = None,
) -> Optimised[S]:
    """Minimise the cost by Gauss-Newton steps, damped (Levenberg-Marquardt) where they fail.

    `estimate`: initial estimate. `tolerance`: relative decrease of the cost that ends the loop.
    `report`: takes the iteration and its cost. Raises EstimationError where the initial cost is not
    finite, or the graph cannot be solved.
    """
    cost = problem.cost(estimate)
    if not np.isfinite(cost):
        raise EstimationError("the smoother's initial estimate has no finite cost")
    damping, done = 0.0, 0
    while done < iterations:
        graph = problem.linearized(estimate)
        while True:
            system = graph if damping == 0.0 else _damped(problem, graph, damping)
            trial, new_cost, step = _tried(problem, estimate, system)
            if new_cost <= cost:
                break
            rounding = tolerance * (1.0 + cost)
            if damping == 0.0 and step is not None and _predicted_decrease(graph, step) <= rounding:
                return Optimised(estimate, cost, done, converged=True)
            if new_cost <= cost * (1 + STALLED) or damping > DAMPING_STOP:
                return Optimised(estimate, cost, done, converged=damping <= DAMPING_STOP)
            damping = max(DAMPING_START, 10.0 * damping)
        decrease = cost - new_cost
        estimate, cost, done = trial, new_cost, done + 1
        damping = 0.0 if damping <= DAMPING_START else damping / 10.0
        if report is not None:
            report(done, cost)
        if decrease <= tolerance * (1.0 + cost) and damping == 0.0:
            return Optimised(estimate, cost, done, converged=True)
    return Optimised(estimate, cost, done, converged=False)


def _tried(
    problem: BorderedProblem[S], estimate: S, system: gtsam.GaussianFactorGraph
) -> tuple[S, float, gtsam.VectorValues | None]:
    """Return the estimate after a linear solve, its cost and the step; infinite on failure."""
    try:
        step = eliminate(system, problem.ordering).optimize()
        trial = problem.moved(estimate, step)
        return trial, problem.cost(trial), step
    except RuntimeError:
        return estimate, np.inf, None


def _predicted_decrease(graph: gtsam.GaussianFactorGraph, step: gtsam.VectorValues) -> float:
    """Return the decrease of the linear graph's cost by a step."""
    return float(graph.error(gtsam.VectorValues.Zero(step)) - graph.error(step))


def _damped(
    problem: BorderedProblem[S], graph: gtsam.GaussianFactorGraph, damping: float
) -> gtsam.GaussianFactorGraph:
    out = gtsam.GaussianFactorGraph()
    out.push_back(graph)
    for key, step in problem.damping_scales():
        unit = gtsam.noiseModel.Unit.Create(len(step))
        weight = np.diag(np.sqrt(damping) / step)
        out.push_back(gtsam.JacobianFactor(key, weight, np.zeros(len(step)), unit))
    return out
