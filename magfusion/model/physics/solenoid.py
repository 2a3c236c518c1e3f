"""Field of coils of finite size by the Biot-Savart law, for the simulator.

Independent of the closed form of the estimators (`magfusion.model.physics.loop`).
"""

import numpy as np

from magfusion.model.physics.dipole import dipole_field
from magfusion.units import MU0_OVER_4PI, Array

_MIN_AZIMUTHS, _MAX_AZIMUTHS = 32, 4096
_SLICES = 16
_DIGITS = 26.0  # e-folds, eleven digits


def solenoid_field(
    offset: Array, moment: Array, radius: float | None = None, length: float | None = None
) -> Array:
    """Return the flux density of a coil, in the axes of its arguments.

    A coil with a radius is a thin loop, one with a length as well a uniform current sheet, one with
    a length alone a line of dipoles, one with neither a dipole.  Sheets are integrated at 16
    Gauss-Legendre slices: the relative error is below 1e-10 farther off the axis than half a
    length. `offset` (n, 3): from the coil's centre (m). `moment` (3,): of the whole coil, along its
    axis (A m^2). `radius`, `length` (m). Returns (n, 3) (T).
    """
    size = float(np.linalg.norm(moment))
    if size == 0.0:
        return np.zeros_like(offset)
    axis = moment / size
    nodes, weights = _slices(length)
    field = np.zeros_like(offset)
    for node, weight in zip(nodes, weights, strict=True):
        from_slice = offset - node * axis
        if radius:
            field += loop_field(from_slice, weight * moment, radius)
        else:
            field += dipole_field(from_slice, weight * moment)
    return field


def loop_field(offset: Array, moment: Array, radius: float) -> Array:
    """Return the flux density of a thin circular current loop, in the axes of its arguments.

    The sum over wire elements converges as a geometric series on a circle.  Their number gives
    eleven digits at the nearest point, unless it is closer to the wire than a hundredth of the
    radius. `offset` (n, 3): from the loop's centre (m). `moment` (3,): along the loop's axis (A
    m^2). Must not be zero. `radius` (m). Returns (n, 3) (T).
    """
    size = float(np.linalg.norm(moment))
    current = size / (np.pi * radius**2)
    axis = moment / size
    across = np.linalg.svd(axis[None])[2][1]
    along = np.cross(axis, across)
    field = np.zeros_like(offset)
    count = _azimuths(offset, axis, radius)
    angle = (2.0 * np.pi / count * np.arange(count))[:, None]
    outward = np.cos(angle) * across + np.sin(angle) * along
    element = np.cross(axis, outward)
    rotated = np.cross(element[:, None], np.eye(3))  # element x e_i in row i
    for from_centre, by_element in zip(radius * outward, rotated, strict=True):
        separation = offset - from_centre
        square = np.einsum("ni,ni->n", separation, separation)
        field += (separation @ by_element) / (square * np.sqrt(square))[:, None]
    return MU0_OVER_4PI * current * radius * (2.0 * np.pi / count) * field


def _azimuths(offset: Array, axis: Array, radius: float) -> int:
    """Return the number of wire elements that the nearest of the points needs."""
    square = np.einsum("ni,ni->n", offset, offset)
    rho = np.sqrt(np.maximum(square - (offset @ axis) ** 2, 0.0))
    rate = np.arccosh(np.maximum((square + radius**2) / (2.0 * radius * rho + 1e-300), 1.0))
    nearest = float(np.min(rate, initial=np.inf))
    return int(np.clip(np.ceil(_DIGITS / max(nearest, 1e-3)), _MIN_AZIMUTHS, _MAX_AZIMUTHS))


def _slices(length: float | None) -> tuple[Array, Array]:
    """Return positions along the axis (m) and weights that sum to one."""
    if not length:
        return np.zeros(1), np.ones(1)
    nodes, weights = np.polynomial.legendre.leggauss(_SLICES)
    return 0.5 * length * nodes, 0.5 * weights
