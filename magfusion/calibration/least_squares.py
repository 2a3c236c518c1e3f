"""Nonlinear least squares of many small problems at once (Levenberg-Marquardt)."""

from collections.abc import Callable

import numpy as np

from magfusion.units import Array, IntArray

Model = Callable[[IntArray, Array], tuple[Array, Array]]

PASSES = 100
SETTLED = 1e-11  # relative fall of the cost below which a problem is solved
STUCK = 1e9  # damping above which no step helps


def minimise(
    model: Model,
    start: Array,
    move: Callable[[Array, Array], Array] = np.add,
    passes: int = PASSES,
) -> tuple[Array, Array]:
    """Minimise the sum of squares of each problem, as if it were alone.

    Parameters
    ----------
    model : callable
        Takes the numbers of the problems asked for, shape (k,), and their states, shape
        (k, size); returns residuals (k, d) and slopes (k, d, n).
    start : ndarray, shape (problems, size)
    move : callable
        Takes states (k, size) and steps (k, n); addition by default.
    passes : int

    Returns
    -------
    state : ndarray, shape (problems, size)
    cost : ndarray, shape (problems,)
        Sum of squares.
    """
    state = np.array(start, dtype=np.float64)
    rows = np.arange(len(state))
    damping = np.full(len(state), 1e-4)
    residual, slope = model(rows, state)
    cost = np.sum(residual**2, axis=-1)
    for _ in range(passes):
        if len(rows) == 0:
            break
        step = _step(residual, slope, damping[rows])
        trial = move(state[rows], step)
        new_residual, new_slope = model(rows, trial)
        new_cost = np.sum(new_residual**2, axis=-1)
        better = new_cost < cost[rows]
        fall = cost[rows] - new_cost
        done = better & (fall <= SETTLED * cost[rows]) | (damping[rows] > STUCK)
        state[rows[better]] = trial[better]
        cost[rows[better]] = new_cost[better]
        damping[rows] *= np.where(better, 0.1, 10.0)
        residual = np.where(better[:, None], new_residual, residual)[~done]
        slope = np.where(better[:, None, None], new_slope, slope)[~done]
        rows = rows[~done]
    return state, cost


def _step(residual: Array, slope: Array, damping: Array) -> Array:
    transposed = np.swapaxes(slope, -1, -2)
    normal = transposed @ slope
    size = np.einsum("kii->ki", normal)
    # A direction that no residual feels stays where it is.
    floor = np.maximum(1e-12 * np.max(size, axis=-1, keepdims=True), np.finfo(np.float64).tiny)
    damped = normal + (damping[:, None] * size + floor)[:, :, None] * np.eye(size.shape[-1])
    return -np.linalg.solve(damped, transposed @ residual[..., None])[..., 0]
