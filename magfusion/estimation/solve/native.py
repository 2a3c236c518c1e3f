"""GTSAM's own Levenberg-Marquardt, to compare with the loop of `bordered`."""

import gtsam
import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.solve.batched import MAX_ITERATIONS
from magfusion.estimation.solve.bordered import Optimised

SHARPER = 1e-3  # of the loop's tolerance: damped steps decrease the cost by less


def optimise_natively(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    ordering: gtsam.Ordering,
    tolerance: float,
) -> Optimised[gtsam.Values]:
    """Minimise the cost of a nonlinear graph.

    `tolerance`: relative decrease of the cost that ends the loop of `bordered`. Raises
    EstimationError where the initial cost is not finite, or the graph cannot be solved.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(SHARPER * tolerance)
    parameters.setAbsoluteErrorTol(SHARPER * tolerance)
    parameters.setMaxIterations(MAX_ITERATIONS)
    if not np.isfinite(graph.error(values)):
        raise EstimationError("the smoother's initial estimate has no finite cost")
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, ordering, parameters)
    try:
        result = optimiser.optimize()
    except RuntimeError as failure:
        reason = str(failure).strip().splitlines()[0]
        raise EstimationError(f"GTSAM cannot solve the graph ({reason})") from failure
    done = int(optimiser.iterations())
    return Optimised(result, float(optimiser.error()), done, converged=done < MAX_ITERATIONS)
