"""Paper 001, equation by equation: a magnetometer on a turntable, and attitude from its readings.

Readings V and bias b are (..., 3) and the scale K (..., 3) of each axis, as in
`magfusion.calibration.magnetometer.from_paper`: the misalignment E (..., 3, 3) is zero on its
diagonal, and the paper's ``e_yx``, of the field along y into sensor x, is in row x, column y.
Four readings of one axis, in the positions of one group of the table, are (..., 4).
"""

from functools import partial

import numpy as np

from magfusion.calibration.magnetometer import from_paper
from magfusion.units import Array, IntArray

NOT_FUNCTIONS: dict[int, str] = {}

_N, _E, _D = np.eye(3)
# World direction of the sensor's x, y and z axis.  1 to 4 follow from Eq 4-15 of the paper; its
# table 1 is lost, so that 5 to 12 are their cyclic permutations.
_POINTING = (
    ((_N, _E, _D), (-_N, -_E, _D), (_N, -_E, -_D), (-_N, _E, -_D)),
    ((_E, _D, _N), (-_E, _D, -_N), (-_E, -_D, _N), (_E, -_D, -_N)),
    ((_D, _N, _E), (_D, -_N, -_E), (-_D, _N, -_E), (-_D, -_N, _E)),
)
SENSOR_FROM_NED = np.array([axes for group in _POINTING for axes in group])  # (12, 3, 3)
SIGN = np.array([1.0, 1.0, -1.0, -1.0])  # of the downward field along a group's vertical axis


# 1.1 The sensor ---------------------------------------------------------------------------------


def _voltage(axis: int, field: Array, bias: Array, scale: Array, misalignment: Array) -> Array:
    matrix, offset = from_paper(bias, scale, misalignment)
    return (matrix[..., axis, :] * field).sum(axis=-1) + offset[..., axis]


eq_01_voltage_x = partial(_voltage, 0)
"""Right: ``Vx = bx + Kx (Bx + eyx By + ezx Bz)``, of the field (..., 3) in sensor axes (T)."""

eq_02_voltage_y = partial(_voltage, 1)
"""Corrected: ``Vy = by + Ky (By + exy Bx + ezy Bz)``."""


def eq_02_voltage_y_as_printed(
    field: Array, bias: Array, scale: Array, misalignment: Array
) -> Array:
    """Return Vy.  Misprint: ``ezy By`` for ``ezy Bz``, which would cancel in Eq 16."""
    return eq_02_voltage_y(field[..., [0, 1, 1]], bias, scale, misalignment)


eq_03_voltage_z = partial(_voltage, 2)
"""Right: ``Vz = bz + Kz (Bz + exz Bx + eyz By)``."""


def _at(
    position: int, axis: int, field_ned: Array, bias: Array, scale: Array, misalignment: Array
) -> Array:
    field = SENSOR_FROM_NED[position] @ field_ned
    return _voltage(axis, field, bias, scale, misalignment)


eq_04_z_at_1 = partial(_at, 0, 2)
"""Right: ``bz + Kz (exz BN + eyz BE + BD)``, of the field (3,) north, east and down (T)."""

eq_05_z_at_2 = partial(_at, 1, 2)
"""Right: ``bz + Kz (-exz BN - eyz BE + BD)``."""

eq_06_z_at_3 = partial(_at, 2, 2)
"""Right: ``bz + Kz (exz BN - eyz BE - BD)``."""

eq_07_z_at_4 = partial(_at, 3, 2)
"""Right: ``bz + Kz (-exz BN + eyz BE - BD)``."""


def eq_08_sum(readings: Array) -> Array:
    """Return the sum of four readings, ``4 b``.  Right, whatever the heading of the table."""
    return np.sum(readings, axis=-1)


def eq_09_bias(readings: Array) -> Array:
    """Return the bias of an axis from its four readings.  Right."""
    return eq_08_sum(readings) / 4.0


def eq_10_signed_sum(readings: Array) -> Array:
    """Return ``V1 + V2 - V3 - V4``: ``4 BD Kz`` of the z axis in positions 1 to 4.  Right."""
    return readings @ SIGN


def eq_11_scale(readings: Array, down_field: float) -> Array:
    """Return ``Kz`` of readings of the z axis (down_field in T).  Right; K_Z and K_z are one."""
    return eq_10_signed_sum(readings) / (4.0 * down_field)


eq_12_y_at_1 = partial(_at, 0, 1)
"""Misprint: M_D for B_D.  Right else: ``by + Ky (BE + exy BN + ezy BD)``, so that Eq 2 has Bz."""

eq_13_y_at_2 = partial(_at, 1, 1)
"""Misprint: M_N, M_D for B_N, B_D.  Right else: ``by + Ky (-BE - exy BN + ezy BD)``."""

eq_14_y_at_3 = partial(_at, 2, 1)
"""Right: ``by + Ky (-BE + exy BN - ezy BD)``."""

eq_15_y_at_4 = partial(_at, 3, 1)
"""Right: ``by + Ky (BE - exy BN - ezy BD)``."""


def eq_16_misalignment(readings: Array, down_field: float, scale: Array) -> Array:
    """Return ``ezy`` from the y axis in positions 1 to 4 and its scale Ky.  Right."""
    return eq_11_scale(readings, down_field) / scale


# 2 Attitude: entries (n, 3) are the fields of attitudes that are known ---------------------------


def eq_17_nearest(field_body: Array, entries_body: Array) -> IntArray:
    """Return the nearest entry in y and z, for rotation about x alone.

    Unclear: the picture is lost; read as the minimum of Eq 19.
    """
    return np.argmin(eq_19_distance(field_body[..., None, :], entries_body), axis=-1)


def eq_18_nearest(field_body: Array, entries_body: Array) -> IntArray:
    """Return the nearest entry, for rotation about all axes.

    Unclear: the picture is lost; read as the minimum of Eq 20.  False: that one vector determines
    three angles; it is invariant to rotation about the field.
    """
    return np.argmin(eq_20_distance(field_body[..., None, :], entries_body), axis=-1)


def eq_19_distance(field_body: Array, entry_body: Array) -> Array:
    """Return the distance of fields in y and z (T).  Unclear: the picture is lost."""
    return np.hypot(*np.moveaxis((field_body - entry_body)[..., 1:], -1, 0))


def eq_20_distance(field_body: Array, entry_body: Array) -> Array:
    """Return the distance of fields (T).  Unclear: the picture is lost."""
    return np.linalg.norm(field_body - entry_body, axis=-1)
