"""Joined steps of a long interval against GTSAM's own integration of every single one."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from magfusion.estimation.batch.batch import Smoothed, smooth
from magfusion.estimation.graph import imu_decimation as thinning
from magfusion.estimation.graph.imu_decimation import (
    JOINED,
    MAX_TURN,
    MIN_JOINED_STEPS,
    preintegrate_stream,
    thinned,
)
from magfusion.estimation.graph.preintegration import Increments, cut_at_epochs, preintegrate
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import ImuModel
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import simulate_fields
from magfusion.simulation.motion import Rests, turning_motion

GRAVITY = 9.81
MEMS = ImuModel(3e-4, 3e-3, 1e-5, 1e-4, 5e-3, 0.05)
ACCEL_BIAS, GYRO_BIAS = np.array([0.1, 0.2, -0.3]), np.array([0.01, -0.02, 0.03])
BOX_WORLD = np.array([[1.2, 1.2, 0.6], [4.8, 3.8, 1.6]])
EPOCHS = np.array([1.0033, 25.0, 29.502, 31.503, 79.9981])  # s; mostly between samples
BY = (25, 20, 10, 25)  # steps joined in the intervals
MIN_COUNT = MIN_JOINED_STEPS * min(JOINED)  # steps of an interval that is thinned
LONG_EPOCHS = np.arange(0.505, 119.0, 30.0)


def recorded(rate_rms: float, duration: float = 80.0) -> ImuSamples:
    """Return a vibrating, biased and noisy stream at 100 Hz."""
    rng = np.random.default_rng(1)
    rests = Rests(start=0.0, move=duration, pause=0.0)
    motion = turning_motion(rng, duration, BOX_WORLD, rate_rms=rate_rms, rests=rests)
    imu = simulate_imu(motion, MEMS, GRAVITY, 100.0, duration, rng).samples
    shaking = 3.0 * np.sin(80.0 * imu.time[:, None] + np.arange(3.0))
    return ImuSamples(imu.time, imu.gyro_body + GYRO_BIAS, imu.accel_body + ACCEL_BIAS + shaking)


def at(bias: np.ndarray, epochs: np.ndarray = EPOCHS) -> np.ndarray:
    return np.broadcast_to(bias, (len(epochs), 3))


def _turn(one: gtsam.Rot3, other: gtsam.Rot3) -> np.ndarray:
    return np.asarray(gtsam.Rot3.Logmap(one.between(other)))


def both(
    increments: Increments, accel: np.ndarray = ACCEL_BIAS, gyro: np.ndarray = GYRO_BIAS
) -> tuple[list, list]:
    """Return the preintegrated intervals of joined and of single steps."""
    joined = thinned(increments, at(accel), at(gyro))
    return (
        preintegrate(joined, MEMS, GRAVITY, at(accel), at(gyro)),
        preintegrate(increments, MEMS, GRAVITY, at(accel), at(gyro)),
    )


@pytest.mark.parametrize("rate_rms", [0.05, 1.0])
def test_joined_steps_integrate_to_what_the_single_ones_do(rate_rms):
    increments = cut_at_epochs(recorded(rate_rms), 0.0, EPOCHS)
    steps = np.diff(thinned(increments, at(ACCEL_BIAS), at(GYRO_BIAS)).first)
    assert np.all(steps < np.diff(increments.first) / 8.0)
    for joined, single in zip(*both(increments), strict=True):
        assert np.linalg.norm(_turn(joined.deltaRij(), single.deltaRij())) < 1e-12  # rad
        assert np.max(np.abs(joined.deltaVij() - single.deltaVij())) < 1e-10  # m/s
        assert np.max(np.abs(joined.deltaPij() - single.deltaPij())) < 1e-8  # m, of kilometres
        assert abs(joined.deltaTij() - single.deltaTij()) < 1e-11  # s


def test_a_first_order_mean_of_the_steps_would_not_do():
    # What the joining is for: the plain mean of ten samples forgets how they turn and when.
    increments = cut_at_epochs(recorded(1.0), 0.0, np.array([1.0, 55.0]))
    tens = len(increments.dt) // 10
    gyro, accel = (
        stream[: tens * 10].reshape(tens, 10, 3).mean(axis=1)
        for stream in (increments.gyro_body, increments.accel_body)
    )
    dt = increments.dt[: tens * 10].reshape(tens, 10).sum(axis=1)
    rows = np.array([0, tens * 10])
    plain = Increments(gyro, accel, dt, np.array([0, tens]), increments.gap_bridged)
    single = replace(increments, first=rows)
    zero = np.zeros((2, 3))
    (mean,), (whole,) = (preintegrate(i, MEMS, GRAVITY, zero, zero) for i in (plain, single))
    assert np.max(np.abs(mean.deltaPij() - whole.deltaPij())) > 1e-3  # m


def test_the_noise_of_joined_steps_is_that_of_the_single_ones():
    joined, single = both(cut_at_epochs(recorded(1.0), 0.0, EPOCHS))
    for after, before, steps in zip(joined, single, BY, strict=True):
        share = steps * 0.01 / before.deltaTij()
        root = np.linalg.inv(np.linalg.cholesky(before.preintMeasCov()))
        whitened = root @ after.preintMeasCov() @ root.T
        # Of a variance, in its worst direction: twice that of a sigma.
        assert np.max(np.abs(np.linalg.eigvalsh(whitened) - 1.0)) < 2.0 * share


def test_a_change_of_bias_moves_joined_steps_as_the_single_ones():
    increments = cut_at_epochs(recorded(1.0), 0.0, EPOCHS)
    joined, single = both(increments)
    rate = np.linalg.norm(increments.gyro_body - GYRO_BIAS, axis=1)
    steps = np.array(BY) * 0.01
    turn = np.minimum(np.max(rate) * steps, MAX_TURN)
    tolerances = turn**2 / 12.0  # of the series in the turn of a step
    other = gtsam.imuBias.ConstantBias(ACCEL_BIAS + 1e-3, GYRO_BIAS - 1e-4)
    still = gtsam.NavState(gtsam.Rot3(), np.zeros(3), np.zeros(3))
    for after, before, tolerance in zip(joined, single, tolerances, strict=True):
        moved, expected = after.predict(still, other), before.predict(still, other)
        kept = before.predict(still, before.biasHat())
        change = np.linalg.norm(expected.position() - kept.position())
        assert change > 1e-3  # m: there is something to be right about
        assert np.linalg.norm(moved.position() - expected.position()) < tolerance * change
        rotated = np.linalg.norm(_turn(moved.attitude(), expected.attitude()))
        assert rotated < tolerance * np.linalg.norm(_turn(kept.attitude(), expected.attitude()))


def test_short_intervals_gaps_and_fast_turns_keep_their_single_steps():
    imu = recorded(1.0)
    short = cut_at_epochs(imu, 0.0, np.arange(1.0, 59.0, 0.009 * MIN_COUNT))
    zero = np.zeros((len(short.first), 3))
    assert thinned(short, zero, zero) is short
    gap = (imu.time > 40.0) & (imu.time < 40.5)
    holed = ImuSamples(imu.time[~gap], imu.gyro_body[~gap], imu.accel_body[~gap])
    increments = cut_at_epochs(holed, 0.0, EPOCHS)
    assert list(increments.gap_bridged) == [False, False, False, True]
    single = np.diff(increments.first)
    steps = np.diff(thinned(increments, at(ACCEL_BIAS), at(GYRO_BIAS)).first)
    assert np.all(steps[:3] < single[:3] / 5)
    assert steps[3] == single[3]
    imu = recorded(0.05)
    spinning = imu.gyro_body + np.where((imu.time > 5.0) & (imu.time < 10.0), 8.0, 0.0)[:, None]
    increments = cut_at_epochs(ImuSamples(imu.time, spinning, imu.accel_body), 0.0, EPOCHS)
    kept = thinned(increments, at(ACCEL_BIAS), at(GYRO_BIAS)).dt
    fast = np.sum(kept < 0.011)
    # 5 s, what is left at the ends, and a pair begun before or ended after.
    assert 480 < fast < 500 + 3 * 2 * max(JOINED)


@pytest.mark.parametrize("offset", [0.0, 0.0137])
def test_stretches_of_a_stream_are_preintegrated_as_the_whole(monkeypatch, offset):
    imu = recorded(0.5, 120.0)
    gap = (imu.time > 45.0) & (imu.time < 46.0)
    imu = ImuSamples(imu.time[~gap], imu.gyro_body[~gap], imu.accel_body[~gap])
    epochs = np.sort(np.concatenate([LONG_EPOCHS, [3.0, 3.1, 100.0]]))
    bias = at(ACCEL_BIAS, epochs), at(GYRO_BIAS, epochs)
    whole, gap_bridged = preintegrate_stream(imu, offset, epochs, MEMS, GRAVITY, *bias)
    monkeypatch.setattr(thinning, "STRETCH", 1000)
    parts, bridged_parts = preintegrate_stream(imu, offset, epochs, MEMS, GRAVITY, *bias)
    assert len(whole) == len(parts) == len(epochs) - 1
    assert np.sum(gap_bridged) == 1
    assert np.array_equal(gap_bridged, bridged_parts)
    for one, other in zip(whole, parts, strict=True):
        assert one.equals(other, 1e-9)


def resting_log(seed: int) -> tuple[Log, object]:
    """Return six minutes at rest with a field epoch every 40 s."""
    site, rng = demo_site(coil_radius=None), np.random.default_rng(seed)
    noise, number = site.platform.imu, 36_000
    time = np.arange(number) / 100.0
    gyro = GYRO_BIAS / 10.0 + 10.0 * noise.gyro_noise * rng.standard_normal((number, 3))
    accel = 10.0 * noise.accel_noise * rng.standard_normal((number, 3))
    accel += np.array([0.02, -0.01, site.gravity])
    epochs = np.arange(20.0, 355.0, 40.0)
    is_stationary = (
        np.tile(np.eye(3), (len(epochs), 1, 1)),
        np.tile([2.0, 1.5, 1.0], (len(epochs), 1)),
    )
    fields = simulate_fields(site, Trajectory(epochs, *is_stationary), 2e-10, rng)
    return Log("rest", 0, "sim", ImuSamples(time, gyro, accel), None, fields, None), site


@pytest.mark.slow
def test_a_log_is_smoothed_alike_from_joined_and_from_single_steps(monkeypatch):
    log, site = resting_log(2)
    joined = smooth(log, site)
    monkeypatch.setattr(thinning, "thinned", lambda increments, *_: increments)
    single = smooth(log, site)
    assert_alike(joined, single)


def assert_alike(result: Smoothed, expected: Smoothed) -> None:
    assert result.converged
    assert expected.converged
    sigma, other = (
        np.sqrt(np.diagonal(s.states.pose_cov, axis1=1, axis2=2)) for s in (result, expected)
    )
    assert np.max(np.abs(other / sigma - 1.0)) < 1e-4
    moved = np.abs(result.states.position_world - expected.states.position_world)
    assert np.max(moved / sigma[:, 3:]) < 1e-3
    rotated = result.states.world_from_body - expected.states.world_from_body
    assert np.max(np.abs(rotated)) < 1e-3 * np.min(sigma[:, :3])
    assert abs(result.cost / expected.cost - 1.0) < 1e-4
