"""Integrity with aiding sensors: levels in a gap, rejected samples, sensors that contradict."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from aiding_site import aided_site
from test_aiding import ROOM, WHEELS, _simulated

import magfusion as mf
from magfusion.estimation.batch.settings import SmootherSettings
from magfusion.estimation.graph.state import MOTION, State
from magfusion.estimation.integrity.smoothed_separation import separate_sensors
from magfusion.estimation.measurements.aiding_samples import aiding_measurement
from magfusion.estimation.online.corrected import corrected
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.estimation.online_integrity.aiding_gate import AidingGate
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.score_epochs import Sums, new_sums
from magfusion.estimation.online_integrity.score_online import OnlineScore
from magfusion.jobs.replay import Replay, feed
from magfusion.model.aiding import AidingSamples, AidingSensor, sensor_named
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.model.trust import Risk
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests

SILENT = (8.0, 17.0)  # s; the beacons


def coarse_site() -> Site:
    """Return a site with wheels and an IMU that drifts by 10 m within 6 s."""
    site = aided_site(WHEELS)
    imu = replace(site.platform.imu, accel_noise=1.0, accel_bias_sigma=0.5)
    return replace(site, platform=replace(site.platform, imu=imu))


def silenced() -> SimulatedLog:
    """Return a log whose beacons are silent for a while."""
    config = SimulationConfig(
        ROOM, 22.0, motion="drive", speed=1.0, rests=Rests(2.0, 22.0, 0.0), perturb=False
    )
    site = coarse_site()
    weak = tuple(
        replace(b, coils=tuple(replace(c, moment_beacon=1e-6 * c.moment_beacon) for c in b.coils))
        for b in site.beacons
    )
    simulated, without = (
        simulate_log(one, config, np.random.default_rng(1))
        for one in (site, replace(site, beacons=weak))
    )
    whole, static = simulated.log.waveform, without.log.waveform
    assert whole is not None
    assert static is not None
    silent = (whole.time > SILENT[0]) & (whole.time < SILENT[1])
    measured = np.where(silent[:, None], static.measured_sensor, whole.measured_sensor)
    log = replace(simulated.log, waveform=replace(whole, measured_sensor=measured))
    return replace(simulated, log=log)


@pytest.mark.slow
def test_a_gap_that_only_wheels_bridge_has_no_level() -> None:
    simulated = silenced()
    navigator = Navigator(coarse_site(), NavigatorSettings(estimator="ekf", risk=Risk()))
    states = []
    for _, piece in Replay(simulated.log).pieces():
        feed(navigator, piece)
        states += navigator.take()
    time = np.array([state.time for state in states])
    level = np.array([state.judgement.protection_level_m or np.nan for state in states])
    error = np.linalg.norm(
        [s.position_world for s in states] - simulated.motion.position_world(time), axis=1
    )
    before, after = time < SILENT[0] - 1.0, time > SILENT[1] + 3.0
    late = (time > SILENT[0] + 5.0) & (time < SILENT[1] - 1.0)
    assert np.all(np.isfinite(level[before][-5:]))
    assert np.all(np.isnan(level[late]))
    assert np.max(error[late]) < 0.5  # m; the wheels do bridge it
    assert np.mean(np.isfinite(level[after])) > 0.9
    known = np.isfinite(level)  # by the IMU at first
    assert np.all(error[known] < level[known])


@pytest.mark.slow
def test_a_smoothed_log_is_separated_from_that_without_the_wheels() -> None:
    site, log = aided_site(WHEELS), _simulated(WHEELS, duration=8.0).log
    settings = SmootherSettings(loss=None, tune=False)
    result = mf.smooth(log, site, settings)
    without = mf.smooth(replace(log, aiding={}), site, settings)
    estimate = separate_sensors(result)
    assert estimate is not None
    assert without.states.pose_cov is not None
    shared = np.isin(result.states.time, without.states.time)
    cov = without.states.pose_cov[np.isin(without.states.time, result.states.time)]
    sigma = np.sqrt(np.einsum("nii->ni", cov))
    own = np.sqrt(np.einsum("nii->ni", estimate.subset_cov[shared, 0]))
    np.testing.assert_allclose(own, sigma, rtol=0.05)
    moved = without.states.position_world[np.isin(without.states.time, result.states.time)]
    moved = moved - result.states.position_world[shared]
    body = np.einsum("nji,nj->ni", result.states.world_from_body[shared], moved)
    step = estimate.step[shared, 0, 3:]
    assert np.max(np.abs(body - step) / sigma[:, 3:]) < 0.2


def _scored(*, used: bool, rejected: bool) -> Sums:
    """Return the sums of a score after an epoch whose wheels are 10 % too fast."""
    site = aided_site(WHEELS)
    score = OnlineScore(site, (), (), static=False)
    size, cov = len(score.targets.unit), np.diag(np.repeat([0.02, 0.05, 0.05, 0.02, 0.002], 3) ** 2)
    none = np.zeros((size, size)), np.zeros(size), np.zeros((MOTION, size))
    score._sums = new_sums(*none, 0.0, cov)
    velocity = np.array([1.0, 0.0, 0.0])
    rest = np.zeros(3), np.zeros(3), initial_calibration(site, 0.0), cov
    states = [State(t, np.eye(3), t * velocity, velocity, *rest) for t in (0.0, 0.1)]
    samples = AidingSamples("velocity", np.array([0.1]), np.array([[1.1, np.nan, np.nan]]))
    wheels = aiding_measurement(WHEELS, samples)
    imu = ImuSamples(np.array([0.05]), np.zeros((1, 3)), np.array([[0.0, 0.0, site.gravity]]))
    score.predict(states[0], states[1], np.eye(MOTION), np.zeros((MOTION, MOTION)), imu)
    score.measured([wheels] if used else [], states[1], [wheels] if rejected else [])
    sums = score.settle()
    assert sums is not None
    own = slice(size)  # without steps of the biases
    scored = sums.information[own, own], sums.gradient[own], sums.response[:, own]
    return new_sums(*scored, 0.0, cov)


def test_rejected_samples_are_scored_without_a_gain() -> None:
    nothing, rejected = _scored(used=False, rejected=False), _scored(used=False, rejected=True)
    used, both = _scored(used=True, rejected=False), _scored(used=True, rejected=True)
    # They inform on the parameters of their sensor, but did not move the state.
    assert np.any(rejected.gradient != nothing.gradient)
    assert np.trace(rejected.information) > np.trace(nothing.information)
    np.testing.assert_array_equal(rejected.response, nothing.response)
    np.testing.assert_allclose(both.response, used.response, rtol=1e-12, atol=1e-15)
    assert np.any(used.response != nothing.response)


def test_a_named_parameter_hides_no_other_sensor_that_contradicts() -> None:
    gate = AidingGate(aided_site(WHEELS), (), Counter())
    gate.rejected_share = {"wheels": 0.5, "anchor": 0.4}
    every = gate.assessed(Judgement(), 10.0, ())
    assert [f.code for f in every.findings] == ["aiding_disagrees"] * 2
    others = gate.assessed(Judgement(), 10.0, ("wheels",)).findings
    assert [f.text.split()[0] for f in others] == ["anchor"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "unit"), [("level", -1.0), ("visual", 1.0 / 3.6)])
def test_a_unit_is_named_and_undone_online(name: str, unit: float) -> None:
    site = aided_site(
        AidingSensor("visual", "velocity", 0.02), AidingSensor("level", "height", 0.02)
    )
    config = SimulationConfig(ROOM * [1.0, 1.0, 1.5], 25.0, motion="walk")
    simulated = simulate_log(site, config, np.random.default_rng(1))
    own = simulated.log.aiding[name]
    wrong = {**simulated.log.aiding, name: replace(own, value=own.value / unit)}
    navigator = Navigator(site, NavigatorSettings(estimator="ekf"))
    for _, piece in Replay(replace(simulated.log, aiding=wrong)).pieces():
        feed(navigator, piece)
        navigator = corrected(navigator)
    (finding,) = navigator.corrected
    assert finding.code == "aiding_units"
    assert finding.text.startswith(f"{name} contradicts the estimate as declared")
    assert sensor_named(navigator.site.aiding, name).unit == pytest.approx(unit, rel=1e-5)
    state = navigator.state
    assert state is not None
    assert [f.code for f in navigator.judgement.reasons] == ["aiding_units"]
