"""Relative poses: derivatives, intervals that lack samples, honest covariances, files."""

from collections import Counter
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from aiding_site import LEVER, TURN, aided_site
from derivatives import central_difference, relative_to_group
from nees import average_nees_bounds
from online_log import SIGMA, surveyed_site
from scipy.spatial.transform import Rotation

import magfusion as mf
from magfusion.errors import InputError
from magfusion.estimation.batch.settings import SmootherSettings
from magfusion.estimation.graph.measurement import measured_rows
from magfusion.estimation.graph.propagation import propagate
from magfusion.estimation.graph.state import MOTION, State, moved, states_of
from magfusion.estimation.measurements.aiding_samples import aiding_measurement
from magfusion.estimation.measurements.relative_pose import RelativePose
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.estimation.online_integrity.aiding_gate import AidingGate
from magfusion.files.aiding_messages import SensorMessages
from magfusion.files.log import read_log, write_log
from magfusion.files.record_samples import aiding_samples
from magfusion.files.records import Record
from magfusion.files.stream_contents import aiding_content
from magfusion.model.aiding import AidingSamples, AidingSensor, AidingSigma
from magfusion.model.parameters import choose_blocks, dimension, initial_calibration, prior_sigma
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.simulation.aiding import simulate_aiding
from magfusion.simulation.demo_site import DEMO_BOX_WORLD
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import EPOCH_NS, perturb_site, simulate_fields
from magfusion.simulation.motion import Rests, SimulatedMotion, random_walk_motion
from magfusion.units import DEGREE, Array

KEYFRAMES = AidingSensor(
    "keyframes",
    "relative_pose",
    0.005,
    relative_sigma=0.01,
    rotation_sigma=0.2 * DEGREE,
    rate_hz=2.0,
    position_body=LEVER,
    body_from_sensor=TURN,
    sigmas=AidingSigma(
        position_body=np.full(3, 0.01),
        rotation_sensor=np.full(3, 0.5 * DEGREE),
        scale=np.array(0.02),
        time_offset=np.array(0.005),
    ),
)
SITE = aided_site(KEYFRAMES)
BLOCKS = choose_blocks(SITE, ("aiding",))
BIAS = np.array([0.02, -0.01, 0.03, 0.002, 0.001, -0.003])
ALWAYS = Rests(0.0, 60.0, 0.0)


def _motion(seed: int = 5, duration: float = 30.0) -> SimulatedMotion:
    return random_walk_motion(np.random.default_rng(seed), duration, DEMO_BOX_WORLD, rests=ALWAYS)


def _state(motion: SimulatedMotion, time: float, site: Site = SITE) -> State:
    there = motion.trajectory(np.array([time]))
    assert there.velocity_world is not None
    return State(
        time,
        there.world_from_body[0],
        there.position_world[0],
        there.velocity_world[0],
        BIAS[:3],
        BIAS[3:],
        initial_calibration(site, 0.0),
        np.eye(MOTION + dimension(BLOCKS)),
    )


def _imu(motion: SimulatedMotion, begin: float, end: float, step: float = 0.005) -> ImuSamples:
    """Return samples without noise, with a constant bias."""
    time = np.arange(begin, end, step)
    force = motion.specific_force_body(time, SITE.gravity) + BIAS[:3]
    return ImuSamples(time, motion.rate_body(time) + BIAS[3:], force)


def _measured(end: float, interval: float, imu: ImuSamples, bias: Array = BIAS) -> RelativePose:
    sensor = replace(KEYFRAMES, sigma=1e-6, relative_sigma=0.0, rotation_sigma=1e-6)
    sensor = replace(sensor, rate_hz=1.0 / interval)
    ideal = replace(SITE, aiding=(sensor,))
    record = simulate_aiding(_motion(), ideal, end + 1.0, np.random.default_rng(0))["keyframes"]
    samples = record.rows(np.abs(record.time - end) < 1e-6)
    measured = aiding_measurement(KEYFRAMES, samples)
    assert isinstance(measured, RelativePose)
    return measured.over_interval(imu, 0.0, np.array([end]), bias[None], SITE)


def test_the_derivatives_hold_at_a_large_residual_and_at_another_bias() -> None:
    motion = _motion()
    imu = _imu(motion, 9.0, 13.0)
    measured = _measured(12.0, 0.5, imu, np.add(BIAS, [0.05, 0.02, -0.04, 0.01, -0.02, 0.015]))
    turned = Rotation.from_rotvec([[0.4, -0.3, 0.5]]).as_matrix()
    measured = replace(measured, rotation_measured=measured.rotation_measured @ turned)
    measured = measured.with_inertial(np.array([[0.1, 0.2, -0.1, 0.0, 0.0, 9.8]]))
    state = _state(motion, 12.0)
    _, jacobian = measured_rows([measured], state, BLOCKS)

    def error(step: Array) -> Array:
        return measured_rows([measured], moved(state, BLOCKS, step), BLOCKS)[0]

    expected = central_difference(error, len(state.cov), 1e-6)
    assert relative_to_group(jacobian, expected) < 1e-5


@pytest.mark.parametrize("interval", [0.1, 0.5, 2.0])
def test_another_bias_gives_what_integration_at_it_gives(interval: float) -> None:
    """To first order: half the change leaves a quarter of the difference."""
    motion, differences = _motion(), []
    imu, state = _imu(motion, 9.0, 13.0), _state(motion, 12.0)
    at = states_of([state]), state.calibration, ()
    here = _measured(12.0, interval, imu).linearize(*at).error
    for share in (1.0, 0.5):
        change = share * np.array([0.05, -0.05, 0.05, 0.005, -0.005, 0.005])
        away = _measured(12.0, interval, imu, BIAS + change)
        differences.append(np.abs(away.linearize(*at).error - here)[0, 0])
        # A specific force of 10 m/s^2, turned by as much as the bias turns the body.
        assert np.max(differences[-1][:3] * away.sigma[0, :3]) < 20.0 * (0.009 * interval) ** 2
    assert np.max(differences[1]) < 0.27 * np.max(differences[0])


def test_an_interval_without_all_its_samples_is_not_measured() -> None:
    motion = _motion()
    whole = _imu(motion, 9.0, 13.0)
    gap = (whole.time < 11.3) | (whole.time > 11.6)
    holed = ImuSamples(whole.time[gap], whole.gyro_body[gap], whole.accel_body[gap])
    assert np.all(np.isfinite(_measured(12.0, 1.0, whole).sigma))
    lacking = [
        _measured(12.0, 1.0, holed),
        _measured(12.0, 1.0, _imu(motion, 11.2, 13.0)),  # begins within it
        _measured(12.0, 1.0, _imu(motion, 9.0, 11.8)),  # ends within it
        _measured(12.0, 1.0, ImuSamples.empty()),
    ]
    long = _measured(12.0, 2.0, whole)
    long = replace(long, interval=np.array([2.1])).over_interval(
        whole, 0.0, np.array([12.0]), BIAS[None], SITE
    )
    gate = AidingGate(SITE, BLOCKS, Counter())
    for one in (*lacking, long):
        assert np.all(np.isinf(one.sigma))
        assert gate.passed([one], _state(motion, 12.0)) == []
    assert gate.counts == {"interval of keyframes without inertial samples": 5}
    assert not gate.rejected_since


def _start(rng: np.random.Generator, motion: SimulatedMotion, site: Site, bias: Array) -> State:
    """Return a state at 1 s whose errors are drawn of its covariance."""
    sigma = np.concatenate([np.repeat([0.01, 0.02, 0.05, 0.02, 0.002], 3), prior_sigma(BLOCKS)])
    state = _state(motion, 1.0, site)
    state = replace(state, accel_bias_body=bias[:3], gyro_bias_body=bias[3:], cov=np.diag(sigma**2))
    step = np.zeros(len(sigma))
    step[:MOTION] = sigma[:MOTION] * rng.standard_normal(MOTION)
    return moved(state, BLOCKS, step)


def _pose_nees(
    motion: SimulatedMotion, time: float, pose: tuple[Array, Array], cov: Array
) -> float:
    turn, position = pose
    true = motion.trajectory(np.array([time]))
    rotation = Rotation.from_matrix(turn.T @ true.world_from_body[0]).as_rotvec()
    error = np.concatenate([rotation, turn.T @ (true.position_world[0] - position)])
    return float(error @ np.linalg.solve(cov, error))


@pytest.mark.parametrize("noisier", [1.0, 10.0])
def test_the_covariance_of_the_filter_is_honest(noisier: float) -> None:
    """Eleven relative poses lead an IMU through 5 s.

    Its noise is in the measurement and in the prediction of the state, as if it were two: where it
    exceeds that of the sensor, the covariance is too wide.
    """
    runs, nees, narrower = 40, [], []
    imu = replace(
        SITE.platform.imu,
        accel_noise=noisier * SITE.platform.imu.accel_noise,
        gyro_noise=noisier * SITE.platform.imu.gyro_noise,
    )
    site = replace(SITE, platform=replace(SITE.platform, imu=imu))
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        motion, true = _motion(seed + 100, 8.0), perturb_site(site, rng)
        sampled = simulate_imu(motion, imu, site.gravity, 100.0, 8.0, rng)
        samples = simulate_aiding(motion, true, 8.0, rng)["keyframes"]
        start = int(np.searchsorted(sampled.samples.time, 1.0))
        bias = np.hstack([sampled.accel_bias_body[start], sampled.gyro_bias_body[start]])
        aided = ErrorStateFilter(_start(rng, motion, site, bias), BLOCKS)
        unaided = aided.state
        for k in np.flatnonzero((samples.time > 1.4) & (samples.time < 6.6)).tolist():
            time = float(samples.time[k])
            predicted = propagate(aided.state, sampled.samples, time, site, 0.0)
            at = predicted.state
            measured = aiding_measurement(KEYFRAMES, samples.rows(slice(k, k + 1)))
            assert isinstance(measured, RelativePose)
            bias = np.hstack([at.accel_bias_body, at.gyro_bias_body])[None]
            measured = measured.over_interval(sampled.samples, 0.0, np.array([time]), bias, site)
            rate = motion.rate_body(np.array([time])) + at.gyro_bias_body
            measured = measured.with_inertial(np.hstack([rate, np.zeros((1, 3))]))
            aided.absorb(predicted, [measured])
        last = aided.state
        unaided = propagate(unaided, sampled.samples, last.time, site, 0.0).state
        pose = last.world_from_body, last.position_world
        nees.append(_pose_nees(motion, last.time, pose, last.cov[:6, :6]))
        narrower.append(last.position_sigma / unaided.position_sigma)
    low, high = average_nees_bounds(6, runs, 0.99)
    assert low * (1.0 if noisier == 1.0 else 0.5) < np.mean(nees) < high
    assert np.mean(narrower) < 0.5


@pytest.mark.slow
def test_the_covariance_of_the_smoother_is_honest() -> None:
    """Keyframes lead out of the field: phasors end at 5 s, the log at 9 s."""
    runs, nees, end = 20, [], 9.0
    site = replace(surveyed_site(), aiding=(KEYFRAMES,))
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        motion = random_walk_motion(rng, end, DEMO_BOX_WORLD, rests=Rests(1.0, end, 0.0))
        true = perturb_site(site, rng)
        imu = simulate_imu(motion, site.platform.imu, site.gravity, 100.0, end, rng).samples
        at = motion.trajectory(np.arange(0.25, 5.0, 0.25))
        fields = simulate_fields(true, at, SIGMA, rng, window=0.2)
        aiding = simulate_aiding(motion, true, end, rng)
        log = Log("keyframes", EPOCH_NS, "test", imu, fields=fields, aiding=aiding)
        states = mf.smooth(log, site, SmootherSettings(loss=None, tune=False)).states
        assert states.time[-1] == 8.5
        assert states.pose_cov is not None
        pose = states.world_from_body[-1], states.position_world[-1]
        nees.append(_pose_nees(motion, 8.5, pose, states.pose_cov[-1]))
    low, high = average_nees_bounds(6, runs, 0.99)
    assert low < np.mean(nees) < high


def _phasor_log(site: Site, end: float = 8.0) -> tuple[Log, SimulatedMotion]:
    rng = np.random.default_rng(4)
    motion = random_walk_motion(rng, end, DEMO_BOX_WORLD, rests=Rests(1.0, end, 0.0))
    imu = simulate_imu(motion, site.platform.imu, site.gravity, 100.0, end, rng).samples
    fields = simulate_fields(site, motion.trajectory(np.arange(0.25, 5.0, 0.25)), SIGMA, rng)
    aiding = simulate_aiding(motion, site, end, rng)
    return Log("keyframes", EPOCH_NS, "test", imu, fields=fields, aiding=aiding), motion


def test_a_log_whose_intervals_are_all_too_long_is_refused() -> None:
    site = replace(surveyed_site(), aiding=(KEYFRAMES,))
    log, _ = _phasor_log(site)
    samples = log.aiding["keyframes"]
    value = samples.value.copy()
    value[:, 0] = 2.5
    aiding = {"keyframes": replace(samples, value=value)}
    with pytest.raises(InputError, match=r"keyframes: none of its .* at most 2 s"):
        mf.smooth(replace(log, aiding=aiding), site)


@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
def test_keyframes_lead_online_out_of_the_field(estimator: Literal["ekf", "smoother"]) -> None:
    site = replace(surveyed_site(), aiding=(KEYFRAMES,))
    log, motion = _phasor_log(site)
    settings = NavigatorSettings(estimator=estimator, start_duration=3.0)
    navigator, samples = Navigator(site, settings), log.aiding["keyframes"]
    assert log.fields is not None
    states = []
    for begin in np.arange(0.0, 8.0, 0.5):
        imu = slice(*np.searchsorted(log.imu.time, [begin, begin + 0.5]))
        navigator.add_imu(log.imu.time[imu], log.imu.gyro_body[imu], log.imu.accel_body[imu])
        here = (log.fields.time >= begin) & (log.fields.time < begin + 0.5)
        navigator.add_fields(log.fields.rows(here))
        new = (samples.time >= begin) & (samples.time < begin + 0.5)
        navigator.add_aiding("keyframes", samples.rows(new))
        states += navigator.take()
        if begin == 6.0:  # with poses in its window
            navigator = restored(site, settings, navigator.checkpoint())
    last = states[-1]
    assert last.time == 7.5
    assert not [name for name in navigator.counts if "keyframes" in name]
    pose = last.world_from_body, last.position_world
    assert _pose_nees(motion, last.time, pose, last.cov[:6, :6]) < 22.5  # one in 1,000
    assert last.position_sigma < 0.1  # m


# Files ----------------------------------------------------------------------------------------


def _record() -> AidingSamples:
    return simulate_aiding(_motion(), SITE, 3.0, np.random.default_rng(1))["keyframes"]


def test_poses_that_do_not_follow_are_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="give 7 for each"):
        AidingSamples("relative_pose", np.zeros(1), np.zeros((1, 6)))
    with pytest.raises(InputError, match="an interval is not positive"):
        AidingSamples("relative_pose", np.zeros(1), np.zeros((1, 7)))
    with pytest.raises(InputError, match="no finite value"):
        AidingSamples("relative_pose", np.zeros(1), np.array([[0.5, np.nan, 0, 0, 0, 0, 0]]))
    log, _ = _phasor_log(replace(surveyed_site(), aiding=(KEYFRAMES,)))
    write_log(replace(log, aiding={}), tmp_path / "log")
    names = "interval_s,translation_x,translation_y,translation_z,qw,qx,qy,qz"
    table = tmp_path / "log" / "relative_pose.csv"
    for row, finding in (
        ("0,0.1,0,0,1,0,0,0", "interval_s"),
        ("0.5,0.1,0,0,1,1,0,0", "length of a rotation's quaternion"),
        ("0.5,0.1,,0,1,0,0,0", "translation_y"),
    ):
        table.write_text(f"time_ns,{names}\n{EPOCH_NS + 10**9},{row}\n")
        with pytest.raises(InputError, match=finding):
            read_log(tmp_path / "log")
    table.write_text(f"time_ns,{names}\n{EPOCH_NS + 10**9},0.5,0.1,0.2,0.3,0,0,1,0\n")
    samples = read_log(tmp_path / "log").aiding["relative_pose"]
    assert np.allclose(samples.value, [[0.5, 0.1, 0.2, 0.3, 0.0, np.pi, 0.0]], rtol=0, atol=1e-12)


def test_the_pipe_has_seven_numbers_of_a_pose() -> None:
    record = _record()
    content = aiding_content([("keyframes", record)])
    entry = Record.model_validate(content).aiding
    again = aiding_samples(entry["keyframes"], "relative_pose")
    assert np.array_equal(again.value, record.value)
    assert np.array_equal(again.time, record.time)
    with pytest.raises(InputError, match="value with 3 numbers"):
        aiding_samples(entry["keyframes"], "position")


def test_poses_of_an_odometry_give_relative_poses() -> None:
    """Of a helix; in parts as they arrive as well as at once, with and without a twist."""
    sensor = replace(KEYFRAMES, rate_hz=2.0)
    time = 3.0 + np.arange(0.0, 6.0, 1.0 / 30.0)
    attitude = Rotation.from_rotvec(np.outer(0.5 * time, [0.0, 0.6, 0.8]))
    position = np.stack([np.sin(time), np.cos(time), 0.1 * time], axis=1)
    rows = np.hstack([position, attitude.as_quat(), np.zeros((len(time), 3))])
    stamps, value = SensorMessages(sensor).samples(time, rows)
    assert np.allclose(np.diff(stamps), 0.5, rtol=0.0, atol=0.04)
    assert np.allclose(stamps[0] - value[0, 0], 3.0, rtol=0.0, atol=1e-9)
    first = attitude[np.searchsorted(time, stamps - value[:, 0] - 1e-9)]
    last = position[np.searchsorted(time, stamps - 1e-9)]
    place = position[np.searchsorted(time, stamps - value[:, 0] - 1e-9)]
    assert np.allclose(place + first.apply(value[:, 1:4]), last, rtol=0.0, atol=1e-9)
    turned = 0.5 * value[:, :1] * np.array([0.0, 0.6, 0.8])
    assert np.allclose(value[:, 4:], turned, rtol=0.0, atol=1e-9)
    online = SensorMessages(sensor)
    parts = [online.samples(time[k : k + 4], rows[k : k + 4]) for k in range(0, len(time), 4)]
    assert np.allclose(np.concatenate([one for _, one in parts]), value, rtol=0.0, atol=1e-9)
    rows[:, 7] = 1.0
    assert np.array_equal(SensorMessages(sensor).samples(time, rows)[1], value)
    slow = SensorMessages(replace(sensor, rate_hz=0.3))  # from 3, 3.33 and 6.67 s on
    assert np.allclose(slow.samples(time, rows)[0], 3.0 + 1.0 / 3.0, rtol=0.0, atol=0.04)
