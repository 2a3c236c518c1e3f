"""Protection levels with aiding sensors: none where a single sensor determines the position."""

from dataclasses import replace

import numpy as np
import pytest
from aiding_site import aided_site
from test_aiding import ROOM, WHEELS, _simulated

import magfusion as mf
from magfusion.estimation.batch.settings import SmootherSettings
from magfusion.estimation.integrity.smoothed_separation import separate_sensors
from magfusion.estimation.online.navigator import Navigator, NavigatorSettings
from magfusion.jobs.replay import Replay, feed
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
