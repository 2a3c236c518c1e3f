"""Nonlinear least squares of many small problems at once (Levenberg-Marquardt).

The first axis of every array is the problem.  Each is solved independently, with its own damping;
a converged problem costs nothing more.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.units import Array, BoolArray, IntArray

MAX_ITERATIONS = 100  # a bound; the few that creep along a valley need more than 25
MIN_COST_DECREASE = 1e-11  # relative decrease of the cost below which a problem is solved
DIFFERENCE = 1e-6  # of a state of size one, on either side
ROUNDING = 1e-13  # relative increase of the cost that is rounding
DAMPING_START, DAMPING_LEAST, DAMPING_STOP = 1e-3, 1e-12, 1e9
DAMPING_DECREASE, TIGHTENED = (
    0.2,
    10.0,
)  # factors of the damping after a good step and after a bad one
ZERO_COLUMN_RATIO = (
    1e-15  # of the largest column of a Jacobian: no residual depends on this direction
)
# Smallest over largest singular value of a Jacobian of unit columns.  Rounding makes 1e-16 of a
# zero, whatever the processor; noise of a thousandth makes 1e-3 of it.
SINGULAR = 1e-7


class NormalEquations(NamedTuple):
    """Normal equations at some states; priors are residuals like any other.

    A method with better curvature than Gauss-Newton's returns it as ``information``, which must be
    positive semidefinite.
    """

    cost: Array  # (k,) sum of squares
    gradient: Array  # (k, n) half of it
    information: Array  # (k, n, n)


class Solution(NamedTuple):
    """Solutions of the problems."""

    state: Array  # (problems, ...) as the start
    cost: Array  # (problems,) sum of squares
    information: Array  # (problems, n, n) there
    converged: BoolArray  # (problems,) False where the passes ran out or nothing is finite


Model = Callable[[IntArray, Array], NormalEquations]


def normal_equations(residual: Array, jacobian: Array) -> NormalEquations:
    """Return the normal equations of residuals (k, d) and their Jacobian (k, d, n)."""
    transposed = np.swapaxes(jacobian, -1, -2)
    return NormalEquations(
        np.sum(residual**2, axis=-1),
        (transposed @ residual[..., None])[..., 0],
        transposed @ jacobian,
    )


def minimise(
    model: Model,
    start: Array,
    move: Callable[[Array, Array], Array] = np.add,
    *,
    max_iterations: int = MAX_ITERATIONS,
    relative: float = MIN_COST_DECREASE,
    absolute: float = 0.0,
) -> Solution:
    """Minimise the sum of squares of each problem.

    Parameters
    ----------
    model : callable
        Takes the numbers of the requested problems, shape (k,), and their states, shape (k, ...);
        returns the normal equations there.
    start : ndarray, shape (problems, ...)
        Of any type, also objects: only ``model`` and ``move`` use it.
    move : callable
        Takes states (k, ...) and steps (k, n) and returns the moved states; addition by default.
    max_iterations : int
        Maximum number.
    relative, absolute : float
        A step that decreases the cost by less than this share, or by less than this amount, is
        the last.
    """
    state = start.copy()
    rows = np.arange(len(state))
    normal = model(rows, state)
    result = Solution(
        state, normal.cost.copy(), normal.information.copy(), np.zeros(len(state), dtype=bool)
    )
    damping = np.full(len(rows), DAMPING_START)
    for _ in range(max_iterations):
        if not len(rows):
            break
        trial = move(state[rows], _step(normal, damping))
        new = model(rows, trial)
        fall = normal.cost - new.cost
        better = fall > 0.0  # False for a cost that is not finite
        converged = fall <= relative * new.cost + absolute
        converged &= fall >= -ROUNDING * normal.cost
        state[rows[better]] = trial[better]
        normal = NormalEquations(
            *(
                np.where(better.reshape(-1, *[1] * (now.ndim - 1)), now, before)
                for now, before in zip(new, normal, strict=True)
            )
        )
        damping = np.maximum(damping * np.where(better, DAMPING_DECREASE, TIGHTENED), DAMPING_LEAST)
        ended = converged | (damping > DAMPING_STOP)
        if np.any(ended):
            # Where no step decreases the cost, however short, it is minimal to rounding.
            solved = converged | np.isfinite(normal.cost)
            _keep(
                result,
                rows[ended],
                NormalEquations(*(part[ended] for part in normal)),
                solved[ended],
            )
            rows, damping = rows[~ended], damping[~ended]
            normal = NormalEquations(*(part[~ended] for part in normal))
    _keep(result, rows, normal, False)
    return result


def _keep(
    result: Solution, rows: IntArray, normal: NormalEquations, converged: BoolArray | bool
) -> None:
    result.cost[rows], result.information[rows] = normal.cost, normal.information
    result.converged[rows] = converged


def _step(normal: NormalEquations, damping: Array) -> Array:
    """Return the damped step of each problem, shape (k, n), whatever the units of its unknowns."""
    scale = _scale(np.sqrt(np.einsum("kii->ki", normal.information)))
    scaled = normal.information / (scale[:, :, None] * scale[:, None, :])
    # A direction on which no residual depends does not move.
    np.einsum("kii->ki", scaled)[...] += damping[:, None]
    return -np.linalg.solve(scaled, (normal.gradient / scale)[..., None])[..., 0] / scale


def _scale(size: Array) -> Array:
    largest = np.max(size, axis=-1, keepdims=True)
    return np.maximum(size, np.where(largest > 0.0, ZERO_COLUMN_RATIO * largest, 1.0))


def moved_poses(pose: Array, step: Array) -> Array:
    """Return poses (k, 12), rotation then position, moved by steps (k, 6) in their own axes."""
    rotation = pose[:, :9].reshape(-1, 3, 3)
    rotated = rotation @ Rotation.from_rotvec(step[:, :3]).as_matrix()
    position = pose[:, 9:] + (rotation @ step[:, 3:, None])[..., 0]
    return np.concatenate([rotated.reshape(-1, 9), position], axis=1)


def conditioning(jacobian: Array) -> Array:
    """Return the smallest over the largest singular value of Jacobians with unit columns.

    `jacobian` (..., d, n): of any units. Returns (...): from 0 to 1: below `SINGULAR` the residuals
    do not determine a direction.
    """
    if jacobian.shape[-2] < jacobian.shape[-1]:
        return np.zeros(jacobian.shape[:-2])
    scale = _scale(np.linalg.norm(jacobian, axis=-2))[..., None, :]
    size = np.linalg.svd(jacobian / scale, compute_uv=False)
    return size[..., -1] / np.maximum(size[..., 0], np.finfo(np.float64).tiny)


def by_differences(residual: Callable[[Array], Array], state: Array) -> tuple[Array, Array]:
    """Return residuals (k, d) and their Jacobian (k, d, n) by central differences.

    `residual`: takes states (k, n), of size one, and returns residuals (k, d). `state` (k, n).
    """
    n = state.shape[-1]
    sides = state[:, None] + DIFFERENCE * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
    value = residual(sides.reshape(-1, n)).reshape(len(state), 2 * n + 1, -1)
    slope = (value[:, 1 : n + 1] - value[:, n + 1 :]) / (2.0 * DIFFERENCE)
    return value[:, 0], np.swapaxes(slope, -1, -2)


def open_inverse(information: Array) -> tuple[Array, BoolArray]:
    """Return the inverse of information matrices, and whether they determine the pose.

    Unobservable directions get a large variance, not an infinite one. `information` (..., 6 +
    nuisances, 6 + nuisances).
    """
    value, vector = np.linalg.eigh(information)
    largest = value[..., -1:]
    # The phase of a missing channel is unobservable too, but is no direction of the pose.
    in_pose = np.sum(vector[..., :6, :] ** 2, axis=-2) > 1e-6
    open_direction = (value <= 1e-10 * largest) & in_pose
    safe = np.maximum(value, 1e-10 * largest + 1e-300)
    cov = (vector / safe[..., None, :]) @ np.swapaxes(vector, -1, -2)
    return cov, ~np.any(open_direction, axis=-1)
