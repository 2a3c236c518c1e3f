"""Transmission of alternating fields through a steel tube around a sensor, and flux it collects.

The transmission is after H. Kaden, Wirbelstroeme und Schirmung in der Nachrichtentechnik, 2nd ed.
(1959), of a long tube whose wall is thin against its radius, in a field that is uniform about it;
in English e.g. in S. Celozzi, R. Araneo and G. Lovat, Electromagnetic Shielding (2008).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.special import k0

from magfusion.units import MU0_OVER_4PI, Array, ComplexArray

STEEL = ("wall", "permeability", "conductivity")
MAX_LOG_ERROR = 2.0  # largest error of a logarithm; beyond, a search diverges
WAVES = 128  # wave numbers in the sum of the response along a tube


@dataclass(frozen=True)
class Casing:
    """A long steel tube around the magnetometer, along the body's first axis."""

    radius: float  # mean radius of its wall (m)
    wall: float  # thickness (m)
    permeability: float = 100.0  # relative
    conductivity: float = 5e6  # (S/m)
    # log_gain_sigma, phase_sigma: of the transmission about the value that follows from these: of
    # the logarithm of its magnitude, and of its phase (rad); equal across and along
    log_gain_sigma: float = 0.3
    phase_sigma: float = 0.3
    wall_sigma: float = 0.0
    permeability_sigma: float = 0.0
    conductivity_sigma: float = 0.0

    @property
    def steel_sigma(self) -> Array:
        """Standard deviations of the logarithms of `STEEL`, shape (3,)."""
        return np.array([self.wall_sigma, self.permeability_sigma, self.conductivity_sigma])


class Response(NamedTuple):
    """Response of tubes, each with its own change of the steel.

    ``strength`` is the cross section of the wall times its permeability for a field entering from
    both sides, less one, over 2 pi (m^2).  ``by_steel`` has the derivatives of the logarithms of
    across, along and strength by those of `STEEL`.
    """

    across: ComplexArray  # (k,)
    along: ComplexArray  # (k,)
    strength: ComplexArray  # (k,)
    by_steel: ComplexArray  # (3, k, 3)


def tube_response(casing: Casing, frequency_hz: float, change: Array) -> Response:
    """Return the transmission and flux collection of a tube.

    With ``g = (1 + j) / skin depth`` and ``K = g radius / permeability``: along ``1 / (cosh g d + K
    sinh(g d) / 2)``, across ``1 / (cosh g d + (K + 1 / K) sinh(g d) / 2)``, d the wall; of a steady
    field across ``1 / (1 + permeability d / (2 radius))``. `change` (k, 3): of the logarithms of
    `STEEL`.
    """
    wall, permeability, conductivity = (
        np.exp(np.clip(change, -MAX_LOG_ERROR, MAX_LOG_ERROR))
        * [casing.wall, casing.permeability, casing.conductivity]
    ).T
    mu = 4.0 * np.pi * MU0_OVER_4PI * permeability
    decay = np.sqrt(2j * np.pi * frequency_hz * mu * conductivity)
    through, ratio = decay * wall, decay * casing.radius / permeability
    by_through, by_ratio = np.array([1.0, 0.5, 0.5]), np.array([0.0, -0.5, 0.5])
    cosh, sinh = np.cosh(through), np.sinh(through)
    along = cosh + 0.5 * ratio * sinh
    across = along + 0.5 * sinh / ratio
    along_by = ((sinh + 0.5 * ratio * cosh) * through)[:, None] * by_through
    along_by = along_by + (0.5 * ratio * sinh)[:, None] * by_ratio
    across_by = along_by + (0.5 * cosh * through / ratio)[:, None] * by_through
    across_by = across_by - (0.5 * sinh / ratio)[:, None] * by_ratio
    enters = np.tanh(0.5 * through) / (0.5 * through)
    slope = 1.0 / np.cosh(0.5 * through) ** 2 - enters
    sides, sides_by = 0.5 * (1.0 + 1.0 / along), -0.5 * along_by / along[:, None] ** 2
    drawn = permeability * enters * sides
    drawn_by = (permeability * slope * sides)[:, None] * by_through
    drawn_by = drawn_by + drawn[:, None] * np.array([0.0, 1.0, 0.0])
    drawn_by = drawn_by + (permeability * enters)[:, None] * sides_by
    by_steel = np.stack(
        [
            -across_by / across[:, None],
            -along_by / along[:, None],
            np.array([1.0, 0.0, 0.0]) + drawn_by / (drawn - 1.0)[:, None],
        ]
    )
    return Response(1.0 / across, 1.0 / along, casing.radius * wall * (drawn - 1.0), by_steel)


def gathering_weights(
    strength: ComplexArray, radius: float, place: Array
) -> tuple[ComplexArray, ComplexArray]:
    """Return the field a long tube adds along its axis, as weights of the field outside it.

    An axially magnetised wall has poles where its magnetisation changes, and their field magnetises
    it again.  To a wave of number q along the tube the response of a ring of poles is ``-N / (1 +
    N)``, with ``N = strength q^2 K0(q radius)``, to all orders, as the tube is translation
    invariant.  Positions must be closer than the field changes: a dipole's at a distance d has no
    waves shorter than about d. `strength` (k,): of `Response` (m^2). `place` (m,): positions at
    equal steps along the tube, relative to the sensor (m). Returns `weights`,
    `by_log_strength` (k, m).
    """
    separate = float(place[1] - place[0])
    node, share = leggauss(WAVES)
    number = 0.5 * np.pi / separate * (1.0 + node)
    wave = 0.5 * share * np.cos(np.outer(place, number))  # (m, waves)
    poles = strength[:, None] * number**2 * k0(number * radius)
    return (-poles / (1.0 + poles)) @ wave.T, (-poles / (1.0 + poles) ** 2) @ wave.T
