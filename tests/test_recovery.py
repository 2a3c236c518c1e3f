"""A lost platform at a fix: what is kept of the state before, and how uncertain it is."""

import numpy as np
import pytest
from small_problem import small_log

from magfusion.estimation.graph.state import ACCEL_BIAS, GYRO_BIAS, State
from magfusion.estimation.online_integrity.recovery import BIAS_LIMIT, agreed_fix, restarted
from magfusion.model.parameters import initial_calibration

SMALL = small_log(2, epochs=4, perturb=False)
IMU = SMALL.site.platform.imu


def _state(accel_bias: float) -> State:
    bias, cov = np.array([accel_bias, 0.0, 0.0]), 1e-8 * np.eye(15)
    calibration = initial_calibration(SMALL.site, float(SMALL.fields.time[0]))
    return State(0.5, np.eye(3), np.zeros(3), np.zeros(3), bias, np.zeros(3), calibration, cov)


@pytest.mark.parametrize(("sigmas", "kept"), [(0.5, 1.0), (1.5 * BIAS_LIMIT, 0.0)])
def test_plausible_biases_are_kept_as_uncertain_as_declared(sigmas: float, kept: float) -> None:
    before = _state(sigmas * IMU.accel_bias_sigma)
    fix = agreed_fix(SMALL.fields.rows(slice(0, 1)), before.calibration)
    assert fix is not None
    after = restarted(before, fix)
    truth = SMALL.truth.position_world[0]
    assert np.linalg.norm(after.position_world - truth) < 0.02  # m
    np.testing.assert_allclose(
        after.accel_bias_body, kept * before.accel_bias_body, rtol=1e-12, atol=1e-15
    )
    for columns, sigma in ((ACCEL_BIAS, IMU.accel_bias_sigma), (GYRO_BIAS, IMU.gyro_bias_sigma)):
        np.testing.assert_allclose(
            after.cov[columns, columns], sigma**2 * np.eye(3), rtol=1e-12, atol=1e-20
        )
        assert not after.cov[:9, columns].any()
    assert before.cov[9, 9] == 1e-8  # not changed
