"""Days of samples: the same whatever the pieces, honest about their noise, true to their site."""

import time
from dataclasses import replace

import numpy as np
import pytest

from magfusion.errors import InputError
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import initial_calibration
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.drift import COPPER_PER_KELVIN, Drift
from magfusion.simulation.endurance import (
    BLOCK,
    EnduranceConfig,
    draw_endurance,
    usual_drift,
)
from magfusion.simulation.inertial import BiasInstability
from magfusion.simulation.motion import Rests

INSTABILITY = BiasInstability(gyro=2e-5, accel=3e-4, time=100.0)


def a_world(hours=1.5, seed=(3, 0), site=None, **changes):
    config = EnduranceConfig(hours, instability=INSTABILITY, **changes)
    return draw_endurance(demo_site(synchronised=False) if site is None else site, config, seed)


def stretches(world, count, blocks):
    """Return so many blocks, made in stretches of a length."""
    biases, out = world.start(), []
    for first in range(0, blocks, count):
        out.append(world.stretch(first, min(count, blocks - first), biases))
        biases = out[-1].after
    return out


def columns(simulation):
    """Return all samples of several stretches."""
    parts = [
        (
            s.imu.time,
            s.imu.gyro_body,
            s.imu.accel_body,
            s.gyro_bias_body,
            s.accel_bias_body,
            s.fields.time,
            s.fields.phasor_sensor,
            s.fields.phasor_cov,
        )
        for s in simulation
    ]
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def test_the_length_of_the_pieces_changes_no_sample():
    world = a_world()
    whole = columns(stretches(world, 12, 12))
    for count in (1, 5):
        for a, b in zip(whole, columns(stretches(world, count, 12)), strict=True):
            assert np.array_equal(a, b)


def test_the_seed_is_the_world():
    again, other = a_world(), a_world(seed=(3, 1))
    first = columns(stretches(a_world(), 2, 2))
    assert all(
        np.array_equal(a, b) for a, b in zip(first, columns(stretches(again, 2, 2)), strict=True)
    )
    assert not np.array_equal(first[1], columns(stretches(other, 2, 2))[1])


def test_fields_come_each_minute_at_rest_and_each_second_about_a_walk():
    built = stretches(a_world(), 10, 70)
    time = np.concatenate([s.fields.time for s in built])
    walking = (time >= 40.0) & (time <= 220.0)
    assert np.sum(walking) == 181
    assert np.all(np.isin(np.arange(0.0, 70 * BLOCK, BLOCK), time))
    assert np.sum((time > 300.0) & (time < 3600.0)) == 54
    second = (time >= 3640.0) & (time <= 3820.0)
    assert np.sum(second) == 181


def test_the_platform_rests_between_walks_and_stays_where_it_is():
    world = a_world()
    rest = world.motion.trajectory(np.array([300.0, 1800.0, 3600.0]))
    assert np.ptp(rest.position_world, axis=0).max() < 1e-9
    walk = world.motion.trajectory(np.array([300.0, 3900.0]))
    assert np.linalg.norm(np.diff(walk.position_world, axis=0)) > 0.05


def test_the_noise_is_what_it_is_said_to_be():
    """Phasors of one rest, moments and clocks still: scatter against the declared sigma."""
    world = a_world(drift=Drift(), site=demo_site(synchronised=True))
    built = stretches(world, 10, 60)
    fields = [s.fields for s in built[1:]]
    phasor = np.concatenate([f.phasor_sensor for f in fields])
    sigma = np.sqrt(np.concatenate([f.phasor_cov for f in fields])[:, 0, 0, 0])
    scaled = (phasor - phasor.mean(axis=0)) / sigma[:, None, None]
    spread = np.mean(np.abs(scaled) ** 2) / 2.0
    count = scaled.size
    assert abs(spread - (1.0 - 1.0 / len(phasor))) < 5.0 / np.sqrt(count)


def test_rest_is_gravity_and_bias_and_white_noise():
    world = a_world()
    built = stretches(world, 1, 8)[-1]
    site = world.true_site
    imu = site.platform.imu
    remaining = built.imu.gyro_body - built.gyro_bias_body
    assert abs(np.std(remaining) / (imu.gyro_noise * 10.0) - 1.0) < 0.03
    force = built.imu.accel_body - built.accel_bias_body
    size = np.linalg.norm(force.mean(axis=0))
    assert abs(size - site.gravity) < 6.0 * imu.accel_noise / np.sqrt(BLOCK)


def test_biases_walk_as_declared_across_the_blocks():
    config = EnduranceConfig(2.0, imu_rate_hz=10.0, schedule=Rests(3600.0, 60.0, 3540.0))
    site = demo_site()
    steps = []
    for seed in range(30):
        world = draw_endurance(site, config, (seed,))
        built = stretches(world, 5, 10)
        first, last = built[0].gyro_bias_body[0], built[-1].gyro_bias_body[-1]
        steps.append(last - first)
    expected = site.platform.imu.gyro_bias_walk * np.sqrt(10 * BLOCK)
    ratio = np.std(steps) / expected
    assert abs(ratio - 1.0) < 3.0 / np.sqrt(2 * 90)


def test_biases_go_on_where_they_were():
    built = columns(stretches(a_world(), 1, 6))
    steps = np.abs(np.diff(built[3], axis=0))
    edges = np.arange(5999, len(steps), 6000)
    assert steps[edges].max() < 6.0 * np.std(np.diff(built[3], axis=0))


@pytest.mark.parametrize(
    ("drive", "loss"), [("current", 20.0 * 1e-4), ("voltage", 20.0 * COPPER_PER_KELVIN)]
)
def test_heat_takes_from_the_moments_what_the_drive_lets_it(drive, loss):
    drift = replace(usual_drift(drive, 0.0), gain=None)
    world = a_world(hours=12.0, drift=drift)
    warm = np.exp(-world.log_gain[-1]) - 1.0
    assert np.allclose(warm, loss * -np.expm1(-12.0 / 1.5), rtol=1e-6, atol=0.0)


def test_free_clocks_part_each_at_its_own_rate_and_a_common_one_for_all():
    free_parameters = a_world(hours=6.0)
    rates = free_parameters.phase[-1] - free_parameters.phase[0]
    assert np.all(np.abs(rates) > 1.0)
    tones = np.array([b.frequency_hz for b in free_parameters.site.beacons])
    assert np.ptp(rates / tones) > 1e-3
    common = a_world(
        hours=6.0, site=demo_site(synchronised=True), drift=usual_drift("current", 1e-8)
    )
    lead = common.phase[-1] / (2.0 * np.pi * tones)
    assert np.ptp(lead) < 1e-12
    assert abs(lead[0] - 1e-8 * 6.0 * 3600.0) < 5.0 * 1e-9 * np.sqrt(6.0 * 3600.0)


def test_its_fields_lead_a_fix_to_the_truth():
    site = demo_site(synchronised=True)
    world = a_world(site=site)
    fields = stretches(world, 2, 2)[0].fields
    result = fix_epochs(fields, initial_calibration(site, 0.0)).best()
    truth = world.motion.trajectory(fields.time)
    off = np.linalg.norm(result.position_world - truth.position_world, axis=1)
    assert np.median(off) < 0.01


def test_two_days_are_made_fast():
    """Two days must take less than a minute of an idle core."""
    world = a_world(hours=2.0)
    biases = world.start()
    began = time.process_time()
    for first in range(0, 120, 10):
        built = world.stretch(first, 10, biases)
        biases = built.after
    assert 24.0 * (time.process_time() - began) < 60.0


@pytest.mark.parametrize(
    ("hours", "changes"), [(0.0, {}), (2e3, {}), (1.0, {"rest_interval": 45.0})]
)
def test_what_cannot_be_simulated_is_refused(hours, changes):
    with pytest.raises(InputError, match="found"):
        EnduranceConfig(hours, **changes)
