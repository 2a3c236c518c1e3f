"""Steel in the simulator: limits with a closed form, reciprocity, and drawn rooms."""

from pathlib import Path

import numpy as np
import pytest

from magfusion.errors import InputError
from magfusion.jobs.simulate import steel_option
from magfusion.model.physics.dipole import dipole_field
from magfusion.model.physics.disturbance import sphere_polarizability
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.pipe import Pipe, Steel
from magfusion.simulation.rails import magnetised_world, secondary_world
from magfusion.simulation.steel import Ball, Bar, Body, Sheet, SteelStructure
from magfusion.simulation.steel_worlds import CLEARANCE, KINDS, draw_steel
from magfusion.units import MU0, MU0_OVER_4PI, Array, ComplexArray

BEACONS = np.array([beacon.position_world for beacon in demo_site().beacons])


def _even_moment(field: Array, frequency_hz: float, *bodies: Body) -> ComplexArray:
    """Return the total moment in an even field (A m^2), shape (3,)."""
    steel = SteelStructure(bodies)
    even = np.tile(field, (len(steel.points_world()), 1, 1))
    return np.asarray(steel.moments(even, frequency_hz).sum(axis=(0, 1)))


def _square(
    side: float, tiles: int, thickness: float, permeability: float, conductivity: float
) -> Sheet:
    x, y = np.array([side, 0.0, 0.0]), np.array([0.0, side, 0.0])
    return Sheet(np.zeros(3), x, y, thickness, permeability, conductivity, tile=side / tiles)


def test_a_sphere_in_an_even_field_is_the_dipole_of_its_closed_form() -> None:
    steel = SteelStructure((Ball(np.array([0.0, 2.0, 0.0]), 0.2),))
    field, point = np.array([1e-5, 0.0, 2e-5]), np.array([[0.3, 0.2, -0.1]])
    seen = magnetised_world(steel, field, point)
    moment = 4.0 * np.pi * 0.2**3 / MU0 * 99.0 / 102.0 * field
    expected = dipole_field(point - np.array([0.0, 2.0, 0.0]), moment)
    np.testing.assert_allclose(seen, expected, rtol=1e-6)


def test_two_spheres_in_a_row_have_the_closed_form_of_coupled_dipoles() -> None:
    """Along their axis a moment is a B / (1 - 2 c a / d^3), across a B / (1 + c a / d^3)."""
    frequency_hz, distance, radius = 30.0, 0.9, 0.25
    balls = [Ball(np.array([0.0, x, 0.0]), radius) for x in (0.0, distance)]
    single = complex(sphere_polarizability(radius, 100.0, 5e6, 2.0 * np.pi * frequency_hz))
    share = MU0_OVER_4PI * single / distance**3
    moment = _even_moment(np.array([1.0, 1.0, 0.0]), frequency_hz, *balls)
    np.testing.assert_allclose(moment[1], 2.0 * single / (1.0 - 2.0 * share), rtol=1e-9)
    np.testing.assert_allclose(moment[0], 2.0 * single / (1.0 + share), rtol=1e-9)
    far = [Ball(np.array([0.0, x, 0.0]), radius) for x in (0.0, 100.0)]
    apart = _even_moment(np.array([1.0, 1.0, 0.0]), frequency_hz, *far)
    np.testing.assert_allclose(apart[:2], 2.0 * single, rtol=1e-6)


@pytest.mark.parametrize(("length", "radius", "error"), [(4.0, 0.006, 0.02), (3.0, 0.05, 0.05)])
def test_a_bar_has_the_moment_of_one_in_short_segments_with_rings(
    length: float, radius: float, error: float
) -> None:
    ends = np.zeros(3), np.array([length, 0.0, 0.0])
    field = np.array([1.0, 0.5, 0.0])
    for frequency_hz in (0.0, 30.0):
        moment = _even_moment(field, frequency_hz, Bar(Pipe(*ends, radius, 0.004)))
        fine = Steel((Pipe(*ends, radius, 0.004, segment=length / 60.0),))
        even = np.tile(field, (len(fine.points_world()), 1, 1))
        expected = fine.moments(even, frequency_hz).sum(axis=(0, 1))
        assert abs(moment[0] / expected[0] - 1.0) < error


def test_a_permeable_sheet_has_the_moment_of_a_square_plate() -> None:
    """1.035 side^3 H in its plane (De Meulenaere and Van Bladel, IEEE AP-25, 1977: 4 x 0.2588)."""
    moment = _even_moment(np.array([MU0, 0.0, 0.0]), 0.0, _square(1.0, 12, 1e-3, 1e8, 1e-6))
    assert abs(moment[0] / 1.035 - 1.0) < 0.03


def test_a_sheet_excludes_a_fast_field_and_follows_a_slow_one() -> None:
    """-0.450 side^3 H as a perfect conductor (4 x 0.1126); eddies of a square as its torsion."""
    normal = np.array([0.0, 0.0, MU0])
    fast = _even_moment(normal, 50.0, _square(1.0, 16, 1e-3, 1.0, 1e12))
    assert abs(fast[2] / -0.450 - 1.0) < 0.04
    slow = _even_moment(normal / MU0, 1.0, _square(1.0, 12, 1e-3, 1.0, 1e3))
    expected = -2j * np.pi * 1e3 * 1e-3 * 0.1406 / 4.0
    assert abs(slow[2] / expected - 1.0) < 0.03


@pytest.mark.parametrize("kind", ["spheres", "racks", "cabinets"])
def test_source_and_sensor_may_be_exchanged(kind: str) -> None:
    """Reciprocity: of a solved coupling, as of any passive body."""
    steel = draw_steel(kind, np.random.default_rng(100), DEMO_BOX_WORLD, BEACONS)
    rng = np.random.default_rng(1)
    (first, second), (one, other) = (
        rng.uniform(DEMO_BOX_WORLD[0], DEMO_BOX_WORLD[1], (2, 3)),
        rng.normal(size=(2, 3)),
    )

    def seen(source: Array, moment: Array, point: Array) -> ComplexArray:
        primary = dipole_field(steel.points_world() - source, moment)[:, None].astype(complex)
        return secondary_world(steel, primary, np.array([30.0]), point[None])[0, 0]

    there, back = other @ seen(first, one, second), one @ seen(second, other, first)
    assert abs(there - back) < 1e-8 * abs(there)


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_drawn_room_is_clear_of_the_body_and_takes_power_from_the_field(kind: str) -> None:
    steel = draw_steel(kind, np.random.default_rng(101), DEMO_BOX_WORLD, BEACONS)
    again = draw_steel(kind, np.random.default_rng(101), DEMO_BOX_WORLD, BEACONS)
    points = steel.points_world()
    np.testing.assert_array_equal(points, again.points_world())
    away = np.linalg.norm(points - np.clip(points, *DEMO_BOX_WORLD), axis=1)
    assert np.min(away) > CLEARANCE - 0.01  # m
    field = np.tile(np.array([0.5, 1.0, -0.7]), (len(points), 1, 1))
    moment = steel.moments(field, 30.0)
    assert np.imag(np.sum(np.conj(field) * moment)) < 0.0


def test_steel_of_a_file_is_laid_and_steel_in_the_way_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "steel.yaml"
    file.write_text(
        "spheres: [{centre_m: [3.0, 6.0, 1.0], radius_m: 0.3}]\n"
        "bars: [{start_m: [0, -1, -0.4], end_m: [6, -1, -0.4], radius_m: 0.05, wall_m: 0.004}]\n"
        "sheets: [{corner_m: [-1, 1, 0], first_side_m: [0, 1, 0], second_side_m: [0, 0, 1],"
        " thickness_m: 0.001}]\n"
    )
    assert len(steel_option(str(file), DEMO_BOX_WORLD, BEACONS).bodies) == 3
    assert steel_option("mesh,3", DEMO_BOX_WORLD, BEACONS).bodies
    file.write_text("spheres: [{centre_m: [3.0, 3.0, 1.0], radius_m: 0.3}]\n")
    with pytest.raises(InputError, match="steel comes within 0 m"):
        steel_option(str(file), DEMO_BOX_WORLD, BEACONS)
    file.write_text("bars: [{start_m: [0, 0, 0], end_m: [0, 0, 0.1], radius_m: 0.3}]\n")
    with pytest.raises(InputError, match="longer than it is thick"):
        steel_option(str(file), DEMO_BOX_WORLD, BEACONS)
    with pytest.raises(InputError, match=r"give a file, or kind,seed with one of spheres, mesh"):
        steel_option("trees,3", DEMO_BOX_WORLD, BEACONS)
