"""Eddy currents in a moving metal plate: what it adds to the field of a coil.

A square sheet as a mesh of current loops with resistance and mutual inductance, (R + jwL) i = -jw
times the flux of the coil; their field is added to the coil's.  Nothing of it is known to the
estimators.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from magfusion.units import Array, ComplexArray

MU_0 = 4e-7 * np.pi
STRIP = 0.2235  # of its width: the mean distance of its parts (geometric)


@dataclass(frozen=True)
class Plate:
    """A square plate whose normal is y of the source.

    Parameters
    ----------
    side, thickness : float
        (m)
    conductivity : float
        (S/m)
    cells : int
        Along a side.
    """

    side: float = 0.2
    thickness: float = 2e-3
    conductivity: float = 3.5e7
    cells: int = 8

    @property
    def cell(self) -> float:
        """Side of a loop (m)."""
        return self.side / self.cells

    @cached_property
    def centres(self) -> Array:
        """Centres of the loops about that of the plate (n, 3) (m)."""
        along = (np.arange(self.cells) + 0.5) * self.cell - 0.5 * self.side
        x, z = np.meshgrid(along, along, indexing="ij")
        return np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)

    def loop_field(self, place: Array) -> Array:
        """Return the field (T) of 1 A in a loop, about +y, at places (n, 3) from its centre (m)."""
        half = 0.5 * self.cell
        corners = half * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
        field = np.zeros_like(place)
        for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            a, b = place - begin, place - end
            size_a, size_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
            scale = (size_a + size_b) / (size_a * size_b)
            scale /= size_a * size_b + np.einsum("ni,ni->n", a, b)
            field += scale[:, None] * np.cross(a, b)
        return MU_0 / (4.0 * np.pi) * field

    def response(self, frequency_hz: float) -> ComplexArray:
        """Return what makes of the flux through each loop (Wb) the loops' currents (A)."""
        turning = 2.0 * np.pi * frequency_hz
        skin = np.sqrt(2.0 / (turning * MU_0 * self.conductivity))
        resistance = 1.0 / (self.conductivity * min(self.thickness, skin))
        number = self.cells**2
        separate = self.centres[:, None] - self.centres
        # A current that flows in a strip a cell wide has the flux of a wire so far from it.
        fine = np.array([-1.0, 1.0]) * (0.5 - STRIP)
        x, z = np.meshgrid(fine * self.cell, fine * self.cell, indexing="ij")
        mutual = np.zeros((number, number))
        for dx, dz in zip(x.ravel(), z.ravel(), strict=True):
            seen = self.loop_field((separate + np.array([dx, 0.0, dz])).reshape(-1, 3))[:, 1]
            mutual += seen.reshape(number, number) * self.cell**2 / x.size
        others = np.abs(np.linalg.norm(separate, axis=2) / self.cell - 1.0) < 1e-6
        # Of a strip along the edge of the plate there is only the inner half.
        shared = np.diag(8.0 - np.sum(others, axis=1)) - others
        impedance = resistance * shared + 1j * turning * mutual
        return np.asarray(-1j * turning * np.linalg.inv(impedance))

    def added(
        self, coil: Callable[[Array], Array], centre: Array, place: Array, frequency_hz: float
    ) -> ComplexArray:
        """Return what the plate adds to the phasor of a coil (n, 3) (T).

        Parameters
        ----------
        coil : callable
            Field of the coil at places (m, 3).
        centre, place : ndarray, shape (n, 3)
            Of the plate, and where it is measured (m).
        """
        response = self.response(frequency_hz)
        at = (centre[:, None] + self.centres).reshape(-1, 3)
        flux = coil(at)[:, 1].reshape(len(centre), -1) * self.cell**2
        current = flux @ response.T
        result = np.zeros((len(centre), 3), dtype=np.complex128)
        for k, own in enumerate(self.centres):
            result += current[:, k, None] * self.loop_field(place - centre - own)
        return result
