"""Whole rests in the smoother: what the platform does in them is known, and said once."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Refuse, run_command
from far_and_weak import FAR_AWAY, RATE_HZ, far_site, monitored_log
from rests_smoothed import Config, run

from magfusion.estimation.batch.log_graph import overlap
from magfusion.estimation.graph.measurement import Rows
from magfusion.estimation.graph.state import States
from magfusion.estimation.measurements.zero_rate import ZeroRate, without_bias, zero_rate
from magfusion.estimation.rests.stationary_integration import integrate_rests
from magfusion.files.log import write_log
from magfusion.files.site import save_site
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.simulation.motion import Rests
from magfusion.units import Array


def epochs(window: list[float], time: list[float]) -> FieldSamples:
    count = len(time)
    return FieldSamples(
        np.array(time),
        np.array(window),
        (("A", 0),),
        np.zeros((count, 1, 3), dtype=complex),
        np.tile(np.eye(3), (count, 1, 1, 1)),
    )


def test_rests_of_unequal_length_share_no_sample() -> None:
    rests = epochs([3600.0, 3600.0, 100.0], [1800.0, 5500.0, 7400.0])
    assert rests.of_rests
    assert overlap(rests) == 1.0
    assert rests.is_stationary(np.array([10.0, 3650.0, 7320.0, 7400.0])).tolist() == [1, 0, 0, 1]
    windows = epochs([0.4, 0.4, 0.4], [0.2, 0.4, 0.6])
    assert not windows.of_rests
    assert overlap(windows) == pytest.approx(2.0)
    assert not windows.is_stationary(np.array([0.2])).any()


def test_a_zero_rate_is_the_mean_of_what_the_gyroscope_shows_in_the_rest_alone() -> None:
    rng, time = np.random.default_rng(0), np.arange(0.0, 40.0, 0.01)
    gyro = np.array([1e-3, -2e-3, 3e-3]) + 1e-3 * rng.standard_normal((len(time), 3))
    gyro[(time > 20.0) & (time < 25.0)] += 1.0  # it turns
    imu = ImuSamples(time, gyro, np.zeros_like(gyro))
    at, offset = np.array([1.0, 10.0, 20.0]), np.zeros(3)
    within = np.zeros(3), np.full(3, 20.0)
    result = zero_rate(np.arange(3), at, within, imu, offset, 1e-4)
    assert result is not None
    np.testing.assert_allclose(result.measured_body[2], np.mean(gyro[1900:2000], axis=0))
    np.testing.assert_allclose(result.sigma[1], 1e-4 / np.sqrt(2.0))
    known = without_bias(imu, np.array([0.0, 25.0]), np.array([20.0, 40.0]))
    for rows in (slice(0, 2000), slice(2500, 4000)):
        assert np.max(np.abs(np.mean(known.gyro_body[rows], axis=0))) < 1e-6
    assert np.mean(known.gyro_body[2100:2400]) == pytest.approx(1.0, abs=1e-3)


def test_an_hour_in_one_place_is_two_epochs_and_halving_loses_nothing() -> None:
    built = monitored_log(far_site(), 240.0, 3, FAR_AWAY, 0.0)
    log = replace(built.log, reference=None)
    one, two = (integrate_rests(log, far_site(), least=least) for least in (1, 2))
    assert (len(one.fields), len(two.fields)) == (1, 2)
    weight = np.linalg.inv(two.fields.phasor_cov)
    together = np.linalg.inv(np.sum(weight, axis=0))
    share = np.trace(together, axis1=1, axis2=2) / np.trace(
        one.fields.phasor_cov[0], axis1=1, axis2=2
    )
    assert np.all((share > 0.5) & (share < 2.0))


@pytest.mark.slow
def test_smooth_integrates_rests_and_refuses_what_it_cannot(tmp_path: Path, refuse: Refuse) -> None:
    site = far_site(2e4)
    config = SimulationConfig(
        box_world=np.array([[-20.0, -20.0, -3.0], [20.0, 20.0, 3.0]]),
        duration=160.0,
        rests=Rests(start=60.0, move=10.0, pause=60.0),
        imu_rate_hz=50.0,
        magnetometer_rate_hz=RATE_HZ,
        perturb=False,
    )
    built = simulate_log(site, config, np.random.default_rng(4))
    write_log(built.log, tmp_path / "log")
    save_site(site, tmp_path / "log" / "site.yaml")
    run_command("smooth", tmp_path / "log", "--at-rest", "-o", tmp_path / "run")
    reported = json.loads((tmp_path / "run" / "report.json").read_text())
    assert reported["rests"] >= 2
    assert reported["verdict"] == "trustworthy"
    # Of the path between rests the inertial stream alone tells, as it never moves far.
    assert reported["ate_m"] < 3.0
    assert reported["nees_mean"] < 16.0
    log = tmp_path / "log"
    assert "integrates one log" in refuse("smooth", log, log, "--at-rest", "-o", "x")
    assert "omit --earth and" in refuse("smooth", log, "--at-rest", "--earth", "-o", "x")


def test_the_derivative_of_a_zero_rate_is_that_of_differences() -> None:
    rng = np.random.default_rng(2)
    bias, measured = rng.normal(0.0, 1e-2, (2, 6)), rng.normal(0.0, 1e-3, (2, 3))
    calibration = initial_calibration(far_site(), 0.0)
    rate = ZeroRate(np.arange(2), measured, np.array([1e-3, 2e-3]))

    def at(own: Array) -> Rows:
        states = States(
            np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.zeros((2, 3)), lambda: own
        )
        return rate.linearize(states, calibration, ())

    rows = at(bias)
    assert rows.by_bias is not None
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        slope = (at(bias + step).error - at(bias - step).error) / 2e-6
        np.testing.assert_allclose(rows.by_bias[..., k], slope, atol=1e-4)


@pytest.mark.slow
def test_all_rests_in_one_solution_know_more_than_each_and_no_more_than_is_so() -> None:
    alone, _, together = run(Config(rest=150.0, runs=4, seed=30))
    assert alone.findings == together.findings == 12
    assert together.position_m < alone.position_m
    assert 2.0 < together.nees < 11.0  # of four logs
