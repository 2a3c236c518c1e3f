"""How far a coil of true size is from the dipole that stands for it."""

import magpylib
import numpy as np
import pytest

from magfusion.model.physics.dipole import dipole_field
from magfusion.model.physics.solenoid import loop_field, solenoid_field
from magfusion.units import Array

MOMENT = np.array([0.0, 0.0, 65.0])  # A m^2
RADIUS = 0.23  # m


def everywhere(distance: float) -> Array:
    direction = np.random.default_rng(1).normal(size=(20_000, 3))
    return np.asarray(distance * direction / np.linalg.norm(direction, axis=1)[:, None])


def dipole_error(distance: float, length: float) -> float:
    points = everywhere(distance)
    true = solenoid_field(points, MOMENT, RADIUS, length)
    error = np.linalg.norm(dipole_field(points, MOMENT) - true, axis=1)
    return float(np.sqrt(np.mean((error / np.linalg.norm(true, axis=1)) ** 2)))


@pytest.mark.parametrize(
    ("distance", "expected"),
    [(0.6, 0.12), (0.8, 0.067), (1.0, 0.042), (2.0, 0.0106), (5.0, 0.0017)],
)
def test_a_short_coil_departs_from_its_dipole_by_the_known_share(
    distance: float, expected: float
) -> None:
    assert dipole_error(distance, 0.20) == pytest.approx(expected, rel=0.05)


def test_a_coil_of_root_three_radii_has_no_next_term() -> None:
    assert dipole_error(2.0, 0.40) == pytest.approx(2.7e-4, rel=0.05)


def test_a_loop_is_that_of_an_independent_library() -> None:
    points = everywhere(0.6)[:50]
    current = MOMENT[2] / (np.pi * RADIUS**2)
    circle = magpylib.current.Circle(diameter=2.0 * RADIUS, current=current).getB(points)
    error = np.linalg.norm(loop_field(points, MOMENT, RADIUS) - circle, axis=1)
    assert np.max(error / np.linalg.norm(circle, axis=1)) < 1e-7


def test_a_line_of_dipoles_is_the_sum_of_a_fine_array() -> None:
    points = everywhere(1.0)[:50]
    places = (np.arange(4000) + 0.5) / 4000 * 0.2 - 0.1  # m along the axis
    array = sum(dipole_field(points - [0.0, 0.0, z], MOMENT / 4000) for z in places)
    result = solenoid_field(points, MOMENT, length=0.2)
    error = np.linalg.norm(result - array, axis=1) / np.linalg.norm(result, axis=1)
    assert np.max(error) < 1e-7  # quadrature
