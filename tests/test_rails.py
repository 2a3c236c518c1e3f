"""Rails and tubes of steel in the simulator: limits with a closed form, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import magpylib
import numpy as np
import pytest
from conftest import run_command

from magfusion.errors import InputError
from magfusion.model.physics.dipole import dipole_field
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.field import beacon_fields_world, phasors_world
from magfusion.simulation.layers import Layers
from magfusion.simulation.pipe import Pipe, Steel
from magfusion.simulation.rails import (
    laid,
    layered_at,
    magnetised_world,
    rails_option,
    secondary_world,
    steel_along_wells,
)
from magfusion.units import MU0, Array

NOWHERE = np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]])
NONE = np.zeros((0, 3))


def _bar(length: float, radius: float = 0.01, away: float = 1.0) -> Steel:
    half = 0.5 * length
    ends = f"{radius}:{-half},{away},0:{half},{away},0"
    return laid(rails_option(ends), NOWHERE, NONE)


def _even(steel: Steel, field_world: Array) -> Array:
    return np.broadcast_to(field_world, (len(steel.points_world()), 1, 3)).astype(complex)


def _prolate_moment(length: float, radius: float, permeability: float, field: float) -> float:
    """Return the moment along a prolate spheroid in a uniform field (Osborn, 1945) (A m^2)."""
    ratio = 0.5 * length / radius
    root = np.sqrt(ratio**2 - 1.0)
    factor = (ratio / root * np.log(ratio + root) - 1.0) / (ratio**2 - 1.0)
    volume = 4.0 / 3.0 * np.pi * 0.5 * length * radius**2
    return volume * field / MU0 * (permeability - 1.0) / (1.0 + factor * (permeability - 1.0))


def test_a_rail_far_away_is_the_dipole_of_a_bar() -> None:
    field_world = np.array([2e-5, 0.0, 0.0])
    steel = _bar(1.0, 0.02)
    far = np.array([[0.0, 41.0, 0.0], [30.0, 11.0, 5.0]])
    seen = magnetised_world(steel, field_world, far)
    moment = steel.moments(_even(steel, field_world), 0.0).sum(axis=0)[0].real
    np.testing.assert_allclose(
        seen, dipole_field(far - [0.0, 1.0, 0.0], moment), rtol=3e-3, atol=1e-18
    )
    # A cylinder is no spheroid: of the same length and radius it has half as much steel again.
    spheroid = _prolate_moment(1.0, 0.02, 100.0, 2e-5)
    assert 1.0 < moment[0] / spheroid < 1.6
    assert np.all(np.abs(moment[1:]) < 1e-9 * moment[0])


def test_shorter_segments_give_the_same_field() -> None:
    site = demo_site()
    pipes = rails_option("0.05:-3,-1,0:12,-1,0;0.08/0.008:3,4.8,-4:3,4.8,4")
    beacons_world = np.array([beacon.position_world for beacon in site.beacons])
    steel = laid(pipes, DEMO_BOX_WORLD, beacons_world)
    finer = Steel(tuple(replace(pipe, segment=0.5 * pipe.segment) for pipe in steel.pipes))
    point_world = DEMO_BOX_WORLD[0] + np.random.default_rng(1).uniform(0, 1, (20, 3)) * np.ptp(
        DEMO_BOX_WORLD, axis=0
    )
    beacon = site.beacons[0]
    without = phasors_world(beacon, point_world)
    seen = phasors_world(beacon, point_world, rails=steel) - without
    more = phasors_world(beacon, point_world, rails=finer) - without
    assert np.max(np.abs(seen)) > 1e-3 * np.max(np.abs(without))
    assert np.max(np.abs(more - seen)) < 0.005 * np.max(np.abs(seen))


def test_source_and_sensor_change_places() -> None:
    steel = laid(rails_option("0.05:-4,1.2,0:4,1.2,0.3"), NOWHERE, NONE)
    a, b = np.array([-1.0, 0.0, 0.2]), np.array([1.5, 0.3, -0.4])

    def tensor(source: Array, point: Array) -> Array:
        columns = []
        for axis in np.eye(3):
            at = dipole_field(steel.points_world() - source, axis)[:, None].astype(complex)
            columns.append(secondary_world(steel, at, np.array([100.0]), point[None])[0, 0])
        return np.stack(columns, axis=1)

    there, back = tensor(a, b), tensor(b, a).T
    # But for the length of a segment.
    assert np.max(np.abs(there - back)) < 1e-3 * np.max(np.abs(there))


@pytest.mark.parametrize(
    ("text", "findings"),
    [
        ("0.05:1,2,3", "is no bar or tube"),
        ("0.05:1,2:4,5,6", "is no bar or tube"),
        ("0.05/0.06:0,0,0:5,0,0", "wall <= radius"),
        ("0.5:0,0,0:0.9,0,0", "not longer than it is thick"),
        ("nan:0,0,0:5,0,0", "wall <= radius"),
    ],
)
def test_what_is_no_rail_is_refused(text: str, findings: str) -> None:
    with pytest.raises(InputError, match=findings):
        rails_option(text)


def test_steel_where_the_platform_moves_is_refused() -> None:
    with pytest.raises(InputError, match="the platform's range"):
        laid(rails_option("0.05:-5,0,0:5,0,0"), NOWHERE, NONE)
    with pytest.raises(InputError, match="touching parts are one piece"):
        laid(rails_option("0.05:-5,2,0:5,2,0;0.05:0,1,0:0,3,0"), NOWHERE, NONE)


def test_a_tube_is_a_pipe() -> None:
    (pipe,) = rails_option("0.1/0.008:3,4,-4:3,4,4")
    assert isinstance(pipe, Pipe)
    assert (pipe.radius, pipe.wall, pipe.length) == (0.1, 0.008, 8.0)


@pytest.mark.parametrize(("permeability", "wall"), [(100.0, 0.05), (1000.0, 0.05), (100.0, 0.005)])
def test_across_a_long_rail_at_rest_is_a_cylinder_in_an_even_field(
    permeability: float, wall: float
) -> None:
    """Outside is the potential of a line of dipoles, of a solid bar and of a tube."""
    half, across = np.array([20.0, 0.0, 0.0]), np.array([0.0, 2e-5, 1e-5])
    steel = Steel((Pipe(-half, half, 0.05, wall, permeability, segment=0.2),))
    point = np.array([[0.1, 0.6, 0.0], [0.0, 0.3, -0.7]])
    hole = (1.0 - wall / 0.05) ** 2
    up, down = (permeability + 1.0) ** 2, (permeability - 1.0) ** 2
    share = (permeability**2 - 1.0) * (1.0 - hole) / (up - down * hole)
    square = np.sum(point[:, 1:] ** 2, axis=1)[:, None]
    outward = point * [0.0, 1.0, 1.0] / np.sqrt(square)
    expected = share * 0.05**2 / square * (2.0 * (outward @ across)[:, None] * outward - across)
    result = magnetised_world(steel, across, point)
    np.testing.assert_allclose(result, expected, rtol=2e-3, atol=2e-10)


def test_a_bar_that_hardly_answers_itself_has_the_field_of_a_bar_magnet() -> None:
    half, mu = np.array([10.0, 0.0, 0.0]), 1.0 + 1e-4
    steel = Steel((Pipe(-half, half, 0.05, 0.05, mu, segment=0.1),))
    point = np.array([[10.6, 0.6, 0.2], [3.0, 0.9, 0.0], [40.0, 5.0, 1.0]])
    result = magnetised_world(steel, np.array([3e-5, 0.0, 0.0]), point)
    bar = magpylib.magnet.Cylinder(polarization=(0.0, 0.0, 3e-5 * (mu - 1.0)), dimension=(0.1, 20))
    expected = bar.rotate_from_angax(90.0, "y").getB(point)
    assert np.all(
        np.linalg.norm(result - expected, axis=1) < 5e-3 * np.linalg.norm(expected, axis=1)
    )


def test_a_short_bar_is_magnetised_as_its_slices_are() -> None:
    """Slices of magpylib's, each in the mean field of all over its section.

    The poles of the simulator are rings, not discs: at twenty diameters that is seven per cent.
    """
    count, along = 40, np.array([3e-5, 0.0, 0.0])
    half, separate = np.array([1.0, 0.0, 0.0]), np.arange(count) * 2.0 / count
    pipe = Pipe(-half, half, 0.05, 0.05, segment=0.05)
    moment = Steel((pipe,)).moments(np.tile(along, (count, 1, 1)), 0.0).sum(axis=0)[0, 0].real
    one = magpylib.magnet.Cylinder(polarization=(0.0, 0.0, 1.0), dimension=(0.1, 2.0 / count))
    section = [
        one.getB(np.column_stack([np.full(count, 0.05 * root), 0.0 * separate, separate]))[:, 2]
        for root in np.sqrt((np.arange(8) + 0.5) / 8.0)
    ]
    strength = np.mean(section, axis=0) - (separate == 0.0)
    matrix = strength[np.abs(np.arange(count)[:, None] - np.arange(count))]
    slices = np.linalg.solve(np.eye(count) - 99.0 * matrix, np.full(count, 99.0))
    expected = np.mean(slices) * pipe.area * pipe.length * along[0] / MU0
    assert moment == pytest.approx(float(expected), rel=0.1)


@pytest.mark.slow  # empymod is compiled when it is first used
def test_a_rail_in_layers_is_driven_by_their_field() -> None:
    pytest.importorskip("empymod")
    beacon = demo_site().beacons[0]
    steel = laid(rails_option("0.05:-9,-1,-0.2:9,-1,0.2"), DEMO_BOX_WORLD, NONE)
    added = layered_at(steel, beacon, Layers((1000.0,), (4.0,)))
    ground = replace(beacon, conductivity=4.0)
    whole, still = (
        beacon_fields_world(one, steel.points_world())
        for one in (ground, replace(ground, conductivity=0.0))
    )
    assert np.max(np.abs(still + added - whole)) < 1e-5 * np.max(np.abs(whole))


def test_steel_beside_wells_keeps_off_the_magnets_way() -> None:
    way = np.linspace([-5.0, 0.0, 0.0], [5.0, 0.0, 0.0], 500)
    (near,) = steel_along_wells(rails_option("0.05:-5,1,0:5,1,0"), [way])
    assert near.segment == pytest.approx(10.0 / 40.0)
    with pytest.raises(InputError, match=r"number 1 comes within .* of the sensor"):
        steel_along_wells(rails_option("0.05:0,-3,0:0,3,0"), [way])


@pytest.mark.slow
@pytest.mark.parametrize(
    "rails",
    [
        "0.05:-10,1.8,-0.1:15,1.8,-0.1;0.05:-10,3.235,-0.1:15,3.235,-0.1",
        "0.12/0.01:3,0.4,-6:3,0.4,4",
    ],
    ids=["track", "casing"],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_beside_steel_what_is_trusted_is_no_farther_off_than_it_says(
    rails: str, seed: int, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    run_command("simulate", "-o", log, "--duration", 30, "--seed", seed, "--rails", rails)
    for job in ("smooth", "navigate"):
        run_command(job, log, "-o", tmp_path / job)
        result = json.loads((tmp_path / job / "report.json").read_text())
        assert result["verdict"] != "trustworthy" or result["nees_mean"] <= 12.0, job
