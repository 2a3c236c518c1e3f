"""Coupling of two coils of finite size: dipoles, and the first-order term of their size.

The flux through a small flat coil is the mean over its disc of a harmonic field,
``1 - kappa d^2/dn^2`` of the field at its centre, n the coil's axis; by reciprocity the same holds
for a transmitting coil.  With this term the dipole model has 0.03 degrees error at five coil sizes.
"""

from dataclasses import dataclass
from math import factorial
from typing import NamedTuple

import numpy as np
from scipy.special import binom

from magfusion.units import MU0_OVER_4PI, Array


class _Term(NamedTuple):
    """``factor a^pa b^pb c^pc q^pq``."""

    factor: float
    a: int
    b: int
    c: int
    q: float


def _terms(of_a: int, of_b: int) -> tuple[_Term, ...]:
    """Return derivatives of 1/r of given orders along two unit vectors.

    Taylor coefficients of ``(q + w)^(-1/2)``, ``w = 2 x a + 2 y b + x^2 + 2 x y c + y^2``, with a
    and b the offset along the two vectors, c their product and q the square of the distance.
    """
    out = []
    for both in range(min(of_a, of_b) + 1):
        for square_a in range((of_a - both) // 2 + 1):
            for square_b in range((of_b - both) // 2 + 1):
                a, b = of_a - both - 2 * square_a, of_b - both - 2 * square_b
                n = a + b + both + square_a + square_b
                ways = factorial(n)
                for power in (a, b, both, square_a, square_b):
                    ways //= factorial(power)
                factor = binom(-0.5, n) * ways * 2.0 ** (a + b + both)
                whole = factor * factorial(of_a) * factorial(of_b)
                out.append(_Term(float(whole), a, b, both, -(n + 0.5)))
    return tuple(out)


_DIPOLE, _RECEIVER, _TRANSMITTER, _BOTH = _terms(1, 1), _terms(3, 1), _terms(1, 3), _terms(3, 3)


def disc_kappa(radius: float) -> float:
    """Return the constant of a circular coil, ``radius^2 / 8`` (m^2)."""
    return radius**2 / 8.0


def square_kappa(side: float) -> float:
    """Return the constant of a square coil, ``side^2 / 24`` (m^2)."""
    return side**2 / 24.0


def coil_kappa(radius: float | None, length: float | None) -> float:
    """Return the constant of a coil's shape, ``radius^2 / 8 - length^2 / 24`` (m^2).

    Its moments are spread over a disc and along a line; at a length of ``sqrt(3)`` radii the two
    cancel.
    """
    return disc_kappa(radius or 0.0) - (length or 0.0) ** 2 / 24.0


def coil_shape(kappa: float, length: float | None = None) -> tuple[float | None, float | None]:
    """Return radius and length (m) of a coil with a constant; None for none.

    `length`: known length; changed only if no radius fits it.
    """
    square = 8.0 * kappa + (length or 0.0) ** 2 / 3.0
    if square >= 0.0:
        return (float(np.sqrt(square)) or None), length
    return None, float(np.sqrt(-24.0 * kappa))


@dataclass(frozen=True, eq=False)
class CoilCoupling:
    """Flux density that a coil receives from another, with its derivatives."""

    value: Array  # (...) (T), for a moment in A m^2 and a sensitivity without unit
    by_offset: Array  # (..., 3)
    by_moment: Array  # (..., 3)
    by_sensitivity: Array  # (..., 3)
    by_kappa_moment: Array  # (...) (T/m^2)
    by_kappa_sensitivity: Array  # (...) (T/m^2)


def coil_coupling(
    offset: Array,
    moment: Array,
    sensitivity: Array,
    kappa_moment: Array | None = None,
    kappa_sensitivity: Array | None = None,
) -> CoilCoupling:
    """Return the coupling from a transmitting to a receiving coil, all in the same axes.

    ``s . (1 - kappa_s (n_s . grad)^2) (1 - kappa_m (n_m . grad)^2) G(offset) m``, with G the field
    of a unit dipole. `offset` (..., 3): from the centre of the transmitting coil to that of the
    receiving one (m). `moment`, `sensitivity` (..., 3): along the coils' axes (A m^2; without
    unit). Must not be zero. `kappa_moment`, `kappa_sensitivity` (...): `disc_kappa` or
    `square_kappa` of the coils (m^2); with neither both are points, and the derivatives by them are
    zero.
    """
    size_s, size_m = (np.linalg.norm(v, axis=-1) for v in (sensitivity, moment))
    along_s, along_m = sensitivity / size_s[..., None], moment / size_m[..., None]
    invariants = tuple(
        np.einsum("...i,...i", first, second)
        for first, second in (
            (offset, along_s),
            (offset, along_m),
            (along_s, along_m),
            (offset, offset),
        )
    )
    total = _derivatives(_DIPOLE, invariants)
    by_kappa_m, by_kappa_s = np.zeros_like(total[0]), np.zeros_like(total[0])
    if kappa_moment is not None or kappa_sensitivity is not None:
        kappa_m = np.asarray(0.0 if kappa_moment is None else kappa_moment)
        kappa_s = np.asarray(0.0 if kappa_sensitivity is None else kappa_sensitivity)
        of_m, of_s = _derivatives(_TRANSMITTER, invariants), _derivatives(_RECEIVER, invariants)
        both = _derivatives(_BOTH, invariants)
        by_kappa_m, by_kappa_s = kappa_s * both[0] - of_m[0], kappa_m * both[0] - of_s[0]
        total = total - kappa_m * of_m - kappa_s * of_s + kappa_m * kappa_s * both
    scale = MU0_OVER_4PI * size_s * size_m
    value, by_a, by_b, by_c, by_q = (part[..., None] for part in scale * total)
    across_m = by_b * offset + by_c * along_s
    across_s = by_a * offset + by_c * along_m
    return CoilCoupling(
        value=value[..., 0],
        by_offset=by_a * along_s + by_b * along_m + 2.0 * by_q * offset,
        by_moment=_by_vector(value, across_m, along_m, size_m),
        by_sensitivity=_by_vector(value, across_s, along_s, size_s),
        by_kappa_moment=scale * by_kappa_m,
        by_kappa_sensitivity=scale * by_kappa_s,
    )


def _by_vector(value: Array, by_unit: Array, unit: Array, size: Array) -> Array:
    """Apply the chain rule from length and direction to the vector."""
    radial = np.einsum("...i,...i", by_unit, unit)[..., None]
    return (value * unit + by_unit - radial * unit) / size[..., None]


def _derivatives(terms: tuple[_Term, ...], invariants: tuple[Array, ...]) -> Array:
    """Return a sum of terms and its derivatives by a, b, c and q, shape (5, ...)."""
    a, b, c, q = invariants
    inverse = 1.0 / q
    root = np.sqrt(inverse)
    total = np.zeros((5, *np.broadcast_shapes(a.shape, b.shape, c.shape, q.shape)))
    for term in terms:
        rest = term.factor * root * inverse ** int(-term.q - 0.5)
        powers = a**term.a, b**term.b, c**term.c
        plain = powers[0] * powers[1] * powers[2]
        total[0] += plain * rest
        total[4] += term.q * inverse * plain * rest
        if term.a:
            total[1] += term.a * a ** (term.a - 1) * powers[1] * powers[2] * rest
        if term.b:
            total[2] += term.b * b ** (term.b - 1) * powers[0] * powers[2] * rest
        if term.c:
            total[3] += term.c * c ** (term.c - 1) * powers[0] * powers[1] * rest
    return total
