"""Effect of conducting ground on a coil's field, by the simulator's own method.

In spherical components about the axis of a dipole, with ``k = sqrt(-j w mu sigma)``, Im k < 0::

    B_r = mu0/4pi m cos(theta) 2 (1 + jkR) exp(-jkR) / R^3
    B_theta = mu0/4pi m sin(theta) (1 + jkR - (kR)^2) exp(-jkR) / R^3

A coil of finite size is a few such dipoles, spread over its disc and along its axis.
"""

import numpy as np

from magfusion.model.site import Coil
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray

# Centre and a hexagon have the second and third moments of a disc, three nodes the fifth of a line.
_RING = np.sqrt(2.0 / 3.0) * np.exp(2j * np.pi * np.arange(6) / 6.0)
_SPOKES = np.concatenate([[0.0], _RING])
_SHARES = np.concatenate([[0.25], np.full(6, 0.125)])
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


def dipole_in_ground(
    offset: Array, moment: Array, frequency_hz: float, conductivity: float
) -> ComplexArray:
    """Return the phasor of a dipole in a conducting full space.

    `offset` (n, 3): from the dipole (m). `moment` (3,) (A m^2), `conductivity` (S/m). Returns
    (n, 3) (T), for ``exp(+j w t)``.
    """
    size, distance = np.linalg.norm(moment), np.linalg.norm(offset, axis=1)[:, None]
    axis, outward = moment / size, offset / distance
    across = np.cross(np.cross(axis, outward), outward)  # sin(theta) times the polar unit vector
    permeability, rate = 4.0 * np.pi * MU0_OVER_4PI, 2.0 * np.pi * frequency_hz
    number = -np.sqrt(np.complex128(-1j * rate * permeability * conductivity))
    number = number if number.imag < 0.0 else -number
    lag = 1j * number * distance
    strength = MU0_OVER_4PI * size / distance**3 * np.exp(-lag)
    radial = 2.0 * (1.0 + lag) * (outward @ axis)[:, None] * outward
    return np.asarray(strength * (radial + (1.0 + lag - (number * distance) ** 2) * across))


def ground_effect(
    offset: Array, coil: Coil, frequency_hz: float, conductivity: float
) -> ComplexArray:
    """Return the contribution of conduction to the field of a coil at its peak current.

    `offset` (n, 3): from the coil's magnetic centre (m). Returns (n, 3) (T), in the axes of its
    arguments.
    """
    total = np.zeros(offset.shape, dtype=np.complex128)
    for place, share in _parts(coil):
        part = (offset - place, share * coil.moment_beacon, frequency_hz)
        total += dipole_in_ground(*part, conductivity) - dipole_in_ground(*part, 0.0)
    return total


def _parts(coil: Coil) -> list[tuple[Array, float]]:
    """Return the positions of a coil's dipoles, and the share of its moment of each."""
    axis = coil.moment_beacon / np.linalg.norm(coil.moment_beacon)
    lateral = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, lateral) / np.linalg.norm(np.cross(axis, lateral))
    second = np.cross(axis, first)
    along = [(0.0, 1.0)]
    if coil.length is not None:
        along = [(0.5 * coil.length * n, 0.5 * w) for n, w in zip(_NODES, _WEIGHTS, strict=True)]
    spokes = [(0.0 + 0.0j, 1.0)]
    if coil.radius is not None:
        spokes = [(coil.radius * s, w) for s, w in zip(_SPOKES, _SHARES, strict=True)]
    return [
        (far * axis + informative.real * first + informative.imag * second, float(w * v))
        for far, w in along
        for informative, v in spokes
    ]
