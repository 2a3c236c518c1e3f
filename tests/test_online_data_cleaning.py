"""What is mended in a log is mended in a stream, too: an IMU that hangs, undeclared lines."""

from dataclasses import replace

import numpy as np
import pytest
from online_log import OnlineLog, navigate, online_log

from magfusion.estimation.data_checks.freeze import Freeze
from magfusion.estimation.graph.state import State, as_trajectory
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online.restored import restored
from magfusion.jobs.replay import Replay, feed
from magfusion.model.samples import ImuSamples
from magfusion.model.trust import Verdict
from magfusion.receiver.lockin_receiver import LockinReceiver
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log

EKF = NavigatorSettings("ekf")


def hung(imu: ImuSamples, begin: float, end: float) -> ImuSamples:
    """Return the stream of an IMU that repeats what it measured at a time (s)."""
    rows = np.arange(len(imu))
    rows[(imu.time > begin) & (imu.time < end)] = np.searchsorted(imu.time, begin)
    return ImuSamples(imu.time, imu.gyro_body[rows], imu.accel_body[rows])


@pytest.fixture(scope="module")
def walk() -> OnlineLog:
    return online_log(3, 16.0)


def test_an_imu_that_hangs_is_bridged_and_said(walk: OnlineLog) -> None:
    begin, end = 8.3, 13.0
    log = replace(walk, imu=hung(walk.imu, begin, end))
    behind = [0.0]

    def watch(navigator: Navigator, now: float) -> None:
        if navigator.started:
            behind.append(now - navigator.state().time)

    navigator, states = navigate(log, EKF, watch=watch)
    within = [s for s in states if begin + 0.5 < s.time < end]
    assert len(within) >= 7
    assert all([f.code for f in s.judgement.remarks] == ["frozen_imu"] for s in within)
    assert all(s.verdict is Verdict.TRUSTWORTHY for s in states)
    after = [s for s in states if s.time > end]
    assert {f.code for f in after[0].judgement.remarks} == {"gap"}
    assert not any(s.judgement.remarks for s in states if s.time < begin or s.time > end + 0.5)
    assert navigator.losses["imu sample of a sensor that hung"] == 50 * 4.7 - 1
    assert max(behind) < 1.0  # s; that the IMU hangs is known, and nothing is waited for
    nees = walk.errors(states).nees
    assert nees is not None
    assert np.max(nees) < 40.0


def test_a_rest_of_coarse_steps_is_no_freeze() -> None:
    """Three samples in four are as the one before, as of an accelerometer of coarse steps."""
    rng = np.random.default_rng(0)
    steps = (rng.random(20_000) < 0.25).cumsum()[:, None] % 7 * np.ones(3)
    time = 0.005 * np.arange(len(steps))
    freeze = Freeze()
    assert not freeze.stretches(time, steps)
    assert freeze.stretches(time + 100.0, np.repeat(steps[-1:], len(steps), axis=0))


@pytest.fixture(scope="module")
def radiated() -> SimulatedLog:
    """Return a walk among four beacons."""
    config = SimulationConfig(DEMO_BOX_WORLD, 12.0, "walk")
    return simulate_log(demo_site(coil_radius=None), config, np.random.default_rng(1))


def fed(navigator: Navigator, simulation: SimulatedLog) -> list[State]:
    replayed = Replay(replace(simulation.log, truth=None))
    for k in range(len(replayed)):
        feed(navigator, replayed.piece(k))
    return list(navigator.take())


@pytest.mark.slow
def test_undeclared_beacons_are_found_in_the_beginning_of_a_stream(radiated: SimulatedLog) -> None:
    whole = demo_site(coil_radius=None)
    navigator = Navigator(replace(whole, beacons=whole.beacons[:2]), EKF)
    states = fed(navigator, radiated)
    receiver = navigator._loop.arrived.streams[0].receiver
    assert isinstance(receiver, LockinReceiver)
    np.testing.assert_allclose(sorted(receiver.settings.lines_hz), [30.0, 35.0], atol=0.05, rtol=0)
    findings = states[0].judgement.remarks
    assert [f.code for f in findings] == ["fitted_line"]
    assert "30.0" in findings[0].text
    assert radiated.log.truth is not None
    errors = trajectory_errors(as_trajectory(states), radiated.log.truth)
    assert errors.nees is not None
    assert errors.ate < 0.02  # m; 7 cm where they leak into the tones
    assert np.mean(errors.nees) < 12.0
    again = restored(navigator.site, EKF, navigator.checkpoint())
    assert again._loop.arrived.streams[0].receiver.settings == receiver.settings


@pytest.mark.parametrize("fixed", [1, 2, 3])
@pytest.mark.parametrize("piece", [1, 7, 40])
def test_pieces_are_counted_as_single_samples_are(fixed: int, piece: int) -> None:
    """An instrument that is read faster than it measures, and hangs once."""
    rng = np.random.default_rng(3)
    samples = np.repeat(rng.normal(size=(400, 3)), fixed, axis=0)[:400]
    samples[250:330] = samples[250]
    time = 0.005 * np.arange(len(samples))
    whole, single = Freeze(), Freeze()
    result = [
        s
        for k in range(0, 400, piece)
        for s in whole.stretches(time[k : k + piece], samples[k : k + piece])
    ]
    alone = [s for k in range(400) for s in single.stretches(time[k : k + 1], samples[k : k + 1])]
    assert vars(whole).keys() == vars(single).keys()
    for name, value in vars(whole).items():
        np.testing.assert_array_equal(value, vars(single)[name], err_msg=name)
    assert bool(result) == bool(alone)
    assert max(until for _, until in result) == max(until for _, until in alone)
