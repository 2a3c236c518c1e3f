"""Rails and tubes of steel in the simulator: limits with a closed form, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.errors import InputError
from magfusion.model.physics.dipole import dipole_field
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.field import phasors_world
from magfusion.simulation.pipe import MU0, Pipe, Steel
from magfusion.simulation.rails import laid, magnetised_world, rails_option, secondary_world
from magfusion.units import Array

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
    ("text", "said"),
    [
        ("0.05:1,2,3", "is no bar or tube"),
        ("0.05:1,2:4,5,6", "is no bar or tube"),
        ("0.05/0.06:0,0,0:5,0,0", "wall <= radius"),
        ("0.5:0,0,0:0.9,0,0", "not longer than it is thick"),
        ("nan:0,0,0:5,0,0", "wall <= radius"),
    ],
)
def test_what_is_no_rail_is_refused(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        rails_option(text)


def test_steel_where_the_platform_moves_is_refused() -> None:
    with pytest.raises(InputError, match="where the platform moves"):
        laid(rails_option("0.05:-5,0,0:5,0,0"), NOWHERE, NONE)
    with pytest.raises(InputError, match="what touches is one piece"):
        laid(rails_option("0.05:-5,2,0:5,2,0;0.05:0,1,0:0,3,0"), NOWHERE, NONE)


def test_a_tube_is_a_pipe() -> None:
    (pipe,) = rails_option("0.1/0.008:3,4,-4:3,4,4")
    assert isinstance(pipe, Pipe)
    assert (pipe.radius, pipe.wall, pipe.length) == (0.1, 0.008, 8.0)
