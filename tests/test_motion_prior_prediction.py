"""A look ahead without an IMU: the motion prior says where, and how far off it may be."""

import numpy as np
import pytest
from test_without_imu import by_chance, nees

from magfusion.estimation.graph.propagation import propagate
from magfusion.estimation.graph.state import as_trajectory
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.model.platform_motion import MotionPrior
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.without_imu import on_motion_prior


def filtered(site: Site, log: Log, horizon: float) -> tuple[Navigator, Trajectory]:
    """Return a filter that took in a log, and what it told of a time ahead."""
    assert log.fields is not None
    navigator = Navigator(site, NavigatorSettings("ekf", rate="imu", horizon=horizon))
    for one in log.fields.epochs():
        navigator.add_fields(one)
    return navigator, as_trajectory([*navigator.take_propagated()])


def at_epochs(states: Trajectory, truth: Trajectory) -> Trajectory:
    """Return the states at times of the truth."""
    there = np.min(np.abs(states.time[:, None] - truth.time), axis=1) < 1e-6
    return Trajectory(**{k: v[there] for k, v in vars(states).items() if v is not None})


@pytest.mark.slow
def test_it_leads_where_small_steps_lead_and_has_their_covariance() -> None:
    """The factor of the graph, integrated at 2 kHz, and one look of a third of a second."""
    prior, length = MotionPrior(0.7, 1.3), 0.3
    site, log = by_chance(3, 6.5, prior)
    navigator, _ = filtered(site, log, 0.0)
    now = navigator.state()
    then = navigator.state(now.time + length)
    time = np.arange(now.time - 0.01, now.time + length + 0.01, 5e-4)
    none = np.zeros((len(time), 3))
    known = propagate(now, ImuSamples(time, none, none), then.time, on_motion_prior(site), 0.0)
    assert then.position_world == pytest.approx(known.state.position_world, abs=1e-5)
    assert then.world_from_body == pytest.approx(known.state.world_from_body, abs=1e-5)
    scale = np.sqrt(np.diagonal(known.state.cov)[:9])
    separate = (then.cov - known.state.cov)[:9, :9] / np.outer(scale, scale)
    assert np.max(np.abs(separate)) < 0.03


@pytest.mark.slow
def test_the_covariance_of_a_look_ahead_holds_however_long_the_log() -> None:
    prior, result = MotionPrior(0.3, 2.0), []
    for seed in (0, 1, 2):
        site, log = by_chance(seed, 10.0, prior)
        assert log.truth is not None
        _, states = filtered(site, log, 0.1)
        result.append(nees(at_epochs(states, log.truth), log.truth))
    assert 3.5 < np.mean(result) < 9.0, result
