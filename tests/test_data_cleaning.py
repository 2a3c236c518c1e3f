"""What is wrong with single samples of a recording is left out, counted and said."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.data_checks.data_cleaning import clean_log
from magfusion.model.trust import Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log


@pytest.mark.slow
def test_false_inertial_samples_are_left_out_and_counted() -> None:
    site, rng = demo_site(), np.random.default_rng(6)
    log = simulate_log(site, SimulationConfig(DEMO_BOX_WORLD, duration=20.0), rng).log
    assert clean_log(log, site) is log
    rows = rng.choice(np.arange(10, len(log.imu) - 10), 12, replace=False)
    gyro = log.imu.gyro_body.copy()
    gyro[rows] += rng.choice([-4.0, 4.0], (12, 3))  # rad/s
    corrupted = replace(log, imu=replace(log.imu, gyro_body=gyro))
    good = clean_log(corrupted, site)
    assert len(log.imu) - len(good.imu) >= 11
    assert not np.isin(log.imu.time[rows], good.imu.time).any()
    (finding,) = good.noticed
    assert finding.code == "imu_spikes"
    assert finding.verdict is Verdict.TRUSTWORTHY
    errors = trajectory_errors(smooth(corrupted, site).states, log.truth)
    whole = trajectory_errors(smooth(log, site).states, log.truth)
    assert errors.attitude_rmse_deg < 1.2 * whole.attitude_rmse_deg + 0.01  # deg
    assert errors.ate < 1.2 * whole.ate + 0.0005  # m


def test_a_false_magnetometer_sample_is_a_missing_one() -> None:
    site, rng = demo_site(), np.random.default_rng(7)
    log = simulate_log(site, SimulationConfig(DEMO_BOX_WORLD, duration=12.0), rng).log
    assert log.waveform is not None
    field = log.waveform.measured_sensor.copy()
    rows = np.arange(100, len(field) - 100, 400)
    field[rows, 1] += 3e-4  # T
    corrupted = replace(log, waveform=replace(log.waveform, measured_sensor=field))
    good = clean_log(corrupted, site)
    assert good.waveform is not None
    np.testing.assert_array_equal(good.waveform.time, np.delete(log.waveform.time, rows))
    assert [finding.code for finding in good.noticed] == ["false_samples"]


def test_an_imu_that_hung_is_one_that_fell_silent() -> None:
    site, rng = demo_site(coil_radius=None), np.random.default_rng(8)
    plan = SimulationConfig(DEMO_BOX_WORLD, duration=8.0, magnetometer_rate_hz=200.0)
    log = simulate_log(site, plan, rng).log
    hung = slice(700, 1000)  # 1.5 s
    gyro, accel = log.imu.gyro_body.copy(), log.imu.accel_body.copy()
    gyro[hung], accel[hung] = gyro[700], accel[700]
    corrupted = replace(log, imu=replace(log.imu, gyro_body=gyro, accel_body=accel))
    good = clean_log(corrupted, site)
    np.testing.assert_array_equal(good.imu.time, np.delete(log.imu.time, np.arange(701, 1000)))
    assert {finding.code for finding in good.noticed} == {"frozen_imu"}
    assert all(finding.verdict is Verdict.TRUSTWORTHY for finding in good.noticed)
    result = smooth(corrupted, site, SmootherSettings(tune=False))
    errors = trajectory_errors(result.states, log.truth)
    inside = (errors.time > log.imu.time[700]) & (errors.time < log.imu.time[1000])
    assert errors.nees is not None
    assert np.sum(inside) >= 7  # windows
    assert np.max(np.linalg.norm(errors.position_world[inside], axis=1)) < 0.1  # m
    assert np.mean(errors.nees[inside]) < 12.0
