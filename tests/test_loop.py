"""The closed form of a loop against the laws of the field, Biot and Savart, and 60 digits."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from derivatives import central_difference

from magfusion.model.physics.dipole import dipole_field
from magfusion.model.physics.loop import loop_field, loop_field_and_gradient
from magfusion.units import MU0_OVER_4PI, Array

RADIUS = 0.15  # m
MOMENT = np.array([0.4, 1.1, -0.7])  # A m^2
AXIS = MOMENT / np.linalg.norm(MOMENT)
ACROSS = np.linalg.svd(AXIS[None])[2][1]
CURRENT = float(np.linalg.norm(MOMENT)) / (np.pi * RADIUS**2)  # A
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
ANGLES = (0.0, 1e-6, 1e-3, 0.1, 0.5, 0.9553, 1.2, 1.5, 1.57079, 2.0, np.pi - 1e-5)  # from the axis


def at(distance: float, angle: float) -> Array:
    """Return an offset (m) so many radii away, at an angle from the axis."""
    return distance * RADIUS * (np.cos(angle) * AXIS + np.sin(angle) * ACROSS)


def relative(result: Array, expected: Array) -> float:
    return float(np.linalg.norm(result - expected) / np.linalg.norm(expected))


def complete_integrals(parameter: Decimal) -> tuple[Decimal, Decimal]:
    """Return K and E of a parameter by the arithmetic-geometric mean."""
    mean, other, total, weight = Decimal(1), (1 - parameter).sqrt(), parameter / 2, Decimal(1)
    while mean - other > Decimal("1e-55"):
        half = (mean - other) / 2
        mean, other = (mean + other) / 2, (mean * other).sqrt()
        total, weight = total + weight * half**2, 2 * weight
    whole = PI / (2 * mean)
    return whole, whole * (1 - total)


def textbook(offset: Array) -> Array:
    """Return Smythe's formula by K and E with 60 digits, of which it loses 40."""
    with localcontext(prec=60):
        z, x = (
            sum(Decimal(o) * Decimal(w) for o, w in zip(offset, v, strict=True))
            for v in (AXIS, ACROSS)
        )
        a, s = Decimal(RADIUS), x**2
        near, far = ((a + sign * abs(x)) ** 2 + z**2 for sign in (-1, 1))
        first, second = complete_integrals(4 * a * abs(x) / far)
        moment = Decimal(float(np.linalg.norm(MOMENT)))
        scale = 2 * Decimal(MU0_OVER_4PI) * moment / (PI * a**2 * far.sqrt())
        along = scale * (first + (a * a - s - z * z) / near * second)
        outward = scale * z / x * (-first + (a * a + s + z * z) / near * second) if x else 0
        return np.array(
            [
                float(along * Decimal(n) + outward * Decimal(u))
                for n, u in zip(AXIS, ACROSS, strict=True)
            ]
        )


@pytest.mark.parametrize("distance", [0.01, 0.3, 0.9, 1.1, 1.5, 2.0, 5.0, 30.0, 1e3, 1e6])
def test_no_digit_is_lost_near_or_far(distance: float) -> None:
    for angle in ANGLES:
        offset = at(distance, angle)
        assert relative(loop_field(offset, MOMENT, RADIUS), textbook(offset)) < 1e-13


def test_on_the_axis_it_is_the_elementary_formula() -> None:
    z = np.array([0.0, 0.02, 0.15, 1.0, 40.0, 1e5])
    expected = 2.0 * MU0_OVER_4PI * MOMENT / (z**2 + RADIUS**2)[:, None] ** 1.5
    result = loop_field(z[:, None] * AXIS, MOMENT, RADIUS)
    np.testing.assert_allclose(result, expected, rtol=1e-14)


@pytest.mark.parametrize("distance", [0.4, 0.8, 1.3, 3.0, 20.0])
def test_biot_and_savart(distance: float) -> None:
    """The law itself, over elements of the wire: exact on a circle of so many."""
    angle = (np.arange(600) + 0.5) * 2.0 * np.pi / 600
    outward = np.cos(angle)[:, None] * ACROSS + np.sin(angle)[:, None] * np.cross(AXIS, ACROSS)
    element = 2.0 * np.pi / 600 * RADIUS * np.cross(AXIS, outward)
    for tilt in ANGLES:
        way = at(distance, tilt) - RADIUS * outward
        cubed = np.linalg.norm(way, axis=1)[:, None] ** 3
        expected = MU0_OVER_4PI * CURRENT * np.sum(np.cross(element, way) / cubed, axis=0)
        assert relative(loop_field(at(distance, tilt), MOMENT, RADIUS), expected) < 1e-12


def test_no_divergence_and_no_curl() -> None:
    """Of the field's differences, not of its gradient, whose form leaves it no other choice."""
    for distance in (0.5, 1.4, 4.0, 50.0):
        for angle in (0.0, 1e-4, 0.7, 1.5):
            offset = at(distance, angle)
            step = 1e-5 * distance * RADIUS
            slope = central_difference(
                lambda d, o=offset: loop_field(o + d, MOMENT, RADIUS), 3, step
            )
            size = np.linalg.norm(slope)
            assert abs(np.trace(slope)) < 1e-8 * size
            assert np.linalg.norm(slope - slope.T) < 1e-8 * size


def test_amperes_law() -> None:
    """The field along a closed path is the current through it: around the wire, and beside it."""
    turn = (np.arange(200) + 0.5) * 2.0 * np.pi / 200
    for centre, through in ((1.0, CURRENT), (1.8, 0.0)):
        path = (centre + 0.4 * np.cos(turn))[:, None] * ACROSS - 0.4 * np.sin(turn)[:, None] * AXIS
        ahead = -0.4 * (np.sin(turn)[:, None] * ACROSS + np.cos(turn)[:, None] * AXIS)
        field = loop_field(RADIUS * path, MOMENT, RADIUS)
        result = np.sum(field * ahead) * RADIUS * 2.0 * np.pi / 200
        expected = 4.0 * np.pi * MU0_OVER_4PI * through
        assert abs(result - expected) < 1e-10 * 4.0 * np.pi * MU0_OVER_4PI * CURRENT


@pytest.mark.parametrize("distance", [0.01, 0.5, 0.9, 1.2, 2.0, 5.0, 1e2, 1e4, 1e6])
def test_the_gradient_is_that_of_the_field(distance: float) -> None:
    for angle in ANGLES:
        offset = at(distance, angle)
        step = 2e-5 * RADIUS * max(distance, 0.1)
        expected = central_difference(
            lambda d, o=offset: loop_field(o + d, MOMENT, RADIUS), 3, step
        )
        field, result = loop_field_and_gradient(offset, MOMENT, RADIUS)
        assert relative(result, expected) < 1e-7
        np.testing.assert_array_equal(field, loop_field(offset, MOMENT, RADIUS))


def test_far_away_it_differs_from_the_dipole_by_the_next_term_alone() -> None:
    """``(a/R)^2 (3/2 on the axis, 9/8 across it)``, down to where a double can tell."""
    for distance in (5.0, 20.0, 1e2, 1e3, 1e4, 1e5, 1e6):
        ratio = distance**-2
        for angle, share in ((0.0, -1.5), (0.5 * np.pi, 1.125)):
            offset = at(distance, angle)
            dipole = dipole_field(offset, MOMENT)
            result = float(loop_field(offset, MOMENT, RADIUS) @ dipole / (dipole @ dipole)) - 1.0
            assert abs(result - share * ratio) < 3.0 * ratio**2 + 2e-15
        for angle in ANGLES:
            offset = at(distance, angle)
            error = relative(loop_field(offset, MOMENT, RADIUS), dipole_field(offset, MOMENT))
            assert error < 1.5 * ratio + 2e-15


def test_without_radius_it_is_the_dipole() -> None:
    offset = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(
        loop_field(offset, MOMENT, 0.0), dipole_field(offset, MOMENT), rtol=0.0, atol=1e-20
    )
    mixed = loop_field(offset[:, None], np.stack([MOMENT, MOMENT]), np.array([0.0, RADIUS]))
    np.testing.assert_array_equal(mixed[:, 1], loop_field(offset, MOMENT, RADIUS))


def test_at_the_wire_it_stays_finite() -> None:
    field, gradient = loop_field_and_gradient(RADIUS * ACROSS, MOMENT, RADIUS)
    assert np.all(np.isfinite(field))
    assert np.all(np.isfinite(gradient))
