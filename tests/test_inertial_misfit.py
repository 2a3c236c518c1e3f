"""Inertial residuals as large as the declared errors leave them are no contradiction."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.integrity.inertial_misfit import expected_squares, inertial_errors
from magfusion.estimation.integrity.residual_blocks import TOLERATED_INERTIAL
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

ROWS = [0, 1, 2, 6, 7, 8]  # gyro and accelerometer
BENT = 0.01  # of the fields, constant in place


@pytest.mark.slow
def test_errors_constant_in_place_are_expected_to_turn_the_states_slowly() -> None:
    """They leave more than white errors of their size would, in each of several worlds."""
    ratios = []
    for seed in range(4):
        site = replace(demo_site(coil_radius=None), model_error=BENT)
        config = SimulationConfig(
            box_world=DEMO_BOX_WORLD,
            duration=24.0,
            motion="walk",
            turn_rate=3.0,
            magnetometer_rate_hz=250.0,
            random_field=BENT,
        )
        log = simulate_log(site, config, np.random.default_rng(seed)).log
        result = smooth(log, site, SmootherSettings(loss="cauchy"))
        square = np.mean(inertial_errors(result, result.estimate) ** 2, axis=0)
        ratios.append((square / expected_squares(result))[ROWS])
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.5)
    assert np.max(np.mean(ratios, axis=0)) < TOLERATED_INERTIAL
