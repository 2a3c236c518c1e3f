"""The online score among many beacons: it asks of those that are heard as if it asked of all."""

from dataclasses import replace

import many_beacons
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import MOTION, State, states_of
from magfusion.estimation.integrity.score import Score
from magfusion.estimation.measurements.linearization import relinearized
from magfusion.estimation.measurements.phasors import FieldPhasors, field_phasors
from magfusion.estimation.online.navigator import Navigator
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.estimation.online_integrity.score_epochs import MEMORY, _linearized
from magfusion.estimation.online_integrity.score_online import OnlineScore
from magfusion.estimation.online_integrity.score_targets import ScoreTargets
from magfusion.model.detection_range import are_many
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.log import simulate_fields
from magfusion.units import Array

NOW = np.zeros(1, dtype=np.int64)
STEP = 0.4  # s
NO_OWNER = ImuSamples(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))


def state_at(site: Site, time: float, rng: np.random.Generator) -> State:
    turn = Rotation.from_rotvec(rng.normal(0.0, 0.3, 3)).as_matrix()
    root = rng.normal(0.0, 0.01, (MOTION, MOTION))
    return State(
        time=time,
        world_from_body=turn,
        position_world=np.array([10.0 + time, 8.0, 1.0]),
        velocity_world=np.array([1.0, 0.0, 0.0]),
        accel_bias_body=np.zeros(3),
        gyro_bias_body=np.zeros(3),
        calibration=initial_calibration(site, 0.0),
        cov=root @ root.T,
    )


def phasors_at(
    state: State, site: Site, detected: list[int], rng: np.random.Generator
) -> FieldPhasors:
    at = np.array([state.time]), state.world_from_body[None], state.position_world[None]
    poses = Trajectory(*at)
    samples = simulate_fields(site, poses, 1e-9, rng)
    kept = np.zeros(len(site.channels), dtype=bool)
    kept[detected] = True
    result = np.where(kept[:, None], samples.phasor_sensor, np.nan)
    samples = replace(samples, phasor_sensor=result)
    return field_phasors(site, samples, NOW, poses, np.zeros((1, 3)), np.zeros(1), 1.0)


def nothing_yet(score: OnlineScore) -> Score:
    size = len(score.targets.unit)
    none = np.zeros((size, 0))
    return Score(
        score.targets.fixed_blocks,
        np.zeros((size, size)),
        np.zeros(size),
        none,
        np.zeros((1, MOTION, size)),
        none.T,
    )


def test_who_comes_later_is_asked_as_if_it_had_been_there_all_the_time() -> None:
    rng = np.random.default_rng(3)
    site = many_beacons.building(rng, 6, 5, many_beacons.reused_hz)
    assert are_many(site)
    every, some = (OnlineScore(site, (), (), static=False) for _ in range(2))
    every._detected_at = dict.fromkeys((b.name for b in site.beacons), 0.0)
    before = state_at(site, 0.0, rng)
    every.begin(nothing_yet(every), before)
    some._detected_at = dict.fromkeys((b.name for b in site.beacons[:3]), 0.0)
    some.begin(nothing_yet(some), before)
    for k in range(6):
        state = state_at(site, STEP * (k + 1), rng)
        result = phasors_at(state, site, [k, k + 1, k + 2], rng)
        transition = np.eye(MOTION)
        transition[3:6, 6:9] = STEP * np.eye(3)
        for score in (every, some):
            score.predict(before, state, transition, np.zeros((MOTION, MOTION)), NO_OWNER)
            score.measured([result], state)
        before = state
    assert every._sums is not None
    assert some._sums is not None
    names = [b.name for b in site.beacons]
    assert some.targets.names == tuple(names[:8])
    assert every.targets.names == tuple(names)
    here, there = some.targets.among(every.targets)
    assert len(here) == len(some.targets.unit)
    whole, part = every._sums, some._sums
    size = np.max(np.abs(whole.information))
    expected = whole.information[np.ix_(there, there)]
    np.testing.assert_allclose(part.information[np.ix_(here, here)], expected, atol=1e-9 * size)
    np.testing.assert_allclose(part.gradient[here], whole.gradient[there], rtol=1e-6)
    np.testing.assert_allclose(part.response[:, here], whole.response[:, there], atol=1e-12)
    silent = np.setdiff1d(np.arange(len(whole.gradient)), there)
    assert not np.any(whole.information[silent])


def test_undetected_beacons_have_no_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, detected, solve = np.random.default_rng(5), [0, 1, 2], np.linalg.solve
    site = many_beacons.building(rng, 6, 5, many_beacons.reused_hz)
    state, sizes = state_at(site, 0.0, rng), list[int]()

    def recorded(matrix: Array, right: Array) -> Array:
        sizes.append(len(matrix))
        return np.asarray(solve(matrix, right))

    epoch = phasors_at(state, site, detected, rng)
    with monkeypatch.context() as patch:
        patch.setattr(np.linalg, "solve", recorded)
        assert relinearized(epoch, state, ()) is not None
    assert max(sizes) <= 6 * len(detected)
    targets = ScoreTargets(site, (), (), static=False)
    rows = _linearized([epoch], [state], targets)
    every = epoch.linearize(states_of([state]), state.calibration, targets.parameters)
    np.testing.assert_array_equal(rows.error, every.error[:, detected])
    assert rows.by_calibration is not None
    assert every.by_calibration is not None
    np.testing.assert_array_equal(rows.by_calibration, every.by_calibration[:, detected])
    assert np.count_nonzero(every.by_calibration) == np.count_nonzero(rows.by_calibration)


def test_nobody_is_asked_of_long_after_it_was_heard() -> None:
    rng = np.random.default_rng(4)
    site = many_beacons.building(rng, 6, 5, many_beacons.reused_hz)
    score = OnlineScore(site, (), (), static=False)
    score._detected_at = dict.fromkeys((b.name for b in site.beacons[:3]), 0.0)
    score.begin(nothing_yet(score), state_at(site, 0.0, rng))
    for time, detected in ((1.0, 1), (MEMORY + 2.0, 10)):
        state = state_at(site, time, rng)
        score.measured([phasors_at(state, site, [detected], rng)], state)
    assert score.targets.names == (site.beacons[10].name,)


@pytest.mark.slow
def test_a_beacon_that_is_met_later_and_stands_elsewhere_is_named() -> None:
    site = many_beacons.building(np.random.default_rng(1), 20, 10, many_beacons.reused_hz)
    log = many_beacons.walked(site, 0.9, many_beacons.WING_WORLD, 600.0, 2)
    assert log.truth is not None
    time, places = log.truth.time, np.array([b.position_world for b in site.beacons])
    separate = np.linalg.norm(log.truth.position_world[:, None] - places, axis=2)
    far_first = np.min(separate[time < 12.0], axis=0) > 9.0
    met = int(np.argmin(np.where(far_first, np.min(separate[time < 50.0], axis=0), np.inf)))
    wrong = list(site.beacons)
    moved = wrong[met].position_world + np.array([0.05, 0.0, 0.0])
    wrong[met] = replace(wrong[met], position_world=moved)
    navigator = Navigator(replace(site, beacons=tuple(wrong)), NavigatorSettings())
    assert log.waveform is not None
    navigator.add_imu(log.imu.time, log.imu.gyro_body, log.imu.accel_body)
    navigator.add_magnetometer(log.waveform.time, log.waveform.measured_sensor)
    navigator.take()
    findings = [f.text for f in navigator.summary.trust.findings if f.code == "beacon_pose"]
    assert findings
    assert wrong[met].name in findings[0]
