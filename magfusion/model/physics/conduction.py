"""Contribution of conducting ground or water to the field of an oscillating dipole.

In a full space of one conductivity, with ``exp(+j w t)``, ``x = (1 + j) R / skin depth`` and n the
direction of the offset, the field of a dipole is (J. R. Wait, Geoelectromagnetism, 1982)::

    B = (mu0/4pi R^3) exp(-x) [ (3 n (n . m) - m) (1 + x) + x^2 (n (n . m) - m) ]

Computed is the difference from the field without conduction, whatever form that has.  Displacement
currents are neglected: below 1 MHz they are small in any ground.
"""

import numpy as np

from magfusion.units import MU0, MU0_OVER_4PI, Array, ComplexArray


def skin_depth(frequency_hz: Array | float, conductivity: float) -> Array:
    """Return the distance over which a wave decays by e (m); infinite without conduction.

    `conductivity` (S/m).
    """
    rate = np.pi * MU0 * conductivity * np.asarray(frequency_hz, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.sqrt(rate))


def decay(frequency_hz: Array, conductivity: float) -> ComplexArray:
    """Return ``x / R``, which is ``sqrt(j w mu0 sigma)`` (1/m), of each frequency."""
    return np.asarray((1.0 + 1.0j) / skin_depth(frequency_hz, conductivity), dtype=np.complex128)


def conducted_field(offset: Array, moment: Array, decay: ComplexArray) -> ComplexArray:
    """Return the contribution of conduction to the phasor of a dipole.

    `offset` (..., 3): from the dipole (m). Must not be zero. `moment` (..., 3): peak (A m^2); its
    phase is that of the phasor's time. `decay` (...): as of `decay` (1/m). Returns (..., 3) (T).
    """
    square, along, f, g = _terms(offset, moment, decay)
    radial = (3.0 * f + g) / square
    return np.asarray(MU0_OVER_4PI / square**1.5 * (radial * along * offset - (f + g) * moment))


def conducted_gradient(offset: Array, moment: Array, decay: ComplexArray) -> ComplexArray:
    """Return the gradient of `conducted_field`: ``[i, j] = d field_i / d offset_j``.

    Returns (..., 3, 3) (T/m); without trace, but not symmetric: a current flows.
    """
    square, along, f, g = _terms(offset, moment, decay)
    x = decay[..., None] * np.sqrt(square)
    radial = (3.0 * f + g) / square
    by_offset = radial * moment - ((1.0 + x) * g + 5.0 * (3.0 * f + g)) * along * offset / square**2
    by_moment = ((2.0 + x) * g + 3.0 * f) / square
    bracket = (
        offset[..., :, None] * by_offset[..., None, :]
        + (radial * along)[..., None] * np.eye(3)
        + moment[..., :, None] * (by_moment * offset)[..., None, :]
    )
    return np.asarray(MU0_OVER_4PI / square[..., None] ** 1.5 * bracket)


def by_log_conductivity(offset: Array, moment: Array, decay: ComplexArray) -> ComplexArray:
    """Return the derivative of the field by the logarithm of the conductivity, (..., 3) (T)."""
    square, along, _, g = _terms(offset, moment, decay)
    x = decay[..., None] * np.sqrt(square)
    bracket = (1.0 - x) * moment + (1.0 + x) * along * offset / square
    return np.asarray(-0.5 * MU0_OVER_4PI / square**1.5 * g * bracket)


def _terms(
    offset: Array, moment: Array, decay: ComplexArray
) -> tuple[Array, Array, ComplexArray, ComplexArray]:
    """Return R^2, r . m, and the conduction terms of the near and the far part, (..., 1)."""
    square = np.einsum("...i,...i", offset, offset)[..., None]
    along = np.einsum("...i,...i", offset, moment)[..., None]
    x = decay[..., None] * np.sqrt(square)
    shrunk = np.exp(-x)
    return square, along, (1.0 + x) * shrunk - 1.0, x**2 * shrunk
