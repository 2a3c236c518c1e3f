"""The minimum of a cost that is no sum of squares, of few unknowns between limits."""

from collections.abc import Callable

import numpy as np

from magfusion.units import Array

DECREASE = 1e-6  # of the cost; the step that lowers it by less is the last
DECREASE_CURVED = 1e-9  # relative; the step of Newton that lowers a cost by less is the last
MOST_STEPS = 100
LONGEST = 2.0  # of the steps of `minimise_curved`: beyond, a curvature says nothing
SUFFICIENT = 1e-4  # share of the decrease that the slope promises
FLATTEST = 1e-10  # of the largest curvature
LINEAR = 0.05  # share of a slope by which a curvature may differ from that by a mere variance
FOUND = 1e-2  # of a logarithm; a smaller step is near the end
SHORTEST = 1e-9  # of a step; where that goes not down, rounding is all
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
    from scipy.optimize import minimize  # which takes long to import, and few ask

    aside = DIFFERENCE * np.eye(len(start))

    def sloped(at: Array) -> tuple[float, Array]:
        slopes = [(cost(at + one) - cost(at - one)) / (2.0 * DIFFERENCE) for one in aside]
        return cost(at), np.array(slopes)

    options = {"maxiter": steps, "ftol": decrease}
    found = minimize(sloped, start, jac=True, method="L-BFGS-B", bounds=limits, options=options)
    return np.asarray(found.x)


def minimise_curved(
    cost: Callable[[Array], float],
    curved: Callable[[Array], tuple[Array, Array]],
    start: Array,
    limits: Array,
) -> Array:
    """Return where a cost of logarithms of sigmas is least, by a projected Newton method.

    Bertsekas, SIAM J. Control Optim. 20, 1982, with the absolute eigenvalues of the curvature, so
    that saddles are left.  For searches of a few unknowns by the hundred, of which SciPy's own
    bookkeeping takes several times what the costs do.

    Parameters
    ----------
    curved : callable
        Returns gradient, shape (n,), and curvature, shape (n, n), at an ndarray of shape (n,).
    start : ndarray, shape (n,)
    limits : ndarray, shape (n, 2)
        Least and greatest value of each unknown.
    """
    low, high = limits.T
    at = np.clip(start, low, high)
    here = cost(at)
    for _ in range(MOST_STEPS):
        slope, curvature = curved(at)
        free = ~((at <= low) & (slope > 0.0) | (at >= high) & (slope < 0.0))
        if not np.any(free):
            break
        step = np.zeros_like(at)
        step[free] = _downhill(slope[free], curvature[np.ix_(free, free)])
        step *= LONGEST / max(float(np.max(np.abs(step))), LONGEST)
        last = -0.5 * float(slope @ step) < DECREASE_CURVED * max(abs(here), 1.0)
        # By the logarithm of a variance that comes to nothing a step is a half, again and again.
        # Before the others are found it may yet be wanted, and does not come back from there.
        falling = free & (slope > 0.0)
        falling &= np.abs(np.diagonal(curvature) - 2.0 * slope) < LINEAR * slope
        if np.any(falling) and np.all(np.abs(step[~falling]) < FOUND):
            step[falling] = (low - at)[falling]
            last = False
        found = False
        while not found and np.any(np.abs(step) > SHORTEST):
            tried = np.clip(at + step, low, high)
            there = cost(tried)
            found = there <= here + SUFFICIENT * min(float(slope @ step), 0.0)
            step *= 0.5
        if not found:
            break
        at, here = tried, there
        if last:
            break
    return at


def _downhill(slope: Array, curvature: Array) -> Array:
    """Return Newton's step with the absolute eigenvalues of a curvature."""
    size, axes = np.linalg.eigh(curvature)
    size = np.abs(size)
    floor = float(np.max(size)) * FLATTEST
    if floor == 0.0:
        return -slope
    return np.asarray(-axes @ ((axes.T @ slope) / np.maximum(size, floor)))


def minimise_between(
    cost: Callable[[float], float], low: float, high: float, tolerance: float
) -> tuple[float, float]:
    """Return where a cost of one unknown is least between two values, and that cost (Brent's).

    Parameters
    ----------
    tolerance : float
        Of the unknown.
    """
    from scipy.optimize import minimize_scalar

    options = {"xatol": tolerance}
    found = minimize_scalar(cost, bounds=(low, high), method="bounded", options=options)
    return float(found.x), float(found.fun)
