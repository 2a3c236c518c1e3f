"""A source of three wound coils: the field of every turn by elliptic integrals."""

import numpy as np
from scipy.special import ellipe, ellipk

from magfusion.units import Array

LAYERS, ROWS, WIRE, CURRENT = 8, 20, 5e-4, 1.0  # m, A
FORMERS = (0.020, 0.026, 0.032)  # m; of the coils, one about the other


def loop_field(radius: float, place: Array) -> Array:
    """Return the field (T) of 1 A in a loop about z, at places (n, 3) (m)."""
    x, y, z = place.T
    rho = np.maximum(np.hypot(x, y), 1e-9)
    far, near = (radius + rho) ** 2 + z**2, (radius - rho) ** 2 + z**2
    m = 1.0 - near / far
    k, e = ellipk(m), ellipe(m)
    scale = 2e-7 / np.sqrt(far)
    along = scale * (k + (radius**2 - rho**2 - z**2) / near * e)
    across = scale * z / rho * (-k + (radius**2 + rho**2 + z**2) / near * e)
    return np.stack([across * x / rho, across * y / rho, along], axis=1)


def winding_field(former: float, axis: int, place: Array) -> Array:
    """Return the field (T) of all turns of a coil along an axis of the source."""
    own = np.roll(place, 2 - axis, axis=1)
    field = np.zeros_like(own)
    for layer in range(LAYERS):
        for row in range(ROWS):
            height = (row - 0.5 * (ROWS - 1)) * WIRE
            turn = own - [0.0, 0.0, height]
            field += CURRENT * loop_field(former + (layer + 0.5) * WIRE, turn)
    return np.roll(field, axis - 2, axis=1)
