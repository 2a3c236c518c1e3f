"""Slow drift: heat follows its law, wander stays bounded, a clock's lead walks without bound."""

from dataclasses import replace

import numpy as np
import pytest
from paper_rooms import ROOM, S0, draw_world
from scipy.spatial.transform import Rotation

from magfusion.simulation.drift import (
    COPPER_PER_KELVIN,
    DailySwing,
    Drift,
    DriveClock,
    Wander,
    WarmUp,
    draw_drift,
)
from magfusion.simulation.field import Drives, phasors_world
from magfusion.simulation.motion import static_motion
from magfusion.simulation.waveform import simulate_waveform
from magfusion.units import DAY

MINUTES = 60.0 * np.arange(1, 2881)  # two days
PATHS = 4000
TONES_HZ = np.array(ROOM.frequencies_hz)


def _rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_a_warming_body_obeys_newtons_law() -> None:
    body, time = WarmUp(20.0, 5400.0), np.linspace(0.0, 40_000.0, 4001)
    temperature = body.temperature(time)
    rate = np.gradient(temperature, time, edge_order=2)
    np.testing.assert_allclose(rate, (20.0 - temperature) / 5400.0, rtol=1e-5, atol=0)
    assert temperature[0] == 0.0
    assert body.temperature(np.array([np.inf])) == 20.0


def test_the_day_repeats_and_is_warmest_when_said() -> None:
    swing = DailySwing(4.0, warmest_time=50_000.0)
    first, second = np.split(swing.temperature(MINUTES), 2)
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-10)  # K
    assert abs(MINUTES[np.argmax(first)] - 50_000.0) <= 30.0
    assert np.ptp(first) == pytest.approx(8.0, abs=1e-4)


def test_wander_is_stationary_with_an_exponential_correlation() -> None:
    time = np.array([0.0, 10.0, 700.0, 3600.0, 4000.0, 50_000.0])  # s, uneven
    path = Wander(0.003, 3600.0).draw(time, PATHS, _rng())
    result = path @ path.T / PATHS
    expected = 0.003**2 * np.exp(-np.abs(time[:, None] - time) / 3600.0)
    # Of the mean of 4000 products of two Gaussians: at most sqrt(2 / 4000) = 2.2 %.
    np.testing.assert_allclose(result, expected, rtol=0, atol=4 * 0.0224 * 0.003**2)


def test_wander_is_the_same_process_at_any_spacing() -> None:
    wander = Wander(1.0, 600.0)
    fine = wander.draw(np.arange(0.0, 121.0), PATHS, _rng())[[0, -1]]
    coarse = wander.draw(np.array([0.0, 120.0]), PATHS, np.random.default_rng(6))
    for moment in (np.var, lambda p: np.mean(p[0] * p[1])):
        assert moment(fine) == pytest.approx(moment(coarse), abs=0.1)


def test_a_fast_clock_leads_in_proportion_and_a_walking_one_by_the_root_of_time() -> None:
    np.testing.assert_allclose(
        DriveClock(rate=1e-8).lead(MINUTES, _rng()), 1e-8 * MINUTES, rtol=1e-12
    )
    rng, walking = _rng(), DriveClock(walk=1e-9)
    leads = np.array([walking.lead(MINUTES, rng) for _ in range(PATHS)])
    spread = np.sqrt(np.mean(leads**2, axis=0))
    np.testing.assert_allclose(spread, 1e-9 * np.sqrt(MINUTES), rtol=0.06)  # 5 sigma of 1.1 %
    early, late = leads[:, 719], leads[:, -1] - leads[:, 719]
    assert abs(np.corrcoef(early, late)[0, 1]) < 0.06  # what comes does not know what was


def test_a_clock_refuses_times_before_the_epoch() -> None:
    with pytest.raises(ValueError, match="epoch"):
        DriveClock().lead(np.array([-1.0, 2.0]), _rng())


def test_the_phase_of_a_fast_clock_is_that_of_the_simulated_waveform() -> None:
    site, rate = draw_world(S0, _rng()).site, 1e-3
    magnetometer = replace(site.platform.magnetometer, noise_density=0.0)
    quiet = replace(site, platform=replace(site.platform, magnetometer=magnetometer))
    place, drives = np.array([2.0, 1.0, 0.5]), Drives(np.zeros(3), np.full(3, rate))
    motion = static_motion(place, Rotation.identity())
    wave = simulate_waveform(motion, quiet, drives, 200.0, 20.0, _rng())
    phase = draw_drift(Drift(clock=DriveClock(rate=rate)), wave.time, 3, _rng()).phase(TONES_HZ)
    carrier = np.exp(1j * (2.0 * np.pi * TONES_HZ * wave.time[:, None] + phase))
    fields = np.concatenate([phasors_world(b, place[None])[0] for b in site.beacons])
    earth = 0.0 if site.earth_field_world is None else site.earth_field_world
    expected = np.real(carrier @ fields) + earth
    np.testing.assert_allclose(wave.measured_sensor, expected, rtol=0, atol=1e-16)  # T


def test_a_voltage_loses_the_moment_that_copper_says() -> None:
    drift = Drift(coils=WarmUp(20.0, 5400.0), fading_per_kelvin=COPPER_PER_KELVIN)
    gain = np.exp(draw_drift(drift, MINUTES, 2, _rng()).log_gain)
    # Ohm: the current of a voltage goes with 1 / R.
    assert gain[-1] == pytest.approx([1.0 / 1.078] * 2, rel=1e-6)
    assert np.all(np.diff(gain[:1000], axis=0) < 0.0)


def test_the_scale_follows_the_sensors_temperature() -> None:
    swing = DailySwing(4.0, DAY / 2.0)
    drawn = draw_drift(Drift(sensor=swing, scale_per_kelvin=5e-5), MINUTES, 1, _rng())
    expected = 1.0 + 5e-5 * swing.temperature(MINUTES)
    np.testing.assert_allclose(drawn.sensor_scale, expected, rtol=1e-12)
    assert np.max(drawn.sensor_scale) == pytest.approx(1.0002, abs=1e-9)


def test_what_is_not_named_does_not_drift() -> None:
    still = draw_drift(Drift(), MINUTES, 3, _rng())
    assert not np.any(still.log_gain)
    assert not np.any(still.phase(np.array([20.0, 30.0])))
    np.testing.assert_array_equal(still.sensor_scale, 1.0)


def test_draws_repeat_and_a_clock_leaves_the_gains_alone() -> None:
    gain = Wander(0.003, 14_400.0)
    one = draw_drift(Drift(gain=gain, clock=DriveClock(1e-8, 1e-9)), MINUTES, 3, _rng())
    again = draw_drift(Drift(gain=gain, clock=DriveClock(1e-8, 1e-9)), MINUTES, 3, _rng())
    without = draw_drift(Drift(gain=gain), MINUTES, 3, _rng())
    np.testing.assert_array_equal(one.log_gain, again.log_gain)
    np.testing.assert_array_equal(one.lead, again.lead)
    np.testing.assert_array_equal(one.log_gain, without.log_gain)
    other = draw_drift(Drift(gain=gain), MINUTES, 3, np.random.default_rng(6))
    assert np.all(other.log_gain != one.log_gain)
    assert np.max(np.abs(np.corrcoef(one.log_gain.T) - np.eye(3))) < 0.9
