"""Drawn calibrations and whole simulated logs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from magfusion.errors import InputError
from magfusion.model.physics.earth import earth_field_world
from magfusion.model.site import Location
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import (
    SimulationConfig,
    draw_drives,
    perturb_site,
    simulate_log,
)
from magfusion.simulation.waveform import Mains


def chi2_bounds(degrees, miss=1e-4):
    return chi2.ppf([miss / 2.0, 1.0 - miss / 2.0], degrees)


def with_uneven_priors(site):
    """Sigmas that differ from axis to axis, so that axes taken for others show."""
    uneven = np.array([1e-3, 1e-2, 1e-1])
    beacons = tuple(
        replace(b, sigma=replace(b.sigma, position_world=uneven, rotation_beacon=uneven))
        for b in site.beacons
    )
    magnetometer = site.platform.magnetometer
    sigma = replace(magnetometer.sigma, rotation_sensor=uneven, position_body=uneven)
    platform = replace(site.platform, magnetometer=replace(magnetometer, sigma=sigma))
    return replace(site, beacons=beacons, platform=platform)


def test_drawn_calibrations_have_the_statistics_that_the_site_declares():
    site = with_uneven_priors(demo_site())
    rng = np.random.default_rng(13)
    draws = [perturb_site(site, rng) for _ in range(200)]
    magnetometer = site.platform.magnetometer
    scaled = {name: [] for name in ("position", "rotation", "moment", "matrix", "offset", "mount")}
    for draw in draws:
        for true, reported in zip(draw.beacons, site.beacons, strict=True):
            turn_beacon = Rotation.from_matrix(
                reported.world_from_beacon.T @ true.world_from_beacon
            )
            moved = true.position_world - reported.position_world
            scaled["position"].append(moved / reported.sigma.position_world)
            scaled["rotation"].append(turn_beacon.as_rotvec() / reported.sigma.rotation_beacon)
            gain = np.linalg.norm(true.moments_beacon, axis=1) / 220.0
            scaled["moment"].append(np.log(gain) / reported.sigma.log_moment)
        true_one, sigma = draw.platform.magnetometer, magnetometer.sigma
        turn_sensor = Rotation.from_matrix(
            magnetometer.body_from_sensor.T @ true_one.body_from_sensor
        )
        scaled["matrix"].append(((true_one.matrix - magnetometer.matrix) / sigma.matrix).ravel())
        scaled["offset"].append((true_one.offset - magnetometer.offset) / sigma.offset)
        lever = (true_one.position_body - magnetometer.position_body) / sigma.position_body
        scaled["mount"].append(np.append(turn_sensor.as_rotvec() / sigma.rotation_sensor, lever))
    for name, values in scaled.items():
        low, high = chi2_bounds(np.size(values))
        assert low < np.sum(np.square(values)) < high, name


def test_only_beacons_without_synchronisation_drift():
    site = demo_site(synchronised=False)
    rng = np.random.default_rng(14)
    draws = [draw_drives(site, rng) for _ in range(200)]
    low, high = chi2_bounds(800)
    assert low < sum(np.sum((d.drift / site.clock.drift_sigma) ** 2) for d in draws) < high
    phases = np.array([d.phase for d in draws])
    assert abs(np.mean(np.exp(1j * phases))) < 0.15  # 4 sigma of 800 even phases
    reported = draw_drives(demo_site(), rng)
    assert not reported.phase.any()
    assert not reported.drift.any()


def test_a_log_is_reproducible_from_its_seed():
    config = SimulationConfig(DEMO_BOX_WORLD, duration=3.0, mains=Mains(1e-8))
    first, same, other = (
        simulate_log(demo_site(), config, np.random.default_rng(seed)).log for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.imu.gyro_body, same.imu.gyro_body)
    np.testing.assert_array_equal(first.waveform.measured_sensor, same.waveform.measured_sensor)
    assert not np.array_equal(first.imu.gyro_body, other.imu.gyro_body)


def test_the_motion_does_not_depend_on_the_instruments_rates():
    config = SimulationConfig(DEMO_BOX_WORLD, duration=10.0)
    faster = replace(config, imu_rate_hz=400.0, magnetometer_rate_hz=500.0, perturb=False)
    slow, fast = (
        simulate_log(demo_site(), c, np.random.default_rng(1)).log.truth for c in (config, faster)
    )
    np.testing.assert_allclose(slow.position_world, fast.position_world[::2], atol=1e-12)


@pytest.mark.parametrize("kind", ["walk", "turn", "static"])
def test_a_log_is_true_to_its_truth(kind):
    config = SimulationConfig(
        DEMO_BOX_WORLD, duration=12.0, motion=kind, noise_scale=0.0, time_offset=-0.004
    )
    run = simulate_log(demo_site(), config, np.random.default_rng(15))
    imu, truth = run.log.imu, run.log.truth
    assert run.time_offset == -0.004
    assert len(imu) == 2400
    assert len(run.log.waveform) == 4800
    selected = imu.time + run.time_offset
    exact = run.motion.rate_body(selected)
    late = [np.interp(selected, truth.time, b) for b in truth.gyro_bias_body.T]
    inside = slice(1, None)
    # The bias walks 1e-5 rad/s per root second: 7e-7 from sample to sample.
    np.testing.assert_allclose(
        (imu.gyro_body - exact)[inside], np.transpose(late)[inside], atol=5e-6
    )
    np.testing.assert_array_equal(truth.position_world, run.motion.position_world(truth.time))


def test_without_perturbation_the_true_calibration_is_the_declared():
    config = SimulationConfig(DEMO_BOX_WORLD, duration=1.0, perturb=False, noise_scale=2.0)
    site = demo_site()
    true_site = simulate_log(site, config, np.random.default_rng(1)).true_site
    assert true_site.beacons == site.beacons
    assert true_site.platform.magnetometer.noise_density == 5e-10
    assert true_site.platform.imu.gyro_noise == 2.0 * site.platform.imu.gyro_noise


def test_a_site_with_a_location_has_the_earth_field_of_the_igrf():
    place = Location(48.0, 11.0, 500.0, "2024-05-06")
    site = replace(demo_site(), earth_field_world=None, location=place)
    config = SimulationConfig(DEMO_BOX_WORLD, duration=1.0)
    run = simulate_log(site, config, np.random.default_rng(1))
    from_place = earth_field_world(48.0, 11.0, 500.0, np.datetime64("2024-05-06").item())
    np.testing.assert_array_equal(run.true_site.earth_field_world, from_place)


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"magnetometer_rate_hz": 80.0}, "magnetometer_rate_hz"),
        ({"imu_rate_hz": 0.0}, "imu_rate_hz"),
        ({"duration": -1.0}, "duration"),
        ({"motion": "dance"}, "motion"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused_by_name(changes, place):
    config = replace(SimulationConfig(DEMO_BOX_WORLD, duration=2.0), **changes)
    with pytest.raises(InputError, match=place):
        simulate_log(demo_site(), config, np.random.default_rng(1))


def test_coils_in_time_slots_are_refused_for_a_waveform():
    site = demo_site()
    first = site.beacons[0]
    slotted = replace(first, coils=tuple(replace(c, slot=i) for i, c in enumerate(first.coils)))
    site = replace(site, beacons=(slotted, *site.beacons[1:]))
    with pytest.raises(InputError, match=r"beacons\.A"):
        simulate_log(site, SimulationConfig(DEMO_BOX_WORLD, duration=1.0), np.random.default_rng(1))
