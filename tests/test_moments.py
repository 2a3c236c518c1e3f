"""A site with larger moments against one that is made anew."""

from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest
from tracker_site import tracker_site

from magfusion.model.parameters import (
    PARAMETERS,
    choose_blocks,
    dimension,
    initial_calibration,
    linearize_channels,
)
from magfusion.model.parameters.beacon import with_moments
from magfusion.model.site import Beacon, Coil, Site
from magfusion.simulation.demo_site import demo_site


def tracker() -> Site:
    return tracker_site(np.random.default_rng(0))


def long_coils() -> Site:
    site = demo_site()
    first = site.beacons[0]
    coils = tuple(replace(coil, length=0.3) for coil in first.coils)
    return replace(site, beacons=(replace(first, coils=coils), *site.beacons[1:]))


def linearized(site: Site) -> tuple[np.ndarray, ...]:
    calibration = initial_calibration(site, 0.0)
    blocks = choose_blocks(site, parameters=PARAMETERS)
    assert dimension(blocks)
    place = np.eye(3)[None], np.array([[2.0, 1.5, 1.0]])
    return linearize_channels(calibration, blocks, np.ones(1), *place, np.ones((1, 6)))


def known(part: Beacon | Site) -> dict[str, object]:
    names = [n for n, own in vars(type(part)).items() if isinstance(own, cached_property)]
    return {name: getattr(part, name) for name in names}


def restart(site: Site) -> Site:
    def coil(one: Coil) -> Coil:
        return replace(one, moment_beacon=one.moment_beacon.copy())

    beacons = tuple(replace(b, coils=tuple(map(coil, b.coils))) for b in site.beacons)
    return replace(site, beacons=beacons)


@pytest.mark.parametrize("make", [demo_site, tracker, long_coils])
def test_a_site_with_larger_moments_is_one_made_anew(make):
    site = make()
    before = linearized(site)
    for part in (site, *site.beacons):
        known(part)
    factors = {b.name: 1.1 + 0.1 * np.arange(len(b.coils))[:, None] for b in site.beacons[:2]}
    moments = {b.name: b.moments_beacon * factors[b.name] for b in site.beacons[:2]}
    result = with_moments(site, moments)
    expected = restart(result)
    for one, other in zip((result, *result.beacons), (expected, *expected.beacons), strict=True):
        for name, value in known(other).items():
            np.testing.assert_equal(known(one)[name], value, name)
    for one, other in zip(linearized(result), linearized(expected), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(before[0], linearized(result)[0])
    assert np.array_equal(site.beacons[0].moments_beacon, make().beacons[0].moments_beacon)
