"""The state of now: carried by each inertial sample, blended, judged, and through a pipe."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from online_log import OnlineLog, navigate, online_log, silent
from scipy.spatial.transform import Rotation
from test_parameters import GyroScale

from magfusion.estimation.graph.process_noise import calibration_process_noise
from magfusion.estimation.graph.propagation import propagate
from magfusion.estimation.graph.state import MOTION, State, between, moved
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.propagated import (
    PropagationStart,
    initial_passage,
    propagate_passage,
    states_along,
)
from magfusion.estimation.online.state_of_now import PropagatedState
from magfusion.estimation.posterior.separation import radii
from magfusion.files.site import save_site
from magfusion.jobs.replay import run_replay
from magfusion.model.parameters import choose_blocks, dimension, initial_calibration
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import ClockModel, ImuModel
from magfusion.model.strapdown_steps import steps_of
from magfusion.model.trust import Risk
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.inertial import simulate_imu

IMU = NavigatorSettings("ekf", rate="imu")


@pytest.fixture(scope="module")
def walk() -> OnlineLog:
    return online_log(0, 11.0, rate_hz=100.0)


def propagated(
    log: OnlineLog, settings: NavigatorSettings, **how: Any
) -> tuple[Navigator, list[PropagatedState]]:
    result: list[PropagatedState] = []
    navigator, _ = navigate(
        log, settings, watch=lambda n, _: result.extend(n.take_propagated()), **how
    )
    return navigator, result


def departure_at(navigator: Navigator, state: State) -> PropagationStart:
    imu = navigator._loop.arrived.imu
    assert imu.usual is not None
    return PropagationStart(
        state,
        navigator.site,
        navigator.blocks,
        navigator._loop.running.process_noise,
        imu.offset,
        imu.usual,
    )


@pytest.fixture(scope="module")
def exceeding(walk: OnlineLog) -> tuple[Navigator, PropagationStart, ImuSamples]:
    """Return a state within the buffered stream that moves fast, between two samples."""
    navigator, _ = navigate(walk, NavigatorSettings("ekf"))
    result = navigator.state(-np.inf)
    moving = replace(
        result, time=result.time - 1.0 + 0.0013, velocity_world=np.array([1.0, 0.3, -0.2])
    )
    imu = navigator._loop.arrived.imu.measured(result.time - 1.5)
    return navigator, departure_at(navigator, moving), imu


def carried_in_chunks(start: PropagationStart, imu: ImuSamples, chunk: int) -> list[State]:
    stamps, last = imu.time + start.time_offset, initial_passage(start)
    wanted, result = stamps[stamps > start.state.time], []
    for begin in range(0, len(wanted), chunk):
        own = wanted[begin : begin + chunk]
        come = slice(0, int(np.searchsorted(stamps, own[-1], side="right")))
        passage, last = propagate_passage(
            start,
            last,
            ImuSamples(imu.time[come], imu.gyro_body[come], imu.accel_body[come]),
            own,
        )
        result += states_along(start, passage)
    return result


def separate(one: State, other: State, navigator: Navigator) -> float:
    """Return the largest difference of two states in units of the sigmas of one."""
    step = between(one, other, navigator.blocks)[:9]
    return float(np.max(np.abs(step) / np.sqrt(np.diagonal(other.cov))[:9]))


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_carried_by_single_steps_is_integrated_directly(
    exceeding: tuple[Navigator, PropagationStart, ImuSamples], chunk: int
) -> None:
    """Directly: by GTSAM's preintegration from the epoch on, as the estimators predict.

    That integrates cubics; a single step has no later sample, and is linear.
    """
    navigator, start, imu = exceeding
    result = carried_in_chunks(start, imu, chunk)
    assert len(result) > 95
    for state in (result[0], result[20], result[-1]):
        direct = propagate(
            start.state,
            imu,
            state.time,
            start.site,
            start.time_offset,
            start.process_noise,
            start.usual,
            start.blocks,
        ).state
        assert separate(state, direct, navigator) < 0.02  # sigma
        scale = np.sqrt(np.diagonal(direct.cov))
        assert np.max(np.abs(state.cov - direct.cov) / scale / scale[:, None]) < 5e-3


def test_moments_walk_as_declared_while_the_state_is_carried(
    exceeding: tuple[Navigator, PropagationStart, ImuSamples],
) -> None:
    """A supply that warms up changes its moments by 0.5 in an hour: by 0.7 % in a second."""
    _, start, imu = exceeding
    site = replace(demo_site(), clock=ClockModel(log_moment_walk=0.5))
    blocks, known = choose_blocks(site, ("moments",)), 1e-3
    cov = known**2 * np.eye(MOTION + dimension(blocks))
    calibration = initial_calibration(site, start.state.time)
    state = replace(start.state, cov=cov, calibration=calibration)
    walk = calibration_process_noise(site, blocks)
    own = replace(start, site=site, state=state, blocks=blocks, process_noise=walk)
    result = carried_in_chunks(own, imu, 9)[-1]
    gained = np.diagonal(result.cov)[MOTION:] - known**2
    assert gained[0] > known**2
    expected = 0.5**2 * (result.time - state.time) / 3600.0
    np.testing.assert_allclose(gained, expected, rtol=1e-6)


def test_a_parameter_of_the_imu_has_its_share_in_the_covariance(
    exceeding: tuple[Navigator, PropagationStart, ImuSamples],
) -> None:
    _, start, imu = exceeding
    navigator = Navigator(
        start.site, NavigatorSettings("ekf", parameters=(GyroScale(),), estimate=("gyro",))
    )
    size = MOTION + sum(len(b.sigma) for b in navigator.blocks)
    assert size > MOTION
    cov = 1e-8 * np.eye(size)
    cov[MOTION:, MOTION:] *= 1e4
    state = replace(start.state, cov=cov)
    noise = navigator._loop.running.process_noise
    own = replace(start, state=state, blocks=navigator.blocks, process_noise=noise)
    result = carried_in_chunks(own, imu, 9)[-1]
    direct = propagate(
        state, imu, result.time, own.site, own.time_offset, None, own.usual, own.blocks
    )
    scale = np.sqrt(np.diagonal(direct.state.cov))
    assert np.max(np.abs(result.cov - direct.state.cov) / scale / scale[:, None]) < 5e-3


def test_steps_are_the_integral_of_a_constant_rate_and_force() -> None:
    """An independent strapdown: ten thousand small steps of SciPy's rotation."""
    rng = np.random.default_rng(3)
    gyro, accel = rng.normal(0.0, 2.0, (4, 3)), rng.normal(0.0, 5.0, (4, 3))
    dt = np.array([1e-3, 0.02, 0.3, 1.7])
    rotated, parts = steps_of(gyro, accel, dt), 10_000
    for k in range(4):
        small = dt[k] / parts
        turn = Rotation.from_rotvec(np.arange(parts)[:, None] * small * gyro[k])
        middle = turn * Rotation.from_rotvec(0.5 * small * gyro[k])
        gained = np.cumsum(middle.apply(accel[k]) * small, axis=0)
        moved = np.sum((gained - 0.5 * small * middle.apply(accel[k])) * small, axis=0)
        whole = Rotation.from_rotvec(dt[k] * gyro[k]).as_matrix()
        assert rotated.rotation[k] == pytest.approx(whole, abs=1e-12)
        assert rotated.velocity[k] == pytest.approx(gained[-1], rel=1e-6, abs=1e-9)
        assert rotated.position[k] == pytest.approx(moved, rel=1e-6, abs=1e-9)


def test_the_covariance_of_carrying_is_that_of_its_errors_unless_the_gyro_is_worse() -> None:
    """From starts that err as they claim, along samples as noisy as declared, or three times."""
    log, rng = online_log(1, 12.0, rate_hz=100.0), np.random.default_rng(7)
    sigma = np.repeat([2e-3, 1e-3, 5e-3, 1e-6, 1e-6], 3)
    declared = replace(log.site.platform.imu, gyro_noise=3e-3)
    silent_imu = ImuModel(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    exact_imu = simulate_imu(log.motion, silent_imu, log.site.gravity, 100.0, 12.0, rng).samples
    mean = {}
    for worse in (1.0, 3.0):
        squares = []
        for _ in range(40):
            white = 10.0 * rng.normal(size=(2, len(exact_imu), 3))
            imu = ImuSamples(
                exact_imu.time,
                exact_imu.gyro_body + worse * declared.gyro_noise * white[0],
                exact_imu.accel_body + declared.accel_noise * white[1],
            )
            begin = float(rng.uniform(6.0, 11.0))
            true = log.motion.trajectory(np.array([begin, begin + 0.4]))
            assert true.velocity_world is not None
            exact = State(
                begin,
                true.world_from_body[0],
                true.position_world[0],
                true.velocity_world[0],
                np.zeros(3),
                np.zeros(3),
                initial_calibration(log.site, 0.0),
                np.diag(sigma**2),
            )
            start = moved(exact, (), sigma * rng.normal(size=MOTION))
            site = replace(log.site, platform=replace(log.site.platform, imu=declared))
            noise = calibration_process_noise(site, ())
            first = PropagationStart(start, site, (), noise, 0.0, 0.01)
            passage, _ = propagate_passage(
                first, initial_passage(first), imu, np.array([begin + 0.4])
            )
            (result,) = states_along(first, passage)
            later = replace(
                exact,
                world_from_body=true.world_from_body[1],
                position_world=true.position_world[1],
                velocity_world=true.velocity_world[1],
            )
            error = between(result, later, ())[:6]
            squares.append(float(error @ np.linalg.solve(result.cov[:6, :6], error)))
        mean[worse] = float(np.mean(squares))
    assert 4.5 < mean[1.0] < 7.7  # six degrees of freedom, 40 runs
    assert mean[3.0] > 9.0


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
def test_the_covariance_is_that_of_the_errors_unless_the_gyro_noise_is_wrong(
    estimator: Any,
) -> None:
    """Of states up to a second old; with a third of the gyro's noise declared it must fail."""
    nees: dict[float, list[float]] = {1.0: [], 3.0: []}
    for seed in range(3):
        log = online_log(seed, 20.0, every=1.0)
        imu = log.site.platform.imu
        for wrong, result in nees.items():
            noise = replace(imu, gyro_noise=20.0 * imu.gyro_noise)
            rng = np.random.default_rng(100 + seed)
            noisy = simulate_imu(log.motion, noise, log.site.gravity, 50.0, 20.0, rng).samples
            reported = replace(noise, gyro_noise=noise.gyro_noise / wrong)
            site = replace(log.site, platform=replace(log.site.platform, imu=reported))
            own = replace(log, site=site, imu=noisy)
            _, states = propagated(own, NavigatorSettings(estimator, rate="imu"))
            errors = own.errors([s for s in states if s.time - s.epoch > 0.5])
            assert errors.nees is not None
            result.append(float(np.mean(errors.nees)))
    assert 4.0 < np.mean(nees[1.0]) < 9.0  # six degrees of freedom
    assert np.mean(nees[3.0]) > 9.0


@pytest.mark.slow
def test_a_correction_enters_smoothly_and_its_rest_is_in_the_covariance(walk: OnlineLog) -> None:
    sudden, smooth = (
        propagated(walk, replace(IMU, correction_time=length, risk=Risk()))[1]
        for length in (0.0, 0.4)
    )
    assert [s.time for s in sudden] == [s.time for s in smooth]

    def jumps(states: list[PropagatedState]) -> np.ndarray:
        """Return what the position changed by beyond its velocity (m)."""
        step = np.diff([s.position_world for s in states], axis=0)
        return np.linalg.norm(
            step - 0.01 * np.array([s.velocity_world for s in states])[1:], axis=1
        )

    epochs = np.flatnonzero(np.diff([s.epoch for s in sudden]) > 0.0)
    assert np.mean(jumps(smooth)[epochs]) < 0.2 * np.mean(jumps(sudden)[epochs])
    for own, other in zip(smooth, sudden, strict=True):
        rest = own.position_world - other.position_world
        more = own.cov[3:6, 3:6] - other.cov[3:6, 3:6]
        assert np.trace(more) == pytest.approx(rest @ rest, rel=1e-6, abs=1e-12)
        level, least = own.judgement.protection_level_m, other.judgement.protection_level_m
        assert (level is None) == (least is None)
        if level is not None and least is not None:
            assert level == pytest.approx(least + np.linalg.norm(rest), rel=1e-9)


def test_levels_grow_with_the_covariance_while_a_state_is_carried(walk: OnlineLog) -> None:
    _, states = propagated(walk, replace(IMU, risk=Risk()))
    last = [s for s in states if s.epoch == states[-1].epoch]
    level = [s.judgement.protection_level_m for s in last]
    assert all(value is not None for value in level)
    whole = [float(radii(s.cov[:6, :6]).whole[1]) for s in last]
    grown = np.array(level, dtype=float) / whole
    assert np.all(np.diff(np.array(level, dtype=float)) > -1e-9)
    assert np.all(grown >= (1.0 - 1e-9) * grown[0])


@pytest.mark.slow
def test_a_late_field_changes_the_past_and_is_carried_to_now(walk: OnlineLog) -> None:
    """However late it comes, the state of now is the one that it leads to in time."""
    now = []
    for late in (0.0, 0.45):
        at: list[State] = []

        def watch(navigator: Navigator, time: float, at: list[State] = at) -> None:
            if time == 9.25:
                at.append(navigator.state(9.2))

        navigate(walk, NavigatorSettings("ekf", rate="imu"), late=late, watch=watch)
        now.append(at[0])
    before = now[1]
    navigator, _ = navigate(walk, IMU, late=0.45)
    assert navigator.losses == {}
    # 8.75 s has been heard of in time, and not yet where it is late.
    assert before.position_sigma > 1.2 * now[0].position_sigma
    apart_m = np.linalg.norm(before.position_world - now[0].position_world)
    assert 1e-5 < apart_m < 4.0 * before.position_sigma


@pytest.mark.slow
def test_the_counter_rises_once_where_the_pose_is_found_again(walk: OnlineLog) -> None:
    holed = replace(walk, fields=silent(walk.fields, [0, 1, 2, 3], 7.0, 10.0))
    navigator, states = propagated(holed, replace(IMU, correction_time=0.5))
    selected = navigator.counts["found by a fix"] + navigator.counts["lost and found again"]
    assert navigator.state().reset_counter == states[-1].reset_counter <= max(selected, 1)
    assert propagated(walk, IMU)[1][-1].reset_counter == 0


@pytest.mark.slow
def test_a_pipe_tells_the_state_of_now(walk: OnlineLog, tmp_path: Path) -> None:
    save_site(walk.site, tmp_path / "site.yaml")
    command = [sys.executable, "-m", "magfusion", "navigate", "-", "--estimator", "ekf"]
    command += ["--site", str(tmp_path / "site.yaml"), "--rate", "100", "--horizon", "0.02"]
    source = tmp_path / "records"
    with source.open("wb") as sink:
        log = Log("walk", 0, "test", walk.imu, None, walk.fields)
        run_replay(log, sink, "json", realtime=False)
    with source.open("rb") as records:
        done = subprocess.run(command, stdin=records, capture_output=True, check=True, timeout=120)
    reported = [json.loads(line) for line in done.stdout.splitlines()]
    states = [line for line in reported if line["started"]][1:]  # the first is that of the start
    time = np.array([state["time"] for state in states])
    assert np.diff(time) == pytest.approx(0.01, abs=1e-9)
    assert (time - 0.02) * 100.0 == pytest.approx(np.round((time - 0.02) * 100.0), abs=1e-6)
    assert all(0.0 < s["carried_s"] < 1.0 and s["reset_counter"] == 0 for s in states)
    true = walk.motion.trajectory(time).position_world
    error = np.linalg.norm([s["position"] for s in states] - true, axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.006  # m
