"""Aiding sensors: their derivatives, their physics, their files, and what they give an estimate."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from aiding_site import aided_site, sensors
from derivatives import central_difference, relative_to_group
from scipy.spatial.transform import Rotation

import magfusion as mf
from magfusion.errors import InputError
from magfusion.estimation.graph.measurement import measured_rows
from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.propagation import propagate
from magfusion.estimation.graph.state import MOTION, State, between, moved, states_of
from magfusion.estimation.measurements.aiding_samples import aiding_measurement, thinned
from magfusion.estimation.measurements.relative_pose import RelativePose
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.files.aiding_tables import read_aiding
from magfusion.files.log import read_log, write_log
from magfusion.files.site import load_site, save_site
from magfusion.files.site_aiding import MarkEntry, aiding_sensor
from magfusion.files.table import Span
from magfusion.jobs.replay import Replay, feed
from magfusion.model.aiding import QUANTITIES, AidingSamples, AidingSensor, AidingSigma
from magfusion.model.parameters import (
    AIDING_CLOCK,
    AIDING_SCALE,
    choose_blocks,
    dimension,
    initial_calibration,
    prior_sigma,
)
from magfusion.model.samples import ImuSamples
from magfusion.simulation.aiding import simulate_aiding
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests, random_walk_motion

ROOM = np.array([[0.5, 0.5, 0.8], [5.5, 4.5, 1.2]])  # m
SITE = aided_site()
BLOCKS = choose_blocks(SITE, ("aiding",))
KINDS = [sensor.name for sensor in SITE.aiding]


def _motion():
    return random_walk_motion(np.random.default_rng(5), 30.0, ROOM, rests=Rests(0.0, 30.0, 0.0))


def _state(time, cov=None):
    there = _motion().trajectory(np.array([time]))
    size = MOTION + dimension(BLOCKS)
    return State(
        time,
        there.world_from_body[0],
        there.position_world[0],
        there.velocity_world[0],
        np.array([0.02, -0.01, 0.03]),
        np.array([0.002, 0.001, -0.003]),
        initial_calibration(SITE, 0.0),
        np.eye(size) if cov is None else cov,
    )


def _samples(sensor, time, rng=None):
    """Return what the sensor records at a time: ideal, or with noise of a generator."""
    if sensor.quantity == "mark":
        return AidingSamples("mark", np.array([time]), np.zeros((1, 0)), ("7",))
    ideal = replace(sensor, sigma=0.0, relative_sigma=0.0, offset_walk=0.0, rate_hz=1.0 / time)
    ideal = replace(ideal, rotation_sigma=0.0)
    rng = np.random.default_rng(0) if rng is None else rng
    record = simulate_aiding(_motion(), replace(SITE, aiding=(ideal,)), 1.5 * time, rng)
    return record[sensor.name]


def _measurement(sensor, time):
    state, motion = _state(time), _motion()
    rate = motion.rate_body(np.array([time])) + state.gyro_bias_body
    force = motion.specific_force_body(np.array([time]), SITE.gravity) + state.accel_bias_body
    measured = aiding_measurement(sensor, _samples(sensor, time))
    if isinstance(measured, RelativePose):
        measured = _over_interval(measured, state)
    return measured.with_inertial(np.hstack([rate, force]))


def _over_interval(measured, state, step=0.005):
    """Return a relative pose with the inertial samples of its interval."""
    time, motion = np.arange(state.time - 2.5, state.time + 0.5, step), _motion()
    imu = ImuSamples(
        time,
        motion.rate_body(time) + state.gyro_bias_body,
        motion.specific_force_body(time, SITE.gravity) + state.accel_bias_body,
    )
    bias = np.hstack([state.accel_bias_body, state.gyro_bias_body])[None]
    return measured.over_interval(imu, 0.0, np.array([state.time]), bias, SITE)


@pytest.mark.parametrize("sensor", SITE.aiding, ids=KINDS)
def test_the_derivatives_are_difference_quotients(sensor):
    state, measurement = _state(12.3), _measurement(sensor, 12.3)
    _, jacobian = measured_rows([measurement], state, BLOCKS)

    def error(step):
        return measured_rows([measurement], moved(state, BLOCKS, step), BLOCKS)[0]

    expected = central_difference(error, len(state.cov), 1e-6)
    assert relative_to_group(jacobian, expected) < 1e-6


@pytest.mark.parametrize("sensor", SITE.aiding, ids=KINDS)
def test_a_prediction_is_what_the_simulated_sensor_measures(sensor):
    if sensor.quantity == "mark":
        pytest.skip("a random walk is on no mark")
    measurement = _measurement(sensor, 12.3)
    rows = measurement.linearize(states_of([_state(12.3)]), initial_calibration(SITE, 0.0), ())
    # A specific force that is constant over each step of 5 ms moves by some micrometres less.
    within = 1e-5 if sensor.quantity == "relative_pose" else 1e-9
    assert np.max(np.abs(rows.error * measurement.sigma)) < within * max(1.0, abs(sensor.offset))


@pytest.mark.parametrize("sensor", SITE.aiding, ids=KINDS)
def test_the_derivative_by_the_clock_is_the_motion(sensor):
    """A sample of 5 ms later is what the sensor measures then."""
    if sensor.quantity == "mark":
        pytest.skip("a mark does not move")
    if sensor.quantity == "velocity":  # an angular acceleration is not measured
        sensor = replace(sensor, position_body=np.zeros(3))
    late, now = 5e-3, 12.3
    clock = next(b for b in BLOCKS if b.key == (AIDING_CLOCK, sensor.name))
    site = replace(SITE, aiding=(sensor,))
    state = replace(_state(now), calibration=initial_calibration(site, 0.0))
    _, jacobian = measured_rows([_measurement(sensor, now)], state, BLOCKS)
    by_time = jacobian[:, MOTION + clock.columns.start]
    there = [_samples(sensor, now + sign * late).value[0] for sign in (1.0, -1.0)]
    if sensor.quantity == "relative_pose":  # a rotation between the two, and no interval
        turn = [Rotation.from_rotvec(value[4:]) for value in there]
        turned = (turn[1].inv() * turn[0]).as_rotvec()
        there = [np.append(there[0][1:4], turned), np.append(there[1][1:4], np.zeros(3))]
    expected = (there[0] - there[1]) / (2.0 * late)
    size = max(1e-3, float(np.max(np.abs(expected))))
    sigma = _measurement(sensor, now).sigma[0]
    assert np.max(np.abs(by_time * sigma - expected)) < 1e-3 * size


@pytest.mark.parametrize("sensor", SITE.aiding, ids=KINDS)
def test_one_update_of_the_filter_is_one_gauss_newton_step(sensor):
    rng = np.random.default_rng(3)
    scale = np.concatenate([np.repeat([0.02, 0.03, 0.1, 0.05, 0.005], 3), prior_sigma(BLOCKS)])
    root = rng.normal(size=(len(scale),) * 2) / np.sqrt(len(scale))
    cov = scale[:, None] * (0.2 * root @ root.T + np.eye(len(scale))) * scale
    start = _state(12.0, cov)
    time = np.arange(11.9, 12.5, 0.005)
    motion = _motion()
    imu = ImuSamples(time, motion.rate_body(time), motion.specific_force_body(time, SITE.gravity))
    predicted = propagate(start, imu, 12.3, SITE, SITE.platform.imu.time_offset)
    measurement = _measurement(sensor, 12.3)
    light = ErrorStateFilter(start, BLOCKS)
    light.absorb(predicted, [measurement])
    window = SlidingWindow(start, BLOCKS, 10.0, ProcessNoise(BLOCKS, np.zeros(dimension(BLOCKS))))
    window.absorb(predicted, [measurement])
    sigma = np.sqrt(np.diag(light.state.cov))
    went = between(predicted.state, light.state, BLOCKS) / sigma
    assert np.max(np.abs(between(light.state, window.state, BLOCKS) / sigma)) < 1e-9 * max(
        1.0, np.max(np.abs(went))
    )
    assert np.max(np.abs((window.state.cov - light.state.cov) / np.outer(sigma, sigma))) < 1e-9


def test_headings_differ_by_less_than_half_a_turn():
    compass = SITE.aiding[-1]
    measured = _measurement(compass, 12.3)
    turned = replace(measured, value=measured.value + 2.0 * np.pi)
    at = states_of([_state(12.3)]), initial_calibration(SITE, 0.0), ()
    assert np.max(np.abs(turned.linearize(*at).error)) < 1e-6


# Files ----------------------------------------------------------------------------------------


def test_a_site_keeps_its_sensors(tmp_path):
    path = tmp_path / "site.yaml"
    save_site(SITE, path)
    again = load_site(path)
    for one, other in zip(SITE.aiding, again.aiding, strict=True):
        for name in ("quantity", "name", "origin", "rate_hz", "offset_walk", "constraint_sigma"):
            assert getattr(one, name) == getattr(other, name)
        assert abs(one.sigma - other.sigma) < 1e-12
        for name in ("position_body", "body_from_sensor", "offset", "time_offset"):
            assert np.max(np.abs(getattr(one, name) - getattr(other, name))) < 1e-9
    assert abs(again.aiding[5].scale - SITE.aiding[5].scale) < 1e-9
    save_site(again, tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text() == path.read_text()


@pytest.mark.parametrize(
    ("entry", "finding"),
    [
        ({"quantity": "velocity"}, r"aiding\[0\].noise_m_s: is missing"),
        ({"quantity": "speed"}, r"aiding\[0\]: .* 'velocity', 'range'"),
        ({"noise_m": 1.0}, r"aiding\[0\]: .* add 'quantity'"),
        ({"quantity": "range", "noise_m": 0.1}, r"aiding\[0\].point_m: is missing"),
        ({"quantity": "heading", "noise_deg": 1.0, "noise_m": 1.0}, "one of .*noise_deg"),
        ({"quantity": "mark", "noise_m": 0.1, "marks_m": {"a": [1.0]}}, r"marks_m.a: .*3 numbers"),
    ],
)
def test_a_sensor_that_is_none_is_refused(entry, finding, tmp_path):
    path = tmp_path / "site.yaml"
    save_site(replace(SITE, aiding=()), path)
    content = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump(content | {"aiding": [entry]}))
    with pytest.raises(InputError, match=finding):
        load_site(path)


@pytest.mark.parametrize("name", ["A", "imu", "truth"])
def test_a_name_that_another_part_has_is_refused(name, tmp_path):
    save_site(aided_site(replace(WHEELS, name=name)), tmp_path / "site.yaml")
    with pytest.raises(InputError, match=r"aiding\[0\].name: .*another name"):
        load_site(tmp_path / "site.yaml")


@pytest.mark.parametrize(
    ("quantity", "value", "finding"),
    [
        ("range", [[1.0, 2.0]], "give 1 for each of 1 times"),
        ("velocity", [[np.nan] * 3], "no finite value"),
        ("position", [[0.0, np.inf, 0.0]], "no finite value"),
        ("mark", [[]], "name of a mark"),
    ],
)
def test_samples_that_are_none_are_refused(quantity, value, finding):
    with pytest.raises(InputError, match=finding):
        AidingSamples(quantity, np.zeros(1), np.array(value))


def _simulated(*chosen, seed=1, duration=20.0, **changes):
    site = aided_site(*chosen)
    config = SimulationConfig(
        ROOM,
        duration,
        motion="drive",
        speed=1.0,
        rests=Rests(2.0, duration, 0.0),
        perturb=False,
        **changes,
    )
    return simulate_log(site, config, np.random.default_rng(seed))


def test_a_log_keeps_the_samples(tmp_path):
    log = _simulated(duration=6.0).log
    marks = AidingSamples("mark", np.array([1.0, 2.5]), np.zeros((2, 0)), ("7", "7"))
    log = replace(log, aiding={**log.aiding, "foot": marks})
    assert {samples.quantity for samples in log.aiding.values()} == set(QUANTITIES)
    write_log(log, tmp_path / "log")
    again = read_log(tmp_path / "log")
    assert again.aiding.keys() == log.aiding.keys()
    for name, samples in log.aiding.items():
        assert again.aiding[name].marks == samples.marks
        assert np.allclose(again.aiding[name].time, samples.time, rtol=0.0, atol=1e-9)
        assert np.allclose(
            again.aiding[name].value, samples.value, rtol=1e-12, atol=0.0, equal_nan=True
        )


def test_a_table_without_names_has_one_sensor(tmp_path):
    write_log(replace(_simulated(duration=6.0).log, aiding={}), tmp_path / "log")
    epoch = read_log(tmp_path / "log").epoch_ns
    table = tmp_path / "log" / "velocity.csv"
    table.write_text(f"time_ns,velocity_x\n{epoch + 10**9},0.5\n{epoch + 2 * 10**9},\n")
    samples = read_log(tmp_path / "log").aiding["velocity"]
    assert samples.time.tolist() == [1.0]
    assert np.array_equal(samples.value, [[0.5, np.nan, np.nan]], equal_nan=True)
    table.write_text(f"time_ns,velocity_x\n{epoch},0.5\n{epoch},0.6\n")
    with pytest.raises(InputError, match="another sample of velocity"):
        read_log(tmp_path / "log")


def test_a_range_without_an_echo_is_no_sample_and_none_is_negative(tmp_path):
    write_log(replace(_simulated(duration=6.0).log, aiding={}), tmp_path / "log")
    epoch = read_log(tmp_path / "log").epoch_ns
    table = tmp_path / "log" / "range.csv"
    table.write_text(f"time_ns,range\n{epoch + 10**9},0.5\n{epoch + 2 * 10**9},nan\n")
    assert read_log(tmp_path / "log").aiding["range"].value.tolist() == [[0.5]]
    table.write_text(f"time_ns,range\n{epoch},-0.5\n")
    with pytest.raises(InputError, match=r"column range, row 0.*found -0.5; write 0 m or more"):
        read_log(tmp_path / "log")


def test_samples_beyond_the_rate_are_left_out():
    sensor = replace(SITE.aiding[0], rate_hz=10.0)
    time = np.arange(0.0, 1.0, 0.02)
    every = AidingSamples("velocity", time, np.zeros((len(time), 3)))
    assert np.allclose(
        thinned(sensor, every, -np.inf).time, np.arange(0.0, 1.0, 0.1), rtol=0.0, atol=1e-9
    )
    later = thinned(sensor, every.rows(slice(3, None)), float(time[2]))
    assert np.allclose(later.time, np.arange(0.1, 1.0, 0.1), rtol=0.0, atol=1e-9)


# Estimates ------------------------------------------------------------------------------------

WHEELS = AidingSensor(
    "wheels",
    "velocity",
    0.01,
    relative_sigma=0.01,
    constraint_sigma=0.02,
    sigmas=AidingSigma(scale=np.array(0.05)),
)


def _with_scale(site, scale):
    aiding = tuple(replace(s, scale=np.array(scale)) for s in site.aiding)
    return replace(site, aiding=aiding)


def _wrong(simulated, name, change):
    """Return the log with changed values of a sensor."""
    samples = simulated.log.aiding[name]
    changed = replace(samples, value=change(samples.time[:, None], samples.value))
    return replace(simulated.log, aiding={**simulated.log.aiding, name: changed})


def _navigated(log, site, estimator):
    navigator, states = Navigator(site, NavigatorSettings(estimator=estimator)), []
    for _, piece in Replay(log).pieces():
        feed(navigator, piece)
        states += navigator.take()
    return navigator, states


def _scale_of(calibration):
    return float(calibration.site.aiding[0].scale)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
def test_online_the_scale_of_wheels_is_estimated_and_a_slip_left_out(estimator):
    simulated = _simulated(WHEELS)

    def slipping(time, value):
        return 1.03 * value * np.where((time > 14.0) & (time < 15.0), 1.2, 1.0)

    log = _wrong(simulated, "wheels", slipping)
    navigator, states = _navigated(log, aided_site(WHEELS), estimator)
    last = states[-1]
    assert abs(_scale_of(last.calibration) - 1.03) < 0.005
    assert 5 <= navigator.counts["outlier of wheels"] <= 15
    assert last.verdict is mf.Verdict.TRUSTWORTHY
    error = last.position_world - simulated.motion.position_world(np.array([last.time]))[0]
    assert np.linalg.norm(error) < 0.02  # m


@pytest.mark.slow
def test_the_smoother_estimates_the_scale_of_wheels():
    simulated = _simulated(WHEELS)
    log = _wrong(simulated, "wheels", lambda _, value: 1.03 * value)
    result = mf.smooth(log, aided_site(WHEELS))
    assert abs(_scale_of(result.calibration) - 1.03) < 0.005
    error = result.states.position_world - simulated.motion.position_world(result.states.time)
    assert np.max(np.linalg.norm(error, axis=1)) < 0.02  # m


@pytest.mark.slow
def test_the_smoother_estimates_as_if_a_slip_had_no_samples():
    """Of twenty samples the tail of Cauchy's loss would move the scale by two sigmas."""
    simulated = _simulated(WHEELS, duration=14.0)
    time = simulated.log.aiding["wheels"].time
    slips = (time > 8.0) & (time < 10.0)
    slipping = _wrong(
        simulated, "wheels", lambda _, value: np.where(slips, 1.2, 1.0)[:, None] * value
    )
    without = replace(simulated.log, aiding={"wheels": simulated.log.aiding["wheels"].rows(~slips)})
    one, other = (mf.smooth(log, aided_site(WHEELS)) for log in (slipping, without))
    scale = next(b for b in one.blocks if b.key == (AIDING_SCALE, "wheels"))
    sigma = float(np.sqrt(one.calibration_cov[scale.columns, scale.columns][0, 0]))
    assert abs(_scale_of(one.calibration) - _scale_of(other.calibration)) < 0.5 * sigma


@pytest.mark.slow
def test_a_sensor_that_contradicts_for_long_is_named():
    simulated = _simulated(WHEELS)
    log = _wrong(simulated, "wheels", lambda time, value: np.where(time > 10.0, -value, value))
    _, states = _navigated(log, aided_site(WHEELS), "ekf")
    last = states[-1]
    assert [f.code for f in last.judgement.findings] == ["aiding_disagrees"]
    assert "wheels" in last.judgement.findings[0].text
    error = last.position_world - simulated.motion.position_world(np.array([last.time]))[0]
    assert np.linalg.norm(error) < 0.02  # m
    _, trust = mf.judge_result(mf.smooth(log, aided_site(WHEELS)), log)
    assert [f.code for f in trust.reasons] == ["aiding_disagrees"]
    _, trust = mf.judge_result(mf.smooth(simulated.log, aided_site(WHEELS)), simulated.log)
    assert trust.verdict is mf.Verdict.TRUSTWORTHY


def test_samples_of_a_sensor_that_the_site_lacks_are_refused():
    log = _simulated(WHEELS, duration=6.0).log
    with pytest.raises(InputError, match="wheels is no aiding sensor"):
        mf.smooth(log, aided_site(replace(WHEELS, name="other")))
    with pytest.raises(InputError, match="declares a range"):
        mf.smooth(log, aided_site(replace(sensors()[1], name="wheels")))


def test_a_mark_that_the_site_lacks_is_refused():
    foot = sensors()[3]
    samples = AidingSamples("mark", np.array([1.0]), np.zeros((1, 0)), ("8",))
    with pytest.raises(InputError, match="8 is no mark"):
        aiding_measurement(foot, samples)


@pytest.mark.slow
def test_log_and_pipe_give_the_same_states(tmp_path):
    simulated = _simulated(WHEELS, sensors()[1], duration=9.0)
    write_log(simulated.log, tmp_path / "log")
    save_site(aided_site(WHEELS, sensors()[1]), tmp_path / "log" / "site.yaml")
    tool = [sys.executable, "-m", "magfusion"]
    replayed = subprocess.run([*tool, "replay", "log"], cwd=tmp_path, capture_output=True)
    assert b'"aiding":{"wheels":{"time"' in replayed.stdout
    piped = subprocess.run(
        [*tool, "navigate", "-", "--site", "log/site.yaml", "--estimator", "ekf"],
        cwd=tmp_path,
        input=replayed.stdout,
        capture_output=True,
    )
    assert piped.returncode == 0, piped.stderr
    _, states = _navigated(read_log(tmp_path / "log"), load_site(tmp_path / "log/site.yaml"), "ekf")
    records = [json.loads(line) for line in piped.stdout.splitlines()]
    position = {r["time"]: r["position"] for r in records if "position" in r}
    shared = [s for s in states if s.time in position]
    assert len(shared) > 20
    assert max(np.linalg.norm(s.position_world - position[s.time]) for s in shared) < 1e-3  # m


@pytest.mark.slow
def test_a_navigator_goes_on_from_a_checkpoint():
    simulated = _simulated(WHEELS, duration=9.0)
    site, settings = aided_site(WHEELS), NavigatorSettings(estimator="ekf")
    pieces = [piece for _, piece in Replay(simulated.log).pieces()]
    first, whole = Navigator(site, settings), Navigator(site, settings)
    for piece in pieces[:150]:
        feed(first, piece)
        feed(whole, piece)
    again = restored(site, settings, first.checkpoint())
    for piece in pieces[150:]:
        feed(again, piece)
        feed(whole, piece)
    assert np.array_equal(again.take()[-1].position_world, whole.take()[-1].position_world)


def test_driving_is_along_the_body_and_level():
    motion = _simulated(WHEELS).motion
    time = np.arange(0.0, 20.0, 0.1)
    attitude: Rotation = motion.world_from_body(time)
    velocity_body = attitude.inv().apply(motion.velocity_world(time))
    assert np.max(np.abs(velocity_body[:, 1:])) < 0.005  # m/s
    assert np.max(np.abs(attitude.as_matrix()[:, 2, 2] - 1.0)) < 1e-12


@pytest.mark.parametrize(
    ("header", "stamp", "part"),
    [
        ("time_ns,range_m", "1700000001000000000", "rename range_m to range, or add"),
        ("time_ns,range", "1700000001.5", "write whole numbers, of time_ns nanoseconds"),
    ],
)
def test_a_table_that_is_nearly_right_is_refused_with_the_remedy(
    tmp_path: Path, header: str, stamp: str, part: str
) -> None:
    (tmp_path / "range.csv").write_text(f"{header}\n{stamp},3.1\n")
    with pytest.raises(InputError, match=part):
        read_aiding({"range": tmp_path / "range.csv"}, Span(1_700_000_000_000_000_000))


def test_marks_may_have_numbers_for_names() -> None:
    entry = MarkEntry.model_validate(
        {"quantity": "mark", "noise_m": 0.1, "marks_m": {7: [1, 2, 3]}}
    )
    assert list(aiding_sensor(entry).marks_world) == ["7"]
