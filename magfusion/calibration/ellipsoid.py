"""Calibration from rotation alone: the readings lie on an ellipsoid, the field on a sphere.

The ellipsoid has nine of the twelve parameters: the rotation between the ellipsoid and the sphere
is unobservable.  If the vertical in sensor axes is known for each reading, the angle between field
and vertical must be the same in all of them, which determines the rotation too.
"""

from collections.abc import Callable

import numpy as np

from magfusion.calibration.magnetometer import MagnetometerFit
from magfusion.errors import EstimationError
from magfusion.estimation.solve.batched import (
    SINGULAR,
    NormalEquations,
    conditioning,
    minimise,
    normal_equations,
)
from magfusion.units import Array, IntArray

MIN_READINGS = 9
EXACT = 1e-12  # of the field; a residual that is rounding
# Thresholds for readings on no ellipsoid, far from rounding errors and from any real instrument.
NARROWEST = 0.03  # shortest over longest axis
OFF_SURFACE = 0.1  # of the field; by which readings miss the surface
LOOSEST = 0.3  # of the longest axis; sigma of the shape
_NO_ELLIPSOID = "the readings lie on no ellipsoid; rotate the sensor about all axes, away from iron"
_SYMMETRIC = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]


def fit_ellipsoid(measured: Array, field_size: float) -> MagnetometerFit:
    """Fit an ellipsoid to readings, by least squares of the field's magnitude.

    `measured` (..., n, 3) (T), n at least 9. `field_size`: of the field (T), the same in all
    readings. Returns the symmetric matrix of this shape; the covariance assumes a known rotation.
    Raises EstimationError where the readings lie on no ellipsoid: too few of them, or all on one
    side.
    """
    scaled = measured / field_size
    if scaled.shape[-2] < MIN_READINGS:
        raise EstimationError(
            f"{scaled.shape[-2]} readings do not determine an ellipsoid; give {MIN_READINGS}"
        )
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(_SYMMETRIC):
        basis[k, i, j] = basis[k, j, i] = 1.0
    shape, centre = _algebraic(scaled)
    start = np.concatenate([shape[..., *np.transpose(_SYMMETRIC)], centre], axis=-1)

    def rows_at(points: Array, state: Array) -> tuple[Array, Array]:
        inverse = np.einsum("...k,kij->...ij", state[..., :6], basis)
        return _size_rows(points, inverse, state[..., 6:], basis)

    result, error, jacobian = _solved(rows_at, start, scaled)
    inverse = np.einsum("...k,kij->...ij", result[..., :6], basis)
    variance = np.sum(error**2, axis=-1)[..., None, None] / max(error.shape[-1] - 9, 1)
    cov = variance * np.linalg.inv(np.swapaxes(jacobian, -1, -2) @ jacobian)
    axes = np.linalg.eigvalsh(inverse)
    sigma = np.sqrt(np.max(np.einsum("...ii->...i", cov)[..., :6], axis=-1))
    if (
        np.any(axes[..., 0] < NARROWEST * axes[..., -1])
        or np.any(np.std(error, axis=-1) > OFF_SURFACE)
        or np.any(sigma > LOOSEST * axes[..., -1])
    ):
        raise EstimationError(_NO_ELLIPSOID)
    return _fit(inverse, result[..., 6:], cov, basis, field_size)


def fit_ellipsoid_gravity(measured: Array, up_sensor: Array, field_size: float) -> MagnetometerFit:
    """Fit all twelve parameters to the field's magnitude and to its angle with the vertical.

    `measured` (..., n, 3) (T). `up_sensor` (..., n, 3): the vertical, measured by the accelerometer
    at rest, of any length. `field_size` (T). The dip is also estimated, at no loss of accuracy for
    varied orientations. Both residuals of a reading stem from the same noise and are correlated;
    the fit ignores the correlation (the graph does not), the covariance includes it. Raises
    EstimationError as `fit_ellipsoid`.
    """
    scaled = measured / field_size
    up = up_sensor / np.linalg.norm(up_sensor, axis=-1, keepdims=True)
    shape = fit_ellipsoid(scaled, 1.0)
    first: Array = np.asarray(np.linalg.inv(shape.matrix))
    vertical = np.mean(np.sum(up * _field(scaled, first, shape.offset), axis=-1), axis=-1)
    flat = first.reshape(*first.shape[:-2], 9)
    start = np.concatenate([flat, shape.offset, vertical[..., None]], axis=-1)
    result, error, jacobian = _solved(_both_rows, start, scaled, up)
    inverse, vertical = result[..., :9].reshape(first.shape), result[..., 12]
    n = scaled.shape[-2]
    variance = np.sum(error**2, axis=-1)[..., None, None] / max(2 * n - 13, 1)
    transposed = np.swapaxes(jacobian, -1, -2)
    square = transposed @ jacobian
    shared = transposed[..., :n] @ jacobian[..., n:, :]
    noise = square + vertical[..., None, None] * (shared + np.swapaxes(shared, -1, -2))
    unit = np.linalg.inv(square)
    cov = variance * (unit @ noise @ unit)
    basis = np.eye(9).reshape(9, 3, 3)
    return _fit(inverse, result[..., 9:12], cov[..., :12, :12], basis, field_size)


def _field(measured: Array, inverse: Array, centre: Array) -> Array:
    return (measured - centre[..., None, :]) @ np.swapaxes(inverse, -1, -2)


def _solved(
    rows_at: Callable[..., tuple[Array, Array]], start: Array, *readings: Array
) -> tuple[Array, Array, Array]:
    """Return the least-squares state (..., k) with its residuals and their Jacobian.

    Raises EstimationError where the readings do not determine the state, or the search does not
    converge.
    """
    each = [part.reshape(-1, *part.shape[-2:]) for part in readings]

    def model(rows: IntArray, state: Array) -> NormalEquations:
        return normal_equations(*rows_at(*(part[rows] for part in each), state))

    solution = minimise(model, start.reshape(-1, start.shape[-1]), absolute=EXACT**2)
    result = solution.state.reshape(start.shape)
    error, jacobian = rows_at(*readings, result)
    if not np.all(solution.converged) or np.any(conditioning(jacobian) < SINGULAR):
        raise EstimationError(_NO_ELLIPSOID)
    return result, error, jacobian


def _algebraic(points: Array) -> tuple[Array, Array]:
    """Return the symmetric map of an ellipsoid to the unit sphere, and its centre.

    The quadric ``p A p + 2 g p = 1`` is linear in its nine coefficients.
    """
    mean = np.mean(points, axis=-2, keepdims=True)
    x, y, z = np.moveaxis(points - mean, -1, 0)
    design = np.stack(
        [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z], axis=-1
    )
    if np.any(conditioning(design) < SINGULAR):
        raise EstimationError(_NO_ELLIPSOID)
    result = np.sum(np.linalg.pinv(design), axis=-1)
    shape = np.empty((*result.shape[:-1], 3, 3))
    for k, (i, j) in enumerate(_SYMMETRIC):
        shape[..., i, j] = shape[..., j, i] = result[..., k]
    along = np.linalg.eigvalsh(shape)
    if np.any(np.min(np.abs(along), axis=-1) < NARROWEST**2 * np.max(np.abs(along), axis=-1)):
        raise EstimationError(_NO_ELLIPSOID)
    middle = -np.linalg.solve(shape, result[..., 6:, None])
    size = 1.0 + np.sum(middle[..., 0] * (shape @ middle)[..., 0], axis=-1)
    values, vectors = np.linalg.eigh(shape / size[..., None, None])
    if not np.all(values > 0.0):
        raise EstimationError(_NO_ELLIPSOID)
    root = np.sqrt(values)[..., None, :] * vectors @ np.swapaxes(vectors, -1, -2)
    return root, middle[..., 0] + mean[..., 0, :]


def _size_rows(measured: Array, inverse: Array, centre: Array, basis: Array) -> tuple[Array, Array]:
    """Return ``|field| - 1`` and its derivative by the coefficients of ``basis`` and the centre."""
    field = _field(measured, inverse, centre)
    size = np.linalg.norm(field, axis=-1)
    by_inverse, by_centre = _rows(measured, field / size[..., None], inverse, centre, basis)
    return size - 1.0, np.concatenate([by_inverse, by_centre], axis=-1)


def _both_rows(measured: Array, up: Array, state: Array) -> tuple[Array, Array]:
    inverse = state[..., :9].reshape(*state.shape[:-1], 3, 3)
    centre, vertical = state[..., 9:12], state[..., 12]
    basis = np.eye(9).reshape(9, 3, 3)
    size_error, by_size = _size_rows(measured, inverse, centre, basis)
    along = np.sum(up * _field(measured, inverse, centre), axis=-1)
    by_angle = np.concatenate(_rows(measured, up, inverse, centre, basis), axis=-1)
    column = np.zeros((*along.shape, 1))
    jacobian = np.concatenate(
        [
            np.concatenate([by_size, column], axis=-1),
            np.concatenate([by_angle, column - 1.0], axis=-1),
        ],
        axis=-2,
    )
    return np.concatenate([size_error, along - vertical[..., None]], axis=-1), jacobian


def _rows(
    measured: Array, weight: Array, inverse: Array, centre: Array, basis: Array
) -> tuple[Array, Array]:
    """Return the derivatives of ``weight . inverse (measured - centre)``."""
    moved = measured - centre[..., None, :]
    by_inverse = np.einsum("...ni,kij,...nj->...nk", weight, basis, moved, optimize=True)
    return by_inverse, -weight @ inverse


def _fit(
    inverse: Array, centre: Array, cov: Array, basis: Array, field_size: float
) -> MagnetometerFit:
    matrix = np.asarray(np.linalg.inv(inverse))
    count = len(basis)
    by_inverse = -matrix[..., None, :, :] @ basis @ matrix[..., None, :, :]
    change = np.zeros((*matrix.shape[:-2], 12, count + 3))
    flat = by_inverse.reshape(*matrix.shape[:-2], count, 9)
    change[..., :9, :count] = np.swapaxes(flat, -1, -2)
    change[..., 9:, count:] = field_size * np.eye(3)
    result = change @ cov @ np.swapaxes(change, -1, -2)
    return MagnetometerFit(matrix, field_size * centre, result)
