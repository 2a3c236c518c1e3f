"""Inertial residuals as large as the declared errors leave them are no contradiction."""

from dataclasses import replace

import numpy as np
import pytest

from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.integrity.fixed_parameter_columns import inertial_columns
from magfusion.estimation.integrity.inertial_misfit import expected_squares, inertial_errors
from magfusion.estimation.integrity.residual_blocks import TOLERATED_INERTIAL
from magfusion.estimation.integrity.score import moved_estimate, scores_of
from magfusion.model.parameters.inertial import GYRO_SCALE
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import Array

ROWS = [0, 1, 2, 6, 7, 8]  # gyro and accelerometer
BENT = 0.01  # of the fields, constant in place


def a_walk(site: Site, seed: int, random_field: float = 0.0) -> Log:
    config = SimulationConfig(
        box_world=DEMO_BOX_WORLD,
        duration=24.0,
        motion="walk",
        turn_rate=3.0,
        magnetometer_rate_hz=250.0,
        random_field=random_field,
    )
    return simulate_log(site, config, np.random.default_rng(seed)).log


@pytest.mark.slow
def test_errors_constant_in_place_are_expected_to_turn_the_states_slowly() -> None:
    """They leave more than white errors of their size would, in each of several worlds."""
    ratios = []
    for seed in range(4):
        site = replace(demo_site(coil_radius=None), model_error=BENT)
        log = a_walk(site, seed, random_field=BENT)
        result = smooth(log, site, SmootherSettings(loss="cauchy"))
        square = np.mean(inertial_errors(result, result.estimate) ** 2, axis=0)
        ratios.append((square / expected_squares(result))[ROWS])
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.5)
    assert np.max(np.mean(ratios, axis=0)) < TOLERATED_INERTIAL


@pytest.mark.slow
def test_a_step_of_the_gyro_scale_moves_states_and_inertial_data_together() -> None:
    """A gyro whose scale is 3 % off: what the step to 3 % leaves is noise, with its data moved."""
    site = demo_site(coil_radius=None)
    log = a_walk(site, 3)
    log = replace(log, imu=replace(log.imu, gyro_body=1.03 * log.imu.gyro_body))
    result = smooth(log, site, SmootherSettings())
    scores = scores_of(result, log.imu)
    assert scores is not None
    score = scores.fixed
    (block,) = (b for b in score.fixed if b.parameter == GYRO_SCALE)
    step = np.zeros(len(score.gradient))
    step[block.columns] = 0.03 / block.sigma
    error = inertial_errors(result, moved_estimate(result, score, step))
    columns = inertial_columns(result, score.fixed, log.imu)
    np.testing.assert_allclose(columns.moved(step), columns.of(slice(None)) @ step, atol=1e-9)
    expected, gyro = expected_squares(result), [0, 1, 2]

    def ratio(rows: Array) -> Array:
        return np.asarray((np.mean(rows**2, axis=0) / expected)[gyro])

    assert np.max(ratio(error)) > 100.0  # states alone
    assert np.max(ratio(error + columns.moved(step))) < TOLERATED_INERTIAL
