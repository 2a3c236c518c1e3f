"""Field of a thin circular loop and its gradient, in closed form, near and far.

The textbook formula by complete elliptic integrals (Smythe, *Static and Dynamic Electricity*,
section 7.10) loses all its digits near the axis and far away, where the loop is nearly a dipole.
Here each term of the dipole's formula has a factor that is one for the dipole: with
z along the axis, s the square of the distance from it, ``c = r^2 + a^2`` and ``x = 4 a^2 s / c^2``,

    B = (mu0/4pi) m (P n + Q rho),  P = 2 f0 / c^1.5 - 3 s f1 / c^2.5,  Q = 3 z f1 / c^2.5,

    f0 = F(3/4, 5/4; 1; x),  f1 = F(5/4, 7/4; 2; x),  and  g = F(5/4, 7/4; 1; x)  in the gradient,

hypergeometric functions of positive terms, since ``(1 - t cos)^(-nu)`` has the mean
``F(nu/2, (nu+1)/2; 1; t^2)``.  On the axis and far away x tends to zero.  A quadratic
transformation (DLMF 15.8.18) and contiguous relations (DLMF 15.5(ii)) express them by the complete
integrals B and D (Bulirsch's, DLMF 19.2.11) in sums of positive terms; these are computed by the
arithmetic-geometric mean (DLMF 19.8(i)).  A loop without radius is the dipole.
"""

from typing import NamedTuple

import numpy as np

from magfusion.units import MU0_OVER_4PI, TINY, Array

_MAX_MEANS = 10  # iterations, each of which doubles the digits; needed at the wire
_WIRE = 1e-6  # of the radius, about; half the wire's thickness, so that the field stays finite


class _Loop(NamedTuple):
    """Quantities shared by field and gradient, shape (..., 1) and (..., 3)."""

    axis: Array
    strength: Array  # mu0/4pi times the size of the moment
    along: Array  # z
    across: Array  # rho
    square: Array  # s
    reach: Array  # c
    first: Array  # f1 / c^2.5
    axial: Array  # P
    radial: Array  # Q
    third: Array  # g / c^2.5


def loop_field(offset: Array, moment: Array, radius: Array | float) -> Array:
    """Return the flux density of thin circular loops, in the axes of the arguments.

    `offset` (..., 3): from the loop's centre (m). Must not be zero where the radius is. The wire
    has a thickness of a millionth of the radius, so that the field is finite. `moment` (..., 3):
    along the loop's axis (A m^2). Must not be zero. `radius` (...) (m); zero for a dipole. Returns
    (..., 3) (T).
    """
    return _field(_loop(offset, moment, np.asarray(radius, dtype=np.float64)))


def loop_field_and_gradient(
    offset: Array, moment: Array, radius: Array | float
) -> tuple[Array, Array]:
    """Return the field of thin circular loops and its gradient, in one evaluation.

    `offset`, `moment`, `radius`: as in `loop_field`. Returns `field` (..., 3) (T);
    `gradient` (..., 3, 3): ``[i, j] = d field_i / d offset_j`` (T/m); symmetric and trace-free, as
    the field has neither curl nor divergence.
    """
    seen = _loop(offset, moment, np.asarray(radius, dtype=np.float64))
    z, s, fall = seen.along, seen.square, (seen.first + 4.0 * seen.third) / seen.reach
    by_axial = z * (3.0 * s * fall - 6.0 * seen.third)
    shear = 3.0 * (seen.first - z * z * fall)
    axis, across = seen.axis, seen.across
    mixed = axis[..., :, None] * across[..., None, :]
    # Where rounding loses the distance from the axis, the numerators vanish with it.
    outward = (by_axial + 2.0 * seen.radial) / np.maximum(s, TINY)
    gradient = (by_axial - seen.radial)[..., None] * axis[..., :, None] * axis[..., None, :]
    gradient += shear[..., None] * (mixed + np.swapaxes(mixed, -1, -2))
    gradient -= outward[..., None] * across[..., :, None] * across[..., None, :]
    gradient += seen.radial[..., None] * np.eye(3)
    return _field(seen), seen.strength[..., None] * gradient


def _field(seen: _Loop) -> Array:
    return np.asarray(seen.strength * (seen.axial * seen.axis + seen.radial * seen.across))


def _loop(offset: Array, moment: Array, radius: Array) -> _Loop:
    size = np.linalg.norm(moment, axis=-1, keepdims=True)
    axis, a = moment / size, radius[..., None]
    z = np.einsum("...i,...i", offset, axis)[..., None]
    across = offset - z * axis
    s = np.einsum("...i,...i", across, across)[..., None]
    rho = np.sqrt(s)
    c = s + z * z + a * a
    x = (2.0 * a * rho / c) ** 2
    # sqrt(1 - x) from the nearest and the farthest point of the wire, bounded within the wire.
    y = np.maximum(np.sqrt(((rho - a) ** 2 + z * z) * ((rho + a) ** 2 + z * z)) / c, _WIRE)
    w, q = x / (1.0 + y) ** 2, 0.5 * (1.0 + y)
    first, second = _integrals(w, np.sqrt(y / q))
    remaining = second * y / q  # D (1 - w)
    root, both = np.sqrt(q), y * y
    f0 = 2.0 / np.pi * root / both * ((1.0 + w) * first + remaining)
    f1 = 8.0 / (3.0 * np.pi) / (root * both) * (first + 0.5 * remaining)
    g = (3.0 + w * (10.0 + 3.0 * w)) * first + (3.0 + 5.0 * w) * remaining
    g *= 2.0 / (3.0 * np.pi) * q * root / both**2
    power = 1.0 / (c * c * np.sqrt(c))
    radial = 3.0 * f1 * power
    return _Loop(
        axis=axis,
        strength=MU0_OVER_4PI * size,
        along=z,
        across=across,
        square=s,
        reach=c,
        first=f1 * power,
        axial=2.0 * c * f0 * power - s * radial,
        radial=z * radial,
        third=g * power,
    )


def _integrals(parameter: Array, complement: Array) -> tuple[Array, Array]:
    """Return the complete elliptic integrals B and D of a parameter.

    The integrals of ``cos^2`` and of ``sin^2`` over ``sqrt(1 - parameter sin^2)``. `parameter`: the
    square of the modulus, from 0 to 1. `complement`: ``sqrt(1 - parameter)``, more accurate from
    the caller.
    """
    mean, other = 0.5 * (1.0 + complement), np.sqrt(complement)
    separate = 0.5 * parameter / (1.0 + complement)  # half the difference of the previous means
    added = 0.5 * separate / (1.0 + complement)  # its square over the parameter
    total, weight = added, 1.0
    for _ in range(_MAX_MEANS):
        if np.all(separate <= 1e-9 * mean):  # the next is its square
            break
        mean, other = 0.5 * (mean + other), np.sqrt(mean * other)
        share = 0.25 * separate / mean
        separate, added, weight = share * separate, share**2 * added, 2.0 * weight
        total = total + weight * added
    whole = 0.5 * np.pi / mean
    return whole * (0.5 - total), whole * (0.5 + total)
