"""Calibration on a turntable in twelve attitudes (paper 001): closed formulas and least squares."""

import numpy as np

from magfusion.calibration.magnetometer import MagnetometerFit
from magfusion.papers.p001_magnetometer.equations import SENSOR_FROM_NED, eq_09_bias, eq_11_scale
from magfusion.units import Array

_VERTICAL = (2, 1, 0)  # the axis that is vertical in each group of four


def positions(heading: float) -> Array:
    """Return sensor_from_ned (12, 3, 3) of a table rotated by a heading, north over east (rad)."""
    c, s = np.cos(heading), np.sin(heading)
    table_from_ned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return SENSOR_FROM_NED @ table_from_ned


def closed_form(measured: Array, down_field: float, sigma: float | None = None) -> MagnetometerFit:
    """Solve the paper's formulas (Eq 9, 11 and 16, and their equivalents for the other groups).

    In each group the four readings, added with the signs of the vertical axis, give one column of
    the matrix directly: ``K_a e_ba = (V_1 + V_2 - V_3 - V_4) / 4 B_D``.  The horizontal field and
    the heading cancel; only the magnitude of ``down_field`` and the level of the table matter.
    `measured` (..., 12, 3): one reading in each position, in the order of `SENSOR_FROM_NED` (T).
    `down_field`: downward component of the Earth's field (T). `sigma`: of each component of a
    reading (T); by default from the three groups' offsets, which differ by noise only. The
    offset is the mean of all readings: each group's four positions cancel the field, and three
    groups have less noise than the one that the paper uses for each axis.
    """
    group = measured.reshape(*measured.shape[:-2], 3, 4, 3)
    readings = np.swapaxes(group, -1, -2)
    columns, means = eq_11_scale(readings, down_field), eq_09_bias(readings)
    matrix = np.empty((*measured.shape[:-2], 3, 3))
    for g, axis in enumerate(_VERTICAL):
        matrix[..., :, axis] = columns[..., g, :]
    if sigma is None:
        variance = 4.0 * np.mean(np.var(means, axis=-2, ddof=1), axis=-1)
    else:
        variance = np.full(measured.shape[:-2], sigma**2)
    unit = np.diag(np.repeat([0.25 / down_field**2, 1.0 / 12.0], [9, 3]))
    return MagnetometerFit(matrix, np.mean(means, axis=-2), variance[..., None, None] * unit)


def least_squares(
    measured: Array, field_sensor: Array, sigma: float | None = None
) -> MagnetometerFit:
    """Fit matrix and offset to readings of known fields.

    `measured` (..., n, 3) (T). `field_sensor` (n, 3): true field (T), n at least 5; on a turntable
    ``positions(heading) @ field_ned``. `sigma`: of each component of a reading (T); by default from
    the residuals.
    """
    size = float(np.max(np.abs(field_sensor)))
    n = len(field_sensor)
    design = np.column_stack([field_sensor / size, np.ones(n)])
    solution = np.linalg.pinv(design) @ measured
    matrix = np.swapaxes(solution[..., :3, :], -1, -2) / size
    if sigma is None:
        residual = measured - design @ solution
        variance = np.sum(residual**2, axis=(-1, -2)) / (3 * n - 12)
    else:
        variance = np.full(measured.shape[:-2], sigma**2)
    scale = np.array([1.0 / size] * 3 + [1.0])
    by_row = np.linalg.inv(design.T @ design) * np.outer(scale, scale)
    unit = np.zeros((12, 12))
    for i in range(3):
        own = [3 * i, 3 * i + 1, 3 * i + 2, 9 + i]
        unit[np.ix_(own, own)] = by_row
    return MagnetometerFit(matrix, solution[..., 3, :], variance[..., None, None] * unit)
