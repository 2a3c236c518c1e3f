"""A motion prior holds few epochs together: what they have in common weighs no more than that."""

from dataclasses import replace

import numpy as np
import pytest
from test_without_imu import A_HAND, exact, nees

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.graph.state import State, as_trajectory
from magfusion.estimation.measurements.model_error import epochs_sharing_error_at, held_by_prior
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.model.parameters import initial_calibration
from magfusion.model.platform_motion import MotionPrior
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.without_imu import on_motion_prior
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.disturbance import draw_bending
from magfusion.simulation.log import EPOCH_NS, simulate_fields
from magfusion.simulation.motion import Rests, random_walk_motion

HZ, ERROR = 30.0, 0.01
SPEEDS = {"still": 0.001, "slow": 0.1, "fast": 1.0}  # m/s


def bent(seed: int, speed: float, duration: float = 8.0) -> tuple[Site, Log]:
    """Return a log of a world that has just the smooth model error that is declared."""
    rng = np.random.default_rng(seed)
    site = replace(exact(A_HAND), model_error=ERROR, model_error_length=1.0)
    rests = Rests(0.0, duration, 0.0)
    turns = 0.3 * min(1.0, speed / 0.1)
    motion = random_walk_motion(rng, duration, DEMO_BOX_WORLD, speed, turns, turns, rests)
    truth = motion.trajectory(np.arange(0.2, duration, 1.0 / HZ))
    bending = draw_bending(rng, ERROR / np.sqrt(3.0), site.model_error_length, len(site.beacons))
    fields = simulate_fields(site, truth, 1e-10, rng, bending=bending)
    fields = replace(fields, window=np.full(len(fields), 1.0 / HZ))
    return site, Log("bent", EPOCH_NS, "test", ImuSamples.empty(), fields=fields, truth=truth)


def followed(site: Site, log: Log) -> Trajectory:
    """Return the states of a filter."""
    assert log.fields is not None
    navigator = Navigator(site, NavigatorSettings(estimator="ekf"))
    for one in log.fields.epochs():
        navigator.add_fields(one)
    return as_trajectory([*navigator.take()])


def sigma_of(states: Trajectory) -> float:
    """Return the sigma of the position (m)."""
    assert states.pose_cov is not None
    return float(np.sqrt(np.mean(np.trace(states.pose_cov[:, 3:, 3:], axis1=1, axis2=2))))


@pytest.mark.slow
def test_sigmas_hold_and_are_not_too_wide_whatever_the_motion() -> None:
    result = {}
    for kind, speed in SPEEDS.items():
        runs = (bent(seed, speed) for seed in range(5))
        result[kind] = np.mean([nees(followed(site, log), log.truth) for site, log in runs])
    assert all(1.0 < one < 12.0 for one in result.values()), result


@pytest.mark.slow
@pytest.mark.parametrize("kind", SPEEDS)
def test_a_whole_log_claims_what_the_filter_claims(kind: str) -> None:
    """Offline an error that is constant in place is considered, and no epochs are counted."""
    result = []
    for seed in (10, 11):
        site, log = bent(seed, SPEEDS[kind])
        states = smooth(log, site).states
        result.append(nees(states, log.truth))
        assert 0.7 < sigma_of(states) / sigma_of(followed(site, log)) < 1.5
    assert 0.5 < np.mean(result) < 12.0, result


def test_what_a_prior_holds_is_what_its_steady_filter_holds() -> None:
    """The covariance of a filter of white acceleration, which Riccati's equation gives."""
    place, step, density = np.array([3.0, 2.5, 1.1]), 0.02, 0.02
    prior = MotionPrior(density, 1e3)  # whatever turns is forgotten at once
    site = on_motion_prior(replace(exact(prior), model_error=0.01))
    fixed = held_by_prior(site, place, step)
    far = max(float(np.linalg.norm(b.position_world - place)) for b in site.beacons)
    own = (0.01 * far) ** 2
    move = np.array([[1.0, step], [0.0, 1.0]])
    walk = density**2 * np.array([[step**3 / 3.0, step**2 / 2.0], [step**2 / 2.0, step]])
    cov = np.eye(2)
    for _ in range(3000):
        cov = move @ cov @ move.T + walk
        gain = cov[:, 0] / (cov[0, 0] + fixed * own)
        cov -= np.outer(gain, cov[0])
    assert fixed > 5.0
    assert cov[0, 0] == pytest.approx(own, rel=0.15)


@pytest.mark.parametrize("density", [None, 1e-6])
def test_with_an_imu_or_a_weak_prior_all_of_a_rest_are_held(density: float | None) -> None:
    site = demo_site()
    if density is not None:
        free_parameters = replace(
            exact(MotionPrior(density, density)), model_error=site.model_error
        )
        site = on_motion_prior(free_parameters)
    zero, calibration = np.zeros(3), initial_calibration(site, 0.0)
    state = State(0.0, np.eye(3), zero, zero, zero, zero, calibration, np.eye(15))
    assert epochs_sharing_error_at(state, 0.1) == pytest.approx(200.0, rel=0.01)
