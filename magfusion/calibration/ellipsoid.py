"""Calibration from turning alone: the readings lie on an ellipsoid, the field on a sphere.

The ellipsoid has nine parameters of the twelve: it does not see by which rotation its shape became
a sphere.  With the vertical known in the sensor's axes beside each reading, the angle between field
and vertical must be the same in all of them, which fixes the rotation too.
"""

import numpy as np

from magfusion.calibration.magnetometer import MagnetometerFit
from magfusion.errors import EstimationError
from magfusion.units import Array

FEWEST_READINGS = 9
_STEPS = 8  # of Gauss-Newton; three are enough where the readings go all round
_NO_ELLIPSOID = "the readings lie on no ellipsoid; turn the sensor all round, away from iron"
_SYMMETRIC = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]


def fit_ellipsoid(measured: Array, field_size: float) -> MagnetometerFit:
    """Fit the ellipsoid on which readings lie, by least squares of the field's size.

    Parameters
    ----------
    measured : ndarray, shape (..., n, 3)
        (T), n at least 9.
    field_size : float
        Of the field (T), the same in all readings.

    Returns
    -------
    MagnetometerFit
        The symmetric matrix of this shape; the covariance holds the rotation as known.

    Raises
    ------
    EstimationError
        Where the readings lie on no ellipsoid: too few of them, or all on one side.
    """
    scaled = measured / field_size
    inverse, centre = _algebraic(scaled)
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(_SYMMETRIC):
        basis[k, i, j] = basis[k, j, i] = 1.0
    for _ in range(_STEPS):
        error, jacobian = _size_rows(scaled, inverse, centre, basis)
        step = _solve(jacobian, error)
        inverse = inverse - np.einsum("...k,kij->...ij", step[..., :6], basis)
        centre = centre - step[..., 6:]
    error, jacobian = _size_rows(scaled, inverse, centre, basis)
    degrees = max(error.shape[-1] - 9, 1)
    variance = np.sum(error**2, axis=-1)[..., None, None] / degrees
    cov = variance * np.linalg.inv(np.swapaxes(jacobian, -1, -2) @ jacobian)
    return _fit(inverse, centre, cov, basis, field_size)


def fit_ellipsoid_gravity(measured: Array, up_sensor: Array, field_size: float) -> MagnetometerFit:
    """Fit all twelve parameters to the field's size and to its angle with the vertical.

    Parameters
    ----------
    measured : ndarray, shape (..., n, 3)
        (T)
    up_sensor : ndarray, shape (..., n, 3)
        The vertical, by the accelerometer at rest, of any length.
    field_size : float
        (T)

    Returns
    -------
    MagnetometerFit
        The dip is estimated beside it: it costs nothing where the orientations are varied.  Both
        residuals of a reading stem from the same noise and are correlated; the fit weighs them as
        if they were not (the graph does better), the covariance does not.

    Raises
    ------
    EstimationError
        As `fit_ellipsoid`.
    """
    scaled = measured / field_size
    up = up_sensor / np.linalg.norm(up_sensor, axis=-1, keepdims=True)
    start = fit_ellipsoid(scaled, 1.0)
    inverse, centre = np.asarray(np.linalg.inv(start.matrix)), start.offset
    basis = np.eye(9).reshape(9, 3, 3)
    along = np.sum(up * _field(scaled, inverse, centre), axis=-1)
    vertical = np.mean(along, axis=-1)
    for _ in range(_STEPS):
        error, jacobian = _both_rows(scaled, up, inverse, centre, vertical)
        step = _solve(jacobian, error)
        inverse = inverse - step[..., :9].reshape(inverse.shape)
        centre, vertical = centre - step[..., 9:12], vertical - step[..., 12]
    error, jacobian = _both_rows(scaled, up, inverse, centre, vertical)
    n = scaled.shape[-2]
    variance = np.sum(error**2, axis=-1)[..., None, None] / max(2 * n - 13, 1)
    transposed = np.swapaxes(jacobian, -1, -2)
    square = transposed @ jacobian
    shared = transposed[..., :n] @ jacobian[..., n:, :]
    noise = square + vertical[..., None, None] * (shared + np.swapaxes(shared, -1, -2))
    unit = np.linalg.inv(square)
    cov = variance * (unit @ noise @ unit)
    return _fit(inverse, centre, cov[..., :12, :12], basis, field_size)


def _field(measured: Array, inverse: Array, centre: Array) -> Array:
    return np.asarray((measured - centre[..., None, :]) @ np.swapaxes(inverse, -1, -2))


def _solve(jacobian: Array, error: Array) -> Array:
    transposed = np.swapaxes(jacobian, -1, -2)
    try:
        step = np.linalg.solve(transposed @ jacobian, transposed @ error[..., None])
    except np.linalg.LinAlgError as failure:
        raise EstimationError(_NO_ELLIPSOID) from failure
    return np.asarray(step[..., 0])


def _algebraic(points: Array) -> tuple[Array, Array]:
    """Return the symmetric map of an ellipsoid to the unit sphere, and its centre.

    The quadric ``p A p + 2 g p = 1`` is linear in its nine coefficients.
    """
    mean = np.mean(points, axis=-2, keepdims=True)
    x, y, z = np.moveaxis(points - mean, -1, 0)
    design = np.stack(
        [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z], axis=-1
    )
    if points.shape[-2] < FEWEST_READINGS:
        raise EstimationError(
            f"{points.shape[-2]} readings do not determine an ellipsoid; give {FEWEST_READINGS}"
        )
    found = np.sum(np.linalg.pinv(design), axis=-1)
    shape = np.empty((*found.shape[:-1], 3, 3))
    for k, (i, j) in enumerate(_SYMMETRIC):
        shape[..., i, j] = shape[..., j, i] = found[..., k]
    middle = -np.linalg.solve(shape, found[..., 6:, None])
    size = 1.0 + np.sum(middle[..., 0] * (shape @ middle)[..., 0], axis=-1)
    values, vectors = np.linalg.eigh(shape / size[..., None, None])
    if not np.all(values > 0.0):
        raise EstimationError(_NO_ELLIPSOID)
    root = np.sqrt(values)[..., None, :] * vectors @ np.swapaxes(vectors, -1, -2)
    return np.asarray(root), np.asarray(middle[..., 0] + mean[..., 0, :])


def _size_rows(measured: Array, inverse: Array, centre: Array, basis: Array) -> tuple[Array, Array]:
    """Return ``|field| - 1`` and its derivative by the coefficients of ``basis`` and the centre."""
    field = _field(measured, inverse, centre)
    size = np.linalg.norm(field, axis=-1)
    by_inverse, by_centre = _rows(measured, field / size[..., None], inverse, centre, basis)
    return size - 1.0, np.concatenate([by_inverse, by_centre], axis=-1)


def _both_rows(
    measured: Array, up: Array, inverse: Array, centre: Array, vertical: Array
) -> tuple[Array, Array]:
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
    found = np.asarray(change @ cov @ np.swapaxes(change, -1, -2))
    return MagnetometerFit(matrix, field_size * centre, found)
