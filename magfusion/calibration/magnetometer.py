"""The error model of a magnetometer, and the result of its calibrations.

``measured = matrix @ field_sensor + offset``, as logs and sites have it.  Paper 001 has
``V = b + K o (B + E B)`` (Eq 1-3, with ``ezy Bz`` for the ``ezy By`` of Eq 2): the same with
``matrix = diag(K) (I + E)`` and ``offset = b``.

Gravity and angular rate are known in body axes, the field in sensor axes.  A rotation of the
mounting and one of the matrix cannot be separated: here the mounting ``body_from_sensor`` is kept
as declared and the matrix contains the rest, so that it need not be symmetric.
"""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.model.field import skew
from magfusion.model.site import Magnetometer
from magfusion.units import DEGREE, Array

POINTED = 45.0 * DEGREE  # an axis nearer to the vertical than this pointed up, or down
WIDE_MATRIX = 0.1  # prior sigma where the site declares none: an instrument nobody calibrated
WIDE_OFFSET = 1e-4  # T; the iron of a robot, twice the Earth's field

_AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class MagnetometerFit:
    """Matrix and offset of a magnetometer, or of many at once."""

    matrix: Array  # (..., 3, 3)
    offset: Array  # (..., 3) (T)
    cov: Array  # (..., 12, 12), of the matrix, row by row, then of the offset (1, T)


def from_paper(bias: Array, scale: Array, misalignment: Array) -> tuple[Array, Array]:
    """Return matrix and offset from the b, K and E of paper 001.

    `bias`, `scale` (..., 3) (T, 1). `misalignment` (..., 3, 3): zero on the diagonal; the entry of
    row a and column b is the paper's ``e_ba``.
    """
    return scale[..., None] * (np.eye(3) + misalignment), bias


def to_paper(matrix: Array, offset: Array) -> tuple[Array, Array, Array]:
    """Return the b, K and E of paper 001; see `from_paper`."""
    scale = np.diagonal(matrix, axis1=-2, axis2=-1)
    return offset, scale, matrix / scale[..., None] - np.eye(3)


def field_from_measured(measured: Array, matrix: Array, offset: Array) -> Array:
    """Return the field from calibrated readings.

    `measured` (..., n, 3) (T), `matrix` (..., 3, 3), `offset` (..., 3). Returns (..., n, 3) (T),
    sensor axes.
    """
    inverse = np.linalg.inv(matrix)
    return (measured - offset[..., None, :]) @ np.swapaxes(inverse, -1, -2)


def spread(field: Array) -> float:
    """Return standard deviation over mean of the magnitude of a field, shape (n, 3)."""
    size = np.linalg.norm(field, axis=1)
    return float(np.std(size) / np.mean(size))


def missing_orientations(up_sensor: Array) -> list[str]:
    """Describe which orientations a calibration lacks.

    `up_sensor` (n, 3): the vertical in sensor axes, of any length. For example ``the sensor's y
    axis never pointed up``; empty where each axis pointed, within 45 deg, both up and down.
    """
    unit = up_sensor / np.linalg.norm(up_sensor, axis=1, keepdims=True)
    missing = []
    for name, along in zip(_AXES, unit.T, strict=True):
        ways = (("up", float(np.max(along))), ("down", -float(np.min(along))))
        never = [way for way, maximum in ways if maximum < np.cos(POINTED)]
        if never:
            missing.append(f"the sensor's {name} axis never pointed {' or '.join(never)}")
    return missing


def prior_cov(declared: Magnetometer) -> Array:
    """Return the covariance of matrix and offset before the data, shape (12, 12).

    A sigma of zero, by which a site declares a value as known, is no prior for the job that
    estimates this value: `WIDE_MATRIX` and `WIDE_OFFSET` replace it.  The uncertainty of the
    mounting is added, because the matrix absorbs its error.
    """
    sigma = declared.sigma
    matrix = np.where(sigma.matrix > 0.0, sigma.matrix, WIDE_MATRIX)
    offset = np.where(sigma.offset > 0.0, sigma.offset, WIDE_OFFSET)
    out = np.diag(np.concatenate([matrix.ravel(), offset]) ** 2)
    turn = np.stack([(declared.matrix @ skew(axis)).ravel() for axis in np.eye(3)], axis=1)
    out[:9, :9] += turn @ np.diag(sigma.rotation_sensor**2) @ turn.T
    return out


def refined(declared: Magnetometer, fit: MagnetometerFit) -> Magnetometer:
    """Return the calibrated magnetometer, with sigmas in the form of a site.

    A site has one sigma for each entry of the matrix and one for each axis of the mounting, no
    correlations.  They are chosen so that the symmetric and the antisymmetric part of the matrix
    keep their variances: the excess of the antisymmetric part goes to the mounting.
    """
    square = fit.cov[:9, :9].reshape(3, 3, 3, 3)
    matrix = np.sqrt(np.einsum("ijij->ij", square))
    rotation = np.zeros(3)
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        own = square[j, k, j, k] + square[k, j, k, j]
        both = 2.0 * square[j, k, k, j]
        symmetric, antisymmetric = (own + both) / 4.0, (own - both) / 4.0
        if antisymmetric > symmetric:
            matrix[j, k] = matrix[k, j] = np.sqrt(2.0 * symmetric)
            rotation[axis] = np.sqrt(antisymmetric - symmetric)
    offset = np.sqrt(np.diagonal(fit.cov)[9:])
    sigma = replace(declared.sigma, matrix=matrix, offset=offset, rotation_sensor=rotation)
    return replace(declared, matrix=fit.matrix, offset=fit.offset, sigma=sigma)
