"""Features of the field ellipse of a rotating beacon, constant over its period.

With the phasor Y the field is ``Re(Y exp(i w t)) = Bc cos(w t) + Bs sin(w t)``, so that
``Bc = Re Y`` and ``Bs = -Im Y``.  None of the features depends on the drive phase or the polarity,
so they remain for an unsynchronised beacon.
"""

import numpy as np

from magfusion.units import Array, ComplexArray


def plane_normal(phasor: ComplexArray) -> Array:
    """Return ``Bc x Bs``, about which the field rotates by the right-hand rule.

    Paper 004, Eq 5 and 8-11, corrected: the factor ``sin(w t) cos(w t)`` of Eq 5 belongs to the
    instantaneous fields of the two coils and averages to zero, and Eq 8-9, a later field times an
    earlier one, give the opposite sign.  Of all pairs a quarter period apart the mean of ``B(t) x
    B(t + T/4)`` is this normal, and the phasors use the samples better than the pairs. `phasor`
    (..., 3): (T), in any axes. Returns (..., 3) (T^2), in the same axes; its length is the product
    of the semi-axes, zero for a field that oscillates along a line.
    """
    return np.asarray(np.cross(phasor.imag, phasor.real))


def semi_axes(phasor: ComplexArray) -> Array:
    """Return the minor and the major semi-axis of the ellipse.

    Of two equal moments m in quadrature the minor one is ``K m / r^3`` in all directions, hence a
    range, and the major one ``sqrt(1 + 3 sin^2 phi)`` times that, phi from the rotation axis.
    `phasor` (..., 3): (T), in any axes. Returns (..., 2) (T), minor first.
    """
    power = np.sum(np.abs(phasor) ** 2, axis=-1)
    major = np.sqrt(0.5 * (power + np.abs(np.sum(phasor**2, axis=-1))))
    area = np.linalg.norm(plane_normal(phasor), axis=-1)
    # The difference of the powers cancels for the minor axis of a flat ellipse.
    minor = np.divide(area, major, out=np.zeros_like(major), where=major > 0.0)
    return np.stack([minor, major], axis=-1)


def rms_amplitude(phasor: ComplexArray) -> Array:
    """Return the RMS field over a period.

    Of two equal moments m in quadrature ``K m sqrt((2 + 3 sin^2 phi) / 2) / r^3``: not a function
    of the range alone, as in paper 004, Eq 14, but with a factor of 1.58 from pole to equator.
    `phasor` (..., 3): (T), in any axes. Returns (...) (T).
    """
    return np.asarray(np.sqrt(0.5 * np.sum(np.abs(phasor) ** 2, axis=-1)))
