"""A platform at rest while the magnetometer is silent: batch and online know that it stands."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.batch.batch import Smoothed, smooth
from magfusion.estimation.batch.between_epochs import at_rate
from magfusion.estimation.batch.preprocessed_log import MAX_STEP
from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.online.navigator import Navigator
from magfusion.model.samples import Log, Waveform
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests

pytestmark = pytest.mark.slow
SILENT = (15.0, 50.0)  # s


def silent_log(seed: int, motion: str = "static", rests: Rests | None = None) -> Log:
    plan = SimulationConfig(DEMO_BOX_WORLD, duration=60.0, motion=motion)  # type: ignore[arg-type]
    plan = plan if rests is None else replace(plan, rests=rests)
    log = simulate_log(demo_site(coil_radius=None), plan, np.random.default_rng(seed)).log
    assert log.waveform is not None
    time = log.waveform.time
    kept = (time < SILENT[0]) | (time >= SILENT[1])
    return replace(log, waveform=Waveform(time[kept], log.waveform.measured_sensor[kept]))


@pytest.fixture(scope="module", params=[1, 2])
def resting(request: pytest.FixtureRequest) -> tuple[Log, Smoothed, Trajectory]:
    log = silent_log(request.param)
    result = smooth(log, demo_site(coil_radius=None))
    return log, result, at_rate(result, log, "imu")


def navigated(log: Log) -> Trajectory:
    navigator, field, states = Navigator(demo_site(coil_radius=None)), log.waveform, []
    assert field is not None
    for begin in np.arange(0.0, 60.0, 0.5):
        i = (log.imu.time >= begin) & (log.imu.time < begin + 0.5)
        m = (field.time >= begin) & (field.time < begin + 0.5)
        navigator.add_imu(log.imu.time[i], log.imu.gyro_body[i], log.imu.accel_body[i])
        if np.any(m):
            navigator.add_magnetometer(field.time[m], field.measured_sensor[m])
        states += navigator.take()
    return as_trajectory(states)


def test_at_rest_the_gap_costs_centimetres_and_they_are_claimed(
    resting: tuple[Log, Smoothed, Trajectory],
) -> None:
    log, _, dense = resting
    assert log.truth is not None
    assert dense.pose_cov is not None
    sigma = np.sqrt(np.diagonal(dense.pose_cov, axis1=1, axis2=2))
    inside = (dense.time > SILENT[0]) & (dense.time < SILENT[1])
    assert np.max(sigma[:, 3:]) <= 0.05  # m
    assert np.max(sigma[inside, 3:]) > 5.0 * np.min(sigma[:, 3:])
    errors = trajectory_errors(dense, log.truth)
    assert errors.inside_3_sigma is not None
    assert errors.inside_3_sigma >= 0.98
    assert len(errors.time) > 0.95 * len(dense)


def test_the_batch_errs_less_than_the_navigator(resting: tuple[Log, Smoothed, Trajectory]) -> None:
    log, _, dense = resting
    online = navigated(log)
    assert log.truth is not None
    worst = []
    for states in (dense, online):
        error = trajectory_errors(states, log.truth)
        within = (error.time > SILENT[0]) & (error.time < SILENT[1])
        worst.append(np.max(np.linalg.norm(error.position_world[within], axis=1)))
    assert worst[0] < worst[1]


def test_states_are_made_where_no_field_comes(resting: tuple[Log, Smoothed, Trajectory]) -> None:
    _, result, _ = resting
    assert np.max(np.diff(result.states.time)) <= MAX_STEP
    assert np.max(np.diff(result.fields.time)) > 30.0  # s
    np.testing.assert_array_equal(result.states.time[result.epoch], result.fields.time)


def test_between_the_epochs_the_covariance_meets_that_of_the_epochs(
    resting: tuple[Log, Smoothed, Trajectory],
) -> None:
    _, result, dense = resting
    assert dense.pose_cov is not None
    assert result.states.pose_cov is not None
    after = np.searchsorted(dense.time, result.states.time[1:-1])
    before = after - 1
    known = np.sqrt(np.diagonal(result.states.pose_cov[1:-1], axis1=1, axis2=2))
    for rows in (before, after):
        near = np.sqrt(np.diagonal(dense.pose_cov[rows], axis1=1, axis2=2))
        np.testing.assert_allclose(near, known, rtol=0.02)


def test_what_a_test_adds_to_the_covariance_is_claimed_between_the_epochs(
    resting: tuple[Log, Smoothed, Trajectory],
) -> None:
    """Four times the variance at the epochs is at least that at every sample."""
    log, result, dense = resting
    assert result.states.pose_cov is not None
    assert dense.pose_cov is not None
    wider = replace(result.states, pose_cov=4.0 * result.states.pose_cov)
    after = at_rate(replace(result, states=wider), log, "imu")
    assert after.pose_cov is not None
    added = np.trace(after.pose_cov - dense.pose_cov, axis1=1, axis2=2)
    own = np.trace(result.states.pose_cov, axis1=1, axis2=2)
    between = np.interp(dense.time, result.states.time, 3.0 * own)
    np.testing.assert_allclose(added, between, rtol=1e-6, atol=1e-12)


def test_in_motion_the_gap_is_no_rest_and_the_claim_holds() -> None:
    log = silent_log(3, "walk", Rests(start=0.0, move=60.0, pause=0.0))
    result = smooth(log, demo_site(coil_radius=None))
    dense = at_rate(result, log, "imu")
    assert log.truth is not None
    assert dense.pose_cov is not None
    sigma = np.sqrt(np.diagonal(dense.pose_cov, axis1=1, axis2=2))[:, 3:]
    assert np.max(sigma) > 0.1  # m
    errors = trajectory_errors(dense, log.truth)
    assert errors.inside_3_sigma is not None
    assert errors.inside_3_sigma >= 0.98
