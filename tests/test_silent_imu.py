"""What the magnetometer tells of the motion while the IMU is silent."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.demodulation.motion_compensation import noisier
from magfusion.estimation.demodulation.motion_from_field import motion_from_field
from magfusion.estimation.graph.state import State
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.trajectory import Trajectory
from magfusion.receiver.admission import INERTIAL_GAP, Windows
from magfusion.receiver.lockin import window_operator
from magfusion.receiver.windows import LockinSettings
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log

BEGIN, SPAN = 6.0, 0.4  # s


def simulated(rate_hz: float = 400.0) -> SimulatedLog:
    site = replace(demo_site(coil_radius=None), model_error=1e-4)
    config = SimulationConfig(
        DEMO_BOX_WORLD,
        12.0,
        "turn",
        time_offset=0.0,
        perturb=False,
        magnetometer_rate_hz=rate_hz,
    )
    return simulate_log(site, config, np.random.default_rng(3))


def state_at(simulation: SimulatedLog, time: float) -> State:
    truth = simulation.motion.trajectory(np.array([time]))
    assert truth.velocity_world is not None
    sigma = np.repeat([0.01, 0.01, 0.3, 0.01, 0.01], 3)
    return State(
        time,
        truth.world_from_body[0],
        truth.position_world[0],
        truth.velocity_world[0],
        np.zeros(3),
        np.zeros(3),
        initial_calibration(simulation.true_site, time),
        np.diag(sigma**2),
    )


def stretch(simulation: SimulatedLog) -> Waveform:
    wave = simulation.log.waveform
    assert wave is not None
    inside = (wave.time > BEGIN) & (wave.time < BEGIN + SPAN)
    return Waveform(wave.time[inside], wave.measured_sensor[inside])


def test_the_turn_is_found_without_a_gyro() -> None:
    built = simulated()
    wave = stretch(built)
    result = motion_from_field(state_at(built, BEGIN), wave)
    assert result is not None
    rate = built.motion.rate_body(wave.time)
    assert np.sqrt(np.mean(np.sum(rate**2, axis=1))) > 0.3  # rad/s; there is a turn to be found
    missed = np.sum(result.imu.gyro_body - rate, axis=0) * np.median(np.diff(wave.time))
    assert np.linalg.norm(missed) < 0.02  # rad; over the whole stretch


def without_imu(log: Log, begin: float, end: float) -> Log:
    kept = (log.imu.time < begin) | (log.imu.time > end)
    imu = ImuSamples(log.imu.time[kept], log.imu.gyro_body[kept], log.imu.accel_body[kept])
    return replace(log, imu=imu)


@pytest.mark.slow
def test_a_batch_knows_where_it_is_in_a_gap_of_the_imu() -> None:
    built = simulated(rate_hz=200.0)
    begin, end = 5.0, 7.0
    log = without_imu(built.log, begin, end)
    result = smooth(log, built.true_site, SmootherSettings(tune=False))
    assert INERTIAL_GAP not in result.dropped
    assert result.gap_bridged >= 2.0 / result.fields.window[0]
    assert log.truth is not None
    errors = trajectory_errors(result.states, log.truth)
    assert errors.nees is not None
    inside = (errors.time > begin) & (errors.time < end)
    assert np.sum(inside) == 10  # each window
    assert np.max(np.linalg.norm(errors.position_world[inside], axis=1)) < 0.1  # m
    assert np.max(errors.attitude[inside]) < 0.1  # rad
    assert np.mean(errors.nees[inside]) < 12.0
    assert result.states.pose_cov is not None
    sigma = np.sqrt(np.diagonal(result.states.pose_cov, axis1=1, axis2=2)).max(axis=1)
    known = (result.states.time > begin) & (result.states.time < end)
    assert np.median(sigma[known]) > 2.0 * np.median(sigma[~known])


def test_fields_that_contradict_the_state_are_not_followed() -> None:
    built = simulated()
    wave = stretch(built)
    rng = np.random.default_rng(1)
    noise = 1e-6 * rng.standard_normal(wave.measured_sensor.shape)
    false = replace(wave, measured_sensor=wave.measured_sensor + noise)
    assert motion_from_field(state_at(built, BEGIN), false) is None


def test_accelerations_that_nobody_measured_have_phasor_errors_of_the_claimed_spread() -> None:
    """A hand turns by 1.5 rad/s^2 and moves by 3 m/s^2 about each axis while the IMU is silent.

    A window's ramps follow turn and velocity at its centre, and not what changes them.  Poses have
    six degrees of freedom, so the squared error of all phasors has a mean of six in the claim.
    """
    rng, count, length, rate_hz = np.random.default_rng(8), 150, 0.4, 400.0
    site = demo_site(coil_radius=None)
    # The designs of close tones would take a part of each other's error.
    far_apart = zip(site.beacons, (20.0, 60.0, 100.0, 140.0), strict=True)
    site = replace(site, beacons=tuple(replace(b, frequency_hz=f) for b, f in far_apart))
    calibration, samples = initial_calibration(site, 0.0), round(length * rate_hz)
    number = np.arange(count)
    centre = length * (number + 0.5)
    time = (np.arange(samples * count) + 0.5) / rate_hz
    own = np.repeat(number, samples)
    attitude = Rotation.random(count, random_state=3)
    place = np.array([3.0, 2.5, 1.0]) + rng.uniform(-0.5, 0.5, (count, 3))
    half = 0.5 * (time - centre[own])[:, None] ** 2
    rotated = attitude[own] * Rotation.from_rotvec(half * rng.normal(0.0, 1.5, (count, 3))[own])
    moved = place[own] + half * rng.normal(0.0, 3.0, (count, 3))[own]
    phasor = predict_channels(calibration, time, rotated.as_matrix(), moved)
    tones = np.concatenate([beacon.tone_frequencies_hz for beacon in site.beacons])
    carrier = np.exp(2j * np.pi * tones * time[:, None])
    waveform = Waveform(time, np.sum((carrier[..., None] * phasor).real, axis=1))
    stamps = np.arange(-1.0, time[-1] + 1.0, 0.005)
    still = ImuSamples(stamps, np.zeros((len(stamps), 3)), np.zeros((len(stamps), 3)))
    size = np.full(count, samples)
    windows = Windows(
        number, centre, samples * number, size, np.full(count, length), np.zeros_like(number)
    )
    settings = LockinSettings(length, length, mains_hz=0.0)
    lockin = window_operator(waveform, still, site, settings, windows)
    fields, _ = lockin.demodulate(waveform.measured_sensor)
    exact = replace(fields, phasor_cov=np.zeros_like(fields.phasor_cov))
    states = Trajectory(centre, attitude.as_matrix(), place)
    cov = noisier(exact, np.ones(count, dtype=bool), states, calibration, length).phasor_cov
    error = fields.phasor_sensor - predict_channels(
        calibration, centre, states.world_from_body, place
    )
    parts = np.stack([error.real, error.imag])
    square = np.einsum("qnci,qnci->n", parts, np.linalg.solve(cov, parts[..., None])[..., 0])
    # Of 150 windows: 0.28 is one sigma.
    assert np.mean(square) == pytest.approx(6.0, abs=1.5)
