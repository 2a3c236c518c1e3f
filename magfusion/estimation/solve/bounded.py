"""The minimum of a cost that is no sum of squares, of few unknowns between limits."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from magfusion.units import Array

DECREASE = 1e-6  # of the cost; the step that lowers it by less is the last
DIFFERENCE = 1e-3  # of an unknown: rounding of a cost that solves large systems is far below it


def minimise_bounded(
    cost: Callable[[Array], float],
    start: Array,
    limits: Array,
    steps: int = 200,
    decrease: float = DECREASE,
) -> Array:
    """Return where a cost is least, by a quasi-Newton method (SciPy's L-BFGS-B).

    Its slopes are of central differences, as far apart as rounding asks: by SciPy's own, a hundred
    thousand times closer, it ended where the processor's rounding let no step go down.

    Parameters
    ----------
    cost : callable
        Takes an ndarray of shape (n,); smooth over `DIFFERENCE` of each unknown.
    start : ndarray, shape (n,)
    limits : ndarray, shape (n, 2)
        Least and greatest value of each unknown.
    steps : int
        At most.
    decrease : float
        Of the cost, relative; the step that lowers it by less is the last.
    """
    aside = DIFFERENCE * np.eye(len(start))

    def sloped(at: Array) -> tuple[float, Array]:
        slopes = [(cost(at + one) - cost(at - one)) / (2.0 * DIFFERENCE) for one in aside]
        return cost(at), np.array(slopes)

    return minimise_sloped(sloped, start, limits, steps, decrease)


def minimise_sloped(
    cost: Callable[[Array], tuple[float, Array]],
    start: Array,
    limits: Array,
    steps: int,
    decrease: float,
) -> Array:
    """Return where a cost is least that tells its gradient, shape (n,), with it.

    Otherwise as `minimise_bounded`.
    """
    options = {"maxiter": steps, "ftol": decrease}
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=limits, options=options)
    return np.asarray(found.x)


def minimise_between(
    cost: Callable[[float], float], low: float, high: float, tolerance: float
) -> tuple[float, float]:
    """Return where a cost of one unknown is least between two values, and that cost (Brent's).

    Parameters
    ----------
    tolerance : float
        Of the unknown.
    """
    options = {"xatol": tolerance}
    found = minimize_scalar(cost, bounds=(low, high), method="bounded", options=options)
    return float(found.x), float(found.fun)
