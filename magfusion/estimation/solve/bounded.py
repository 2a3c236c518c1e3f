"""The minimum of a cost that is no sum of squares, of few unknowns between limits."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from magfusion.units import Array

DECREASE = 1e-4  # of the cost; the step that lowers it by less is the last


def minimise_bounded(
    cost: Callable[[Array], float],
    start: Array,
    limits: Array,
    steps: int = 20,
    decrease: float = DECREASE,
) -> Array:
    """Return where a cost is least, by a quasi-Newton method (SciPy's L-BFGS-B).

    Its slopes are taken of differences.

    Parameters
    ----------
    cost : callable
        Takes an ndarray of shape (n,); of size one.
    start : ndarray, shape (n,)
    limits : ndarray, shape (n, 2)
        Least and greatest value of each unknown.
    steps : int
        At most.
    decrease : float
        Of the cost, relative; the step that lowers it by less is the last.
    """
    options = {"maxiter": steps, "ftol": decrease}
    found = minimize(cost, start, method="L-BFGS-B", bounds=limits, options=options)
    return np.asarray(found.x)


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
