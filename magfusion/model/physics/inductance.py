"""Inductance of concentric turns: Maxwell's elliptic integrals for circles, Neumann's for squares.

A coil is a sum over its turns.  The mutual inductance of two filaments is exact; a turn's own is
that of two filaments at the geometric mean distance of a round wire, ``exp(-1/4)`` of its radius
(F. W. Grover, Inductance Calculations, 1946, chapters 3, 8 and 11).
"""

import numpy as np
from scipy.special import ellipe, ellipk

from magfusion.units import MU0_OVER_4PI, Array

WIRE_MEAN_DISTANCE = float(np.exp(-0.25))  # of points of a disc from each other, over its radius


def circle_mutual(first: Array, second: Array, height: Array) -> Array:
    """Return the mutual inductance of coaxial circular filaments (H).

    `first`, `second`, `height` (n,): radii, and distance of their planes (m). Filaments must not
    coincide.
    """
    square = 4.0 * first * second / ((first + second) ** 2 + height**2)
    k = np.sqrt(square)
    elliptic = (2.0 / k - k) * ellipk(square) - 2.0 / k * ellipe(square)
    return np.asarray(4.0 * np.pi * MU0_OVER_4PI * np.sqrt(first * second) * elliptic)


def square_mutual(first: Array, second: Array, height: Array) -> Array:
    """Return the mutual inductance of coaxial square filaments with parallel sides (H).

    `first`, `second`, `height` (n,): half of their sides, and distance of their planes (m).
    Filaments must not coincide.
    """
    longer, shorter = first + second, first - second
    same, opposite = np.hypot(shorter, height), np.hypot(longer, height)

    def parallel(distance: Array) -> Array:
        ends = [reach * np.arcsinh(reach / distance) for reach in (longer, shorter)]
        return ends[0] - ends[1] - np.hypot(longer, distance) + np.hypot(shorter, distance)

    return np.asarray(8.0 * MU0_OVER_4PI * (parallel(same) - parallel(opposite)))


MUTUAL = {"circle": circle_mutual, "square": square_mutual}


def coil_inductance(shape: str, sizes: Array, rows: int, pitch: float, wire: float) -> float:
    """Return the inductance of a coil of whole layers (H).

    Parameters
    ----------
    shape : {"circle", "square"}
    sizes : ndarray, shape (layers,)
        Radius, or half of the side, of each layer's turns (m).
    rows : int
        Turns of a layer.
    pitch : float
        From turn to turn along the axis (m).
    wire : float
        Diameter of the conductor (m).
    """
    step = np.arange(float(rows))
    pairs = np.where(step == 0.0, rows, 2.0 * (rows - step))
    first, second, height = np.meshgrid(sizes, sizes, pitch * step, indexing="ij")
    own = (first == second) & (height == 0.0)
    height = np.where(own, 0.5 * wire * WIRE_MEAN_DISTANCE, height)
    return float(np.sum(pairs * MUTUAL[shape](first, second, height)))
