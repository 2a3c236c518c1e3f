"""A bias may walk as little as it likes: a random constant is a legitimate model."""

from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import pytest
from online_log import navigate, online_log

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.graph.dead_reckoning_error import step_noise
from magfusion.estimation.graph.preintegration import bias_walks
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.online.navigator import NavigatorSettings
from magfusion.model.platform_motion import ImuModel
from magfusion.model.site import Site
from magfusion.model.trust import Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulatedLog, SimulationConfig, simulate_log

WALKS = [(0.0, 0.0), (1e-12, 1e-12), (3e-8, 1e-4), (1e-5, 1e-9)]  # rad/s and m/s^2, /sqrt(s)


def with_walks(site: Site, walks: tuple[float, float]) -> Site:
    imu = replace(site.platform.imu, gyro_bias_walk=walks[0], accel_bias_walk=walks[1])
    return replace(site, platform=replace(site.platform, imu=imu))


@cache
def recorded() -> SimulatedLog:
    """Return a walk with constant biases and an exact survey."""
    config = SimulationConfig(DEMO_BOX_WORLD, 12.0, "walk", perturb=False, time_offset=0.0)
    return simulate_log(
        with_walks(demo_site(coil_radius=None), (0.0, 0.0)), config, np.random.default_rng(4)
    )


@pytest.mark.parametrize("walks", WALKS)
def test_a_log_is_smoothed_with_every_walk(walks: tuple[float, float]) -> None:
    log, site = recorded().log, with_walks(demo_site(coil_radius=None), walks)
    result, trust = judge_result(smooth(log, site), log)
    errors = trajectory_errors(result.states, log.truth)
    assert trust.verdict is Verdict.TRUSTWORTHY
    assert errors.ate < 0.005  # m
    assert errors.nees is not None
    assert np.mean(errors.nees) < 9.0


@pytest.mark.parametrize("estimator", ["ekf", "smoother"])
def test_a_log_is_navigated_with_constant_biases(estimator: Literal["ekf", "smoother"]) -> None:
    walk = online_log(3, 12.0)
    _, states = navigate(
        replace(walk, site=with_walks(walk.site, (0.0, 0.0))), NavigatorSettings(estimator)
    )
    assert len(states) > 10
    assert all(state.verdict is Verdict.TRUSTWORTHY for state in states)
    assert walk.errors(states).ate < 0.02  # m


def test_the_least_walk_hides_below_the_white_noise_for_minutes() -> None:
    imu = ImuModel(3e-4, 3e-3, 0.0, 0.0, 5e-3, 0.05)
    gyro, accel = bias_walks(imu)
    minutes = 200.0  # s
    assert gyro**2 * minutes**3 / 3.0 < 0.2 * imu.gyro_noise**2 * minutes
    assert accel**2 * minutes**3 / 3.0 < 0.2 * imu.accel_noise**2 * minutes
    own = step_noise(np.array([0.2]), imu, np.zeros(1, dtype=np.bool_))[0]
    assert np.linalg.cond(own) < 1e12
    declared = replace(imu, gyro_bias_walk=1e-5, accel_bias_walk=1e-4)
    assert bias_walks(declared) == (1e-5, 1e-4)
