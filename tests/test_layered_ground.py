"""Layers of ground in the simulator: what is asked for, and what they come to."""

from dataclasses import replace

import numpy as np
import pytest
from derivatives import relative_to_group
from through_rock import ROCK, Config, log_at, smoothed, true_site, wrong_site

from magfusion.errors import InputError
from magfusion.simulation.field import beacon_fields_world
from magfusion.simulation.layers import Layers, layered_effect, layers_option

POINTS = np.random.default_rng(3).uniform(-3.0, 3.0, (20, 3))


def test_layers_are_read_from_above() -> None:
    assert layers_option("0:0.01,-20:0.05") == Layers((0.0, -20.0), (0.01, 0.05))
    layers = layers_option("0:0.01,-20:0.05")
    np.testing.assert_array_equal(layers.of(np.array([5.0, -5.0, -20.1])), [0, 1, 2])
    for wrong in ("", "0", "0:0", "0:-1", "0:0.01,5:0.1", "a:b", "0:1:2"):
        with pytest.raises(InputError, match="--ground"):
            layers_option(wrong)


def test_a_platform_is_in_one_layer_and_away_from_beacons() -> None:
    beacon = true_site(ROCK, 1).beacons[0]
    with pytest.raises(InputError, match="surface"):
        layered_effect(beacon, POINTS, Layers((0.5,), (0.01,)))
    near = replace(beacon, position_world=np.array([0.0, 0.0, 3.5]))
    with pytest.raises(InputError, match="too close to beacon A"):
        layered_effect(near, POINTS, Layers((100.0,), (0.01,)))


@pytest.mark.slow  # empymod is compiled when it is first used
def test_layers_of_one_conductivity_are_one_and_deep_in_it_a_full_space() -> None:
    pytest.importorskip("empymod")
    beacon = true_site(ROCK, 1).beacons[0]
    whole = beacon_fields_world(beacon, POINTS)
    still = beacon_fields_world(replace(beacon, conductivity=0.0), POINTS)
    result = {
        top: still + layered_effect(beacon, POINTS, Layers((top,), (0.01,)))
        for top in (1500.0, 300.0, 60.0)
    }
    assert relative_to_group(result[1500.0], whole) < 1e-6
    few = still[:3] + layered_effect(beacon, POINTS[:3], Layers((60.0,), (0.01,)))
    assert relative_to_group(few, result[60.0][:3]) < 1e-6  # on another grid
    far, near = (relative_to_group(result[top], whole) for top in (300.0, 60.0))
    assert 1e-4 < far < 0.01
    assert 0.05 < near < 0.3
    split = still + layered_effect(beacon, POINTS, Layers((60.0, -50.0), (0.01, 0.01)))
    assert relative_to_group(split, result[60.0]) < 1e-6


@pytest.mark.slow
def test_under_a_surface_the_error_is_larger_and_not_hidden() -> None:
    pytest.importorskip("empymod")
    log = log_at(ROCK, Config(surface=True), true_site(ROCK, 10))
    row = smoothed(log, wrong_site(ROCK), ROCK, 10, "threefold")
    assert row.position_m < 2.0 * ROCK.bound
    assert row.nees < 6.0
