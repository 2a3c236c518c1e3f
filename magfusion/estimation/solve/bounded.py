"""Minimisation of costs that are no sums of squares, of few bounded unknowns."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from magfusion.units import Array, BoolArray

DECREASE = 1e-6  # of the cost; a step that decreases it by less is the last
DECREASE_CURVED = 1e-9  # relative; a Newton step that decreases a cost by less is the last
MAX_BOUNDED_STEPS = 100
MAX_CURVED_STEP = 2.0  # of the steps of `minimise_curved`: beyond, a curvature is not valid
SUFFICIENT = 1e-4  # share of the decrease that the slope predicts
FLATTEST = 1e-10  # of the largest curvature
LINEAR = 0.05  # share of a slope by which a curvature may differ from that of a pure variance
MAX_STEPS = 200
MIN_STEP = 1e-2  # of a logarithm; a smaller step is near the minimum
MIN_RELATIVE_STEP = 1e-9  # of a step; if that does not decrease the cost, the rest is rounding
DIFFERENCE = 1e-3  # of an unknown: rounding of a cost that solves large systems is far below it


def minimise_bounded(
    cost: Callable[[Array], float], start: Array, limits: Array, decrease: float = DECREASE
) -> Array:
    """Return the minimum of a cost by a quasi-Newton method (SciPy's L-BFGS-B).

    Slopes are central differences with a step suited to rounding.  With SciPy's own step, a hundred
    thousand times smaller, the search ended where rounding let no step decrease the cost. `cost`:
    takes an ndarray of shape (n,); smooth over `DIFFERENCE` of each unknown. `start` (n,).
    `limits` (n, 2): lower and upper bound of each unknown. `decrease`: of the cost, relative; a
    step that decreases it by less is the last.
    """
    lateral = DIFFERENCE * np.eye(len(start))

    def sloped(at: Array) -> tuple[float, Array]:
        slopes = [(cost(at + one) - cost(at - one)) / (2.0 * DIFFERENCE) for one in lateral]
        return cost(at), np.array(slopes)

    options = {"maxiter": MAX_STEPS, "ftol": decrease}
    result = minimize(sloped, start, jac=True, method="L-BFGS-B", bounds=limits, options=options)
    return np.asarray(result.x)


def minimise_curved(
    cost: Callable[[Array], Array],
    curved: Callable[[Array], tuple[Array, Array]],
    start: Array,
    limits: Array,
) -> Array:
    """Return the minima of costs of logarithms of sigmas by a projected Newton method.

    Bertsekas, SIAM J. Control Optim. 20, 1982, with the absolute eigenvalues of the curvature, to
    leave saddles.  For hundreds of searches of a few unknowns: SciPy's bookkeeping would take
    several times as long as the costs, and ours as long as they, so independent searches run in one
    batch. `cost`: returns the cost of each search, shape (k,), at an ndarray of shape (k, n).
    `curved`: returns gradients, shape (k, n), and curvatures, shape (k, n, n). `start` (k, n).
    `limits` (n, 2): lower and upper bound of each unknown.
    """
    low, high = limits.T
    at = np.minimum(np.maximum(start, low), high)
    here, going = cost(at), np.ones(len(at), dtype=bool)
    for _ in range(MAX_BOUNDED_STEPS):
        slope, curvature = curved(at)
        free_parameters = ~((at <= low) & (slope > 0.0) | (at >= high) & (slope < 0.0))
        going &= free_parameters.any(axis=1)
        if not going.any():
            break
        step = (
            _downhill(
                free_parameters * slope,
                curvature * (free_parameters[:, :, None] & free_parameters[:, None]),
            )
            * free_parameters
        )
        step *= MAX_CURVED_STEP / np.maximum(
            np.abs(step).max(axis=1, keepdims=True), MAX_CURVED_STEP
        )
        predicted = -0.5 * (slope * step).sum(axis=1)
        last = predicted < DECREASE_CURVED * np.maximum(np.abs(here), 1.0)
        # In the logarithm of a vanishing variance every step is a half, again and again.
        # Before the others converge it may yet be needed, and cannot return from there.
        falling = free_parameters & (slope > 0.0)
        diagonal = curvature.reshape(len(at), -1)[:, :: at.shape[1] + 1]
        falling &= np.abs(diagonal - 2.0 * slope) < LINEAR * slope
        fallen = falling.any(axis=1)
        if fallen.any():
            fallen &= (falling | (np.abs(step) < MIN_STEP)).all(axis=1)
            step = np.where(falling & fallen[:, None], low - at, step)
            last &= ~fallen
        at, here, going = _line_search_step(cost, at, here, step, slope, low, high, going)
        going &= ~last
    return at


def _line_search_step(
    cost: Callable[[Array], Array],
    at: Array,
    here: Array,
    step: Array,
    slope: Array,
    low: Array,
    high: Array,
    going: BoolArray,
) -> tuple[Array, Array, BoolArray]:
    """Return searches after the longest decreasing part of a step, the cost, and which moved."""
    remaining, elapsed = going.copy(), np.zeros(len(at), dtype=bool)
    while True:
        remaining &= (np.abs(step) > MIN_RELATIVE_STEP).any(axis=1)
        if not remaining.any():
            return at, here, elapsed
        tried = np.minimum(np.maximum(at + step, low), high)
        there = cost(tried)
        predicted = SUFFICIENT * np.minimum((slope * step).sum(axis=1), 0.0)
        result = remaining & (there <= here + predicted)
        at, here = np.where(result[:, None], tried, at), np.where(result, there, here)
        remaining, elapsed, step = remaining & ~result, elapsed | result, 0.5 * step


def _downhill(slope: Array, curvature: Array) -> Array:
    """Return Newton's steps with the absolute eigenvalues of curvatures."""
    size, axes = np.linalg.eigh(curvature)
    size = np.abs(size)
    floor = size.max(axis=1, keepdims=True) * FLATTEST
    size = np.maximum(size, np.where(floor > 0.0, floor, 1.0))
    along = (slope[:, None] @ axes)[:, 0] / size
    return np.asarray(-(axes @ along[:, :, None])[:, :, 0])


def minimise_between(
    cost: Callable[[float], float], low: float, high: float, tolerance: float
) -> tuple[float, float]:
    """Return the minimum of a cost of one bounded unknown, and that cost (Brent's method).

    `tolerance`: of the unknown.
    """
    options = {"xatol": tolerance}
    result = minimize_scalar(cost, bounds=(low, high), method="bounded", options=options)
    return float(result.x), float(result.fun)
