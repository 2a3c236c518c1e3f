"""The field along a path, by some of its points, is that of all its points."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.model import path_field
from magfusion.model.coil_field import Sources, alone, side_by_side
from magfusion.model.field import driven_field
from magfusion.model.path_field import field_along_path
from magfusion.model.site import Site
from magfusion.simulation.demo_site import demo_site
from magfusion.units import Array

RATE_HZ = 286.0


def _walk(count: int, height: float = 1.2) -> Array:
    """Return points of a walk with the sway of steps (m)."""
    time = np.arange(count) / RATE_HZ
    sway = 0.02 * np.sin(12.0 * time)
    path = [2.0 * np.cos(0.4 * time) + sway, 1.5 * np.sin(0.5 * time), height + 2.0 * sway]
    return np.stack(path, axis=1)


def _velocity(path: Array) -> Array:
    return np.gradient(path, 1.0 / RATE_HZ, axis=0)


def _currents(source: Sources, count: int) -> Array:
    coils = len(source.loops.first)
    shape = (count, coils) if source.position_world.ndim == 1 else (4, count, coils)
    return np.random.default_rng(1).standard_normal(shape)


def _sized(site: Site, conductivity: float = 0.0) -> Site:
    coils = [
        tuple(replace(coil, radius=0.1, length=0.05) for coil in beacon.coils)
        for beacon in site.beacons
    ]
    beacons = [
        replace(beacon, coils=own, conductivity=conductivity)
        for beacon, own in zip(site.beacons, coils, strict=True)
    ]
    return replace(site, beacons=tuple(beacons))


@pytest.mark.parametrize("conductivity", [0.0, 0.5])
@pytest.mark.parametrize("count", [64, 65, 2048, 5000])
def test_a_walk_among_coils_is_predicted_to_a_hundred_thousandth(
    count: int, conductivity: float
) -> None:
    ((_, source),) = side_by_side(_sized(demo_site(), conductivity))
    path, current = _walk(count), _currents(source, count)
    velocity = _velocity(path)
    exact = driven_field(source, path, current, velocity)
    result = field_along_path(source, path, current, velocity)
    assert np.any(result.field != exact.field)  # found otherwise
    size = np.sqrt(np.mean(current**2, axis=-1)) * np.linalg.norm(
        driven_field(source, path, np.ones_like(current)).field, axis=-1
    )
    separate = np.linalg.norm(result.field - exact.field, axis=-1)
    assert np.max(separate / (size + np.linalg.norm(exact.field, axis=-1))) < 2e-5
    assert result.along is not None
    assert exact.along is not None
    assert np.max(np.abs(result.along - exact.along)) < 5e-3 * np.max(np.abs(exact.along))
    without = field_along_path(source, path, current)
    assert without.along is None
    np.testing.assert_array_equal(without.field, result.field)


def test_a_path_close_to_a_coil_or_with_a_gap_is_taken_point_by_point() -> None:
    source = alone(_sized(demo_site()).beacons[0])
    others = source.position_world + np.array([0.15, 0.0, 0.0])
    for path in (
        others + 0.02 * np.random.default_rng(0).standard_normal((300, 3)),
        np.concatenate([_walk(100), _walk(100) + 1.0]),
        _walk(20),
    ):
        current = _currents(source, len(path))
        exact, result = (f(source, path, current) for f in (driven_field, field_along_path))
        np.testing.assert_array_equal(result.field, exact.field)


def test_nodes_are_the_closer_the_nearer_the_coil_is() -> None:
    source = alone(_sized(demo_site()).beacons[0])

    def samples(distance: float) -> int:
        path = _walk(500)
        path = source.position_world + np.array([distance, 0.0, 0.0]) + 0.1 * (path - path[0])
        return path_field._from_node_to_node(
            source, (path - source.position_world) @ source.world_from_beacon
        )

    assert samples(0.3) < samples(1.0) <= path_field.MAX_NODE_SAMPLES
    assert samples(0.05) == 0  # in the coil


def test_a_still_path_has_the_field_of_its_place() -> None:
    source = alone(_sized(demo_site()).beacons[0])
    path = np.tile(source.position_world + np.array([1.0, 0.5, 0.2]), (200, 1))
    current = _currents(source, len(path))
    exact = driven_field(source, path, current, np.zeros_like(path))
    result = field_along_path(source, path, current, np.zeros_like(path))
    np.testing.assert_allclose(result.field, exact.field, rtol=1e-12)
    np.testing.assert_array_equal(result.along, exact.along)
