"""What a steel tube about a sensor lets through of fields that alternate.

Source: H. Kaden, Wirbelstroeme und Schirmung in der Nachrichtentechnik, 2nd ed. (1959), of a long
tube whose wall is thin against its radius, in a field that is uniform about it; in English e.g. in
S. Celozzi, R. Araneo and G. Lovat, Electromagnetic Shielding (2008).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magfusion.units import MU0_OVER_4PI

LENGTH = 10.0  # m; over which fields between two wells change, about


@dataclass(frozen=True)
class Casing:
    """A long steel tube about the magnetometer, along the body's first axis.

    Parameters
    ----------
    radius : float
        Of the middle of its wall (m).
    wall : float
        Thickness (m).
    permeability : float
        Relative.
    conductivity : float
        (S/m)
    log_gain_sigma, phase_sigma : float
        Of what comes through, about what follows from these: of the logarithm of its size, and
        of its phase (rad); across and along alike.
    """

    radius: float
    wall: float
    permeability: float = 100.0
    conductivity: float = 5e6
    log_gain_sigma: float = 0.3
    phase_sigma: float = 0.3


class Transmission(NamedTuple):
    """Field inside over field outside, a complex number by the phasor's exp(+j w t)."""

    across: complex
    along: complex


def tube_transmission(casing: Casing, frequency_hz: float) -> Transmission:
    """Return what comes through a tube's wall.

    With ``g = (1 + j) / skin depth`` and ``K = g radius / permeability``: along
    ``1 / (cosh g d + K sinh(g d) / 2)``, across ``1 / (cosh g d + (K + 1 / K) sinh(g d) / 2)``,
    d the wall; of a steady field across ``1 / (1 + permeability d / (2 radius))``.
    """
    mu = 4.0 * np.pi * MU0_OVER_4PI * casing.permeability
    decay = np.sqrt(2j * np.pi * frequency_hz * mu * casing.conductivity)
    through = decay * casing.wall
    ratio = decay * casing.radius / casing.permeability
    along = np.cosh(through) + 0.5 * ratio * np.sinh(through)
    across = along + 0.5 * np.sinh(through) / ratio
    return Transmission(complex(1.0 / across), complex(1.0 / along))


def tube_gathering(casing: Casing, frequency_hz: float, length: float = LENGTH) -> complex:
    """Return by how much of its second derivative the field along a tube grows inside (m^2).

    The wall, magnetised along by a field that changes along it, has poles where it does: to first
    order ``steel (wall - 1) (log(2 length / radius) - 1) / 2 pi`` times that derivative, steel the
    cross section, wall the permeability as the field enters the wall from both sides, length that
    over which the field changes, of which only the logarithm matters.
    """
    mu = 4.0 * np.pi * MU0_OVER_4PI * casing.permeability
    half = 0.5 * np.sqrt(2j * np.pi * frequency_hz * mu * casing.conductivity) * casing.wall
    enters = np.tanh(half) / half if frequency_hz else 1.0
    sides = 0.5 * (1.0 + tube_transmission(casing, frequency_hz).along)
    steel = 2.0 * np.pi * casing.radius * casing.wall
    gathered = steel * (casing.permeability * enters * sides - 1.0)
    return complex(gathered * (np.log(2.0 * length / casing.radius) - 1.0) / (2.0 * np.pi))
