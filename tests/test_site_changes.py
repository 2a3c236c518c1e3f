"""Keys that turn a site's file into another's: followed one by one, they give that site."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from mistake_remedy import set_key

from magfusion.files.site import site_content
from magfusion.files.site_changes import changed_keys
from magfusion.model.response import FrequencyResponse
from magfusion.model.site import Location, Site
from magfusion.simulation.demo_site import demo_site

SITE = demo_site()


def with_response(site: Site, tones_hz: list[float]) -> Site:
    gain, phase = np.full(len(tones_hz), 0.9), np.full(len(tones_hz), -0.1)
    response = FrequencyResponse(np.array(tones_hz), gain, phase)
    magnetometer = replace(site.platform.magnetometer, response=response)
    return replace(site, platform=site.platform.with_magnetometers((magnetometer,)))


def moved(site: Site) -> Site:
    first, *others = site.beacons
    return replace(
        site, beacons=(replace(first, position_world=first.position_world + 0.1), *others)
    )


PAIRS = {
    "a beacon moved": (SITE, moved(SITE)),
    "a response declared": (SITE, with_response(SITE, [20.0, 40.0])),
    "a response of more tones": (with_response(SITE, [20.0]), with_response(SITE, [20.0, 40.0])),
    "a response changed": (with_response(SITE, [20.0, 30.0]), with_response(SITE, [20.0, 40.0])),
    "a response removed": (with_response(SITE, [20.0]), SITE),
    "a location removed": (
        replace(SITE, location=Location(50.9, 13.3, 400.0, "2026-11-26"), earth_field_world=None),
        SITE,
    ),
    "a beacon added": (replace(SITE, beacons=SITE.beacons[:3]), SITE),
}


@pytest.mark.parametrize("name", PAIRS)
def test_the_keys_followed_give_the_other_site(name: str) -> None:
    before, after = PAIRS[name]
    entry, keys = copy.deepcopy(site_content(before)), changed_keys(before, after)
    assert keys
    for key, value in keys.items():
        set_key(entry, key, value)
    assert entry == site_content(after)


def test_equal_sites_have_no_changed_keys() -> None:
    assert not changed_keys(SITE, SITE)


def test_a_value_within_a_list_has_a_key_of_its_own() -> None:
    assert list(changed_keys(SITE, moved(SITE))) == ["beacons[0].position_m"]
