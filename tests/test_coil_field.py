"""The coils of a beacon as declared: against an independent library and Biot and Savart's law."""

from dataclasses import replace

import magpylib
import numpy as np
import pytest
from derivatives import central_difference

from magfusion.model.coil_field import alone, coil_fields, coil_fields_and_gradients
from magfusion.model.physics.dipole import dipole_field, dipole_field_and_gradient
from magfusion.model.physics.solenoid import solenoid_field
from magfusion.model.site import Beacon, Coil
from magfusion.simulation.demo_site import demo_site
from magfusion.units import MU0_OVER_4PI, Array

MOMENT = np.array([20.0, -50.0, 30.0])  # A m^2
SHAPES = {
    "loop": (0.2, None),
    "sheet": (0.15, 0.3),
    "long sheet": (0.1, 0.5),
    "line of dipoles": (None, 0.3),
    "dipole": (None, None),
}
each_shape = pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)


def beacon_of(*coils: Coil) -> Beacon:
    return replace(demo_site(coil_radius=None).beacons[0], coils=coils)


def around(distance: float, count: int = 60) -> Array:
    direction = np.random.default_rng(3).normal(size=(count, 3))
    return np.asarray(distance * direction / np.linalg.norm(direction, axis=1)[:, None])


def relative(result: Array, expected: Array) -> float:
    axes = tuple(range(1, result.ndim))
    size = np.sqrt(np.sum(expected**2, axis=axes))
    return float(np.max(np.sqrt(np.sum((result - expected) ** 2, axis=axes)) / size))


def test_dipoles_are_dipoles_to_the_last_bit() -> None:
    centre = np.array([0.03, -0.01, 0.02])
    beacon = beacon_of(Coil(MOMENT), Coil(MOMENT[::-1].copy(), centre_beacon=centre))
    points = around(1.3)
    offset = points[:, None] - np.array([np.zeros(3), centre])
    field, gradient = coil_fields_and_gradients(alone(beacon), points)
    np.testing.assert_array_equal(field, dipole_field(offset, beacon.moments_beacon))
    np.testing.assert_array_equal(
        gradient, dipole_field_and_gradient(offset, beacon.moments_beacon)[1]
    )
    np.testing.assert_array_equal(coil_fields(alone(beacon), points), field)


@each_shape
@pytest.mark.parametrize("distance", [0.4, 0.7, 2.0, 50.0])
def test_the_simulator_which_sums_over_the_wire_agrees(
    shape: tuple[float | None, float | None], distance: float
) -> None:
    coil = Coil(MOMENT, 0.0, np.zeros(3), *shape)
    result = coil_fields(alone(beacon_of(coil)), around(distance))[:, 0]
    assert relative(result, solenoid_field(around(distance), MOMENT, *shape)) < 1e-6


def test_a_sheet_is_the_magnet_of_an_independent_library() -> None:
    """A cylinder magnetised along its axis has the field of a solenoid outside itself."""
    radius, length, moment = 0.15, 0.3, 65.0
    polarization = moment / (np.pi * radius**2 * length) * 4.0 * np.pi * MU0_OVER_4PI
    magnet = magpylib.magnet.Cylinder(
        dimension=(2.0 * radius, length), polarization=(0.0, 0.0, polarization)
    )
    beacon = beacon_of(Coil(np.array([0.0, 0.0, moment]), radius=radius, length=length))
    for distance, bound in ((0.35, 1e-5), (0.6, 1e-9), (3.0, 1e-10)):
        points = around(distance)
        assert relative(coil_fields(alone(beacon), points)[:, 0], magnet.getB(points)) < bound


@each_shape
def test_the_gradient_is_that_of_the_field(shape: tuple[float | None, float | None]) -> None:
    centre = np.array([0.03, -0.02, 0.05])
    beacon = beacon_of(Coil(MOMENT, 0.0, centre, *shape), Coil(MOMENT[::-1].copy(), radius=0.1))
    for distance in (0.45, 0.8, 2.5, 1e3):
        points = around(distance)
        field, gradient = coil_fields_and_gradients(alone(beacon), points)
        np.testing.assert_array_equal(field, coil_fields(alone(beacon), points))
        step = 2e-6 * distance
        expected = central_difference(
            lambda d, p=points: coil_fields(alone(beacon), p + d), 3, step
        )
        for coil in range(2):
            assert relative(gradient[:, coil], expected[:, coil]) < 1e-7


def test_moments_of_a_shape_add() -> None:
    """Twice the current, twice the field; two half coils are a whole one."""
    coil = Coil(MOMENT, radius=0.2, length=0.1)
    half = replace(coil, moment_beacon=0.5 * MOMENT)
    points = around(0.5)
    whole = coil_fields(alone(beacon_of(coil)), points)[:, 0]
    both = coil_fields(alone(beacon_of(half, half)), points)
    np.testing.assert_allclose(both.sum(axis=1), whole, rtol=0.0, atol=1e-13 * np.abs(whole).max())
