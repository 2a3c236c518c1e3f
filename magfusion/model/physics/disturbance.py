"""Disturbance of an alternating field by iron and metal: the moment induced in a sphere.

Paper 004 models a disturbing body as a ring of N turns, area S and resistance R (Eq 24):
``M = N S / R dB/dt S``, for ``B sin(w t)`` equal to ``N w B S^2 cos(w t) / R``.  Three points are
incorrect:

- the sign: the induced current opposes the change of the field (Lenz), so that the moment is
  ``-N^2 S^2 / R dB/dt`` -- with the square of N, since each turn adds to the voltage as well;
- the ring has no inductance: its moment grows without bound with frequency, where that of a real
  body saturates and changes from quadrature to opposition;
- a permeable body is magnetised in phase with the field at any frequency.  For steel furniture at
  tens of hertz this is the larger part, and a lower frequency does not remove it.

The sphere has all three and a closed solution.  Its weak-field, low-frequency limit without
permeability is the sum of such rings, ``-(2 pi / 15) conductivity a^5 dB/dt``.
"""

import numpy as np

from magfusion.model.physics.dipole import dipole_field
from magfusion.units import MU0, AnyArray, Array, ComplexArray

_SMALL = 0.03  # below it the closed form cancels, and the series is exact to 1e-12


def sphere_polarizability(
    radius: Array | float,
    permeability: Array | float,
    conductivity: Array | float,
    angular_frequency: Array | float,
) -> ComplexArray:
    """Return the complex moment that unit flux density induces in a sphere.

    With ``x = a sqrt(-i w mu sigma)`` and ``q = x j0(x) / j1(x) - 1`` (spherical Bessel functions)
    it is ``(4 pi a^3 / mu0) (2 mu_r - q) / (2 (mu_r + q))``: ``(4 pi a^3 / mu0) (mu_r - 1) / (mu_r
    + 2)`` in a static field, where q is 2, and ``-2 pi a^3 / mu0`` for a thin skin. `radius` (m).
    `permeability`: relative, 1 for no iron. `conductivity` (S/m), `angular_frequency` (rad/s).
    Returns (A m^2/T), of the arguments' common shape, for phasors of ``exp(+i w t)``; its imaginary
    part is never positive, as the sphere takes power from the field.
    """
    a, mu = np.asarray(radius, dtype=np.float64), np.asarray(permeability, dtype=np.float64)
    square = -1j * np.asarray(angular_frequency) * MU0 * mu * np.asarray(conductivity) * a**2
    q = _bessel_ratio(np.asarray(square, dtype=np.complex128)) - 1.0
    return 4.0 * np.pi * a**3 / MU0 * (2.0 * mu - q) / (2.0 * (mu + q))


def _bessel_ratio(square: ComplexArray) -> ComplexArray:
    """Return ``x j0(x) / j1(x) = x^2 / (1 - x cot x)``, given the square of x."""
    small = np.abs(square) < _SMALL**2
    safe = np.where(small, -1j, square)
    x = np.sqrt(safe)  # with negative imaginary part: the following never overflows
    turn = np.exp(-2j * x)
    cotangent = 1j * (1.0 + turn) / (1.0 - turn)
    series = 3.0 - square / 5.0 - square**2 / 175.0
    return np.where(small, series, safe / (1.0 - x * cotangent))


def induced_field(
    point: Array, centre: Array, polarizability: ComplexArray, primary: ComplexArray
) -> ComplexArray:
    """Return the field of induced dipoles, in the axes of the arguments.

    Each body is a dipole in the primary field at its centre: exact for a sphere in a uniform field.
    The gradient of the primary over the body, and mutual induction of bodies, are neglected.
    `point` (n, 3): outside every body (m). `centre` (bodies, 3) (m),
    `polarizability` (bodies, tones) (A m^2/T). `primary` (bodies, tones, 3): field at the centres
    (T). Returns (n, tones, 3) (T).
    """
    field = np.zeros((len(point), *primary.shape[1:]), dtype=np.complex128)
    for place, moment in zip(centre, polarizability[..., None] * primary, strict=True):
        offset: AnyArray = (point - place)[:, None, :]
        field += dipole_field(offset, moment.real) + 1j * dipole_field(offset, moment.imag)
    return field
