"""Windings of layers and rows of turns, and the equivalent coil: moment, radius, length.

Far away turns of radius R at the height z are dipoles of ``I pi R^2``, whose next term has
``R^2 / 8 - z^2 / 2`` along their own axis (`magfusion.model.physics.finite_size`).  The coil of

    M = I pi sum R^2,  radius^2 = sum R^4 / sum R^2,  length^2 = 12 sum R^2 z^2 / sum R^2

has the same two terms (`magfusion.model.coil_field`).  Its near field differs from that of all
turns by the fourth power of their spread over the distance.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magfusion.units import Array


@dataclass(frozen=True)
class Winding:
    """A cylindrical coil of round wire, wound in whole layers."""

    current: float  # peak, of one turn (A)
    # layers, rows: concentric layers, and adjacent turns of each
    layers: int
    rows: int
    inner_radius: float  # radius of the former below the first layer (m)
    wire: float  # diameter with insulation (m); the radial distance of successive layers
    pitch: float  # from turn to turn along the axis (m); the wire's diameter if closely wound

    @property
    def radii(self) -> Array:
        """Mean radius of each layer (m), shape (layers,)."""
        return np.asarray(self.inner_radius + self.wire * (0.5 + np.arange(float(self.layers))))

    @property
    def heights(self) -> Array:
        """Axial positions of the turns of a layer from the coil's middle (m), shape (rows,)."""
        return np.asarray(self.pitch * (np.arange(float(self.rows)) - 0.5 * (self.rows - 1)))


class WoundCoil(NamedTuple):
    """Coil equivalent to windings: moment (A m^2), radius and length (m), None for none."""

    moment: float
    radius: float
    length: float | None

    @property
    def kappa(self) -> float:
        """Shape constant (m^2), that of `magfusion.model.physics.finite_size`."""
        return self.radius**2 / 8.0 - (self.length or 0.0) ** 2 / 24.0


def wound_coil(winding: Winding) -> WoundCoil:
    """Return the coil with the dipole of all turns and the next term of their field."""
    square = winding.radii**2
    area, spread = float(np.sum(square)), float(np.mean(winding.heights**2))
    return WoundCoil(
        moment=winding.current * np.pi * winding.rows * area,
        radius=float(np.sqrt(np.sum(square**2) / area)),
        length=float(np.sqrt(12.0 * spread)) or None,
    )
