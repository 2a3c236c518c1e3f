"""Where to hold the sensor next: what is promised of a stop is what its fields determine."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.model.parameters import (
    SENSOR_POSITION,
    choose_blocks,
    initial_calibration,
    linearize_channels,
)
from magfusion.model.site import BeaconSigma, MagnetometerSigma, Site
from magfusion.results.coverage import volume
from magfusion.results.design.motion import (
    ATTITUDES_DEG,
    candidate_poses,
    next_motion,
    prior_information,
)
from magfusion.results.pose_information import SURVEY_GROUPS
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.units import Array

PLACES = volume(DEMO_BOX_WORLD, 1.3)
STOP = 2.0  # s


def loose(site: Site | None = None) -> Site:
    """Return a site that is known to centimetres and degrees."""
    site = demo_site(coil_radius=None) if site is None else site
    sigma = BeaconSigma(np.full(3, 0.02), np.full(3, 0.02), np.full(2, 0.03))
    beacons = tuple(replace(b, sigma=sigma) for b in site.beacons)
    own = MagnetometerSigma(np.full((3, 3), 0.01), np.zeros(3), np.full(3, 0.03), np.full(3, 5e-3))
    sensor = replace(site.platform.magnetometer, sigma=own)
    return replace(
        site, beacons=beacons, platform=replace(site.platform, magnetometer=sensor), model_error=0.0
    )


def ratio(information: Array) -> Array:
    return np.sqrt(np.diag(np.linalg.inv(information)))


def test_a_stop_at_a_known_pose_tells_what_its_phasors_do() -> None:
    site = loose()
    blocks = choose_blocks(site, SURVEY_GROUPS)
    poses = candidate_poses(site, blocks, PLACES[:1], STOP, known=True)
    _, _, by = linearize_channels(
        initial_calibration(site, 0.0), blocks, np.zeros(1), np.eye(3)[None], PLACES[:1]
    )
    noise = site.platform.magnetometer.noise_density / np.sqrt(STOP)  # T
    sigma = np.concatenate([b.sigma for b in blocks])
    expected = (by[0].reshape(-1, len(sigma)) * sigma) / noise
    result = poses.root[0]
    assert ATTITUDES_DEG[poses.attitude[0]] == (0.0, 0.0, 0.0)
    assert np.allclose(result.T @ result, expected.T @ expected, rtol=1e-9, atol=1e-6)


def test_an_open_pose_tells_less_than_a_known_one_and_nothing_of_the_lever_arm() -> None:
    site = loose()
    blocks = choose_blocks(site, SURVEY_GROUPS)
    prior = prior_information(site, blocks)
    whole = {}
    for known in (False, True):
        root = candidate_poses(site, blocks, PLACES, STOP, known=known).root
        whole[known] = ratio(prior + np.sum(np.swapaxes(root, 1, 2) @ root, axis=0))
    assert np.all(whole[True] <= whole[False] * (1.0 + 1e-9))
    (lever,) = (b for b in blocks if b.parameter is SENSOR_POSITION)
    assert np.all(whole[False][lever.columns] > 0.99)
    assert np.all(whole[True][lever.columns] < 0.5)
    assert not np.any(
        next_motion(site, PLACES, 1, STOP, known=False).parameters.requested[lever.columns]
    )


@pytest.mark.parametrize("known", [False, True])
def test_each_stop_is_the_best_of_all_for_what_is_worst(known: bool) -> None:
    site = loose()
    blocks = choose_blocks(site, SURVEY_GROUPS)
    result = next_motion(site, PLACES, 3, STOP, known=known)
    poses = candidate_poses(site, blocks, PLACES, STOP, known=known)
    information = prior_information(site, blocks)
    for stop in result.stops:
        now = ratio(information)
        assert stop.before == pytest.approx(now[stop.worst], rel=1e-9)
        assert stop.worst == result.parameters.worst(now)
        after = [ratio(information + root.T @ root)[stop.worst] for root in poses.root]
        assert stop.after == pytest.approx(min(after), rel=1e-9)
        assert stop.after < stop.before
        best = poses.root[int(np.argmin(after))]
        information = information + best.T @ best
    assert np.allclose(result.ratio, ratio(information), rtol=1e-9, atol=0)


def test_where_everything_is_known_there_is_no_stop() -> None:
    site = loose()
    nothing = BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(2))
    own = MagnetometerSigma(np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3))
    sensor = replace(site.platform.magnetometer, sigma=own)
    known = replace(
        site,
        beacons=tuple(replace(b, sigma=nothing) for b in site.beacons),
        platform=replace(site.platform, magnetometer=sensor),
    )
    assert next_motion(known, PLACES, 3, STOP, known=True).stops == ()


def test_no_stop_is_where_the_fields_err_as_at_another_while_there_is_room() -> None:
    site = replace(loose(), model_error=0.005, model_error_length=0.5)
    result = next_motion(site, PLACES, 6, STOP, known=False)
    places = np.array([stop.position_world for stop in result.stops])
    separate = np.linalg.norm(places[:, None] - places, axis=2) + 10.0 * np.eye(len(places))
    assert np.min(separate) > site.model_error_length
    few = next_motion(site, PLACES[:2], 5, STOP, known=False)
    assert len(few.stops) == 5
