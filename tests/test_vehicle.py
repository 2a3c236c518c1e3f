"""A vehicle that leaves the field drives on by its wheels, and its covariance says so."""

import numpy as np
import pytest
from vehicle import Config, report, run_vehicle, summary

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("method", ["ekf", "smooth"])
def test_wheels_lead_through_a_gap(method):
    """Of one draw the NEES of six numbers is below 25 (one in 3,000), and the error below 2 %."""
    row = run_vehicle(Config(1, "wheels", method), np.random.default_rng(11))
    assert row.way_m > 140.0  # m without a beacon
    assert row.error_m < 0.02 * row.way_m
    assert 0.02 < row.sigma_m < 3.0  # m
    assert row.nees < 25.0
    assert row.step_sigma < 3.0
    assert f"{row.error_m:6.2f} m" in report([row])
    assert summary([row])["confident"] == 0.0


def test_without_wheels_the_position_is_wide_or_lost():
    row = run_vehicle(Config(1, "none", "ekf"), np.random.default_rng(11))
    assert row.nees < 25.0 or row.sigma_m > 3.0 or row.verdict == "failed"


@pytest.mark.parametrize("aiding", ["ranges", "marks"])
def test_other_sensors_bound_the_error(aiding):
    row = run_vehicle(Config(1, aiding, "ekf"), np.random.default_rng(11))
    assert row.error_m < 0.02 * row.way_m
    assert row.nees < 25.0
