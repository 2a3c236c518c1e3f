"""Effect of survey errors on a fix, which uses the declared site."""

import numpy as np

from magfusion.estimation.snapshot.problem import nuisance_blocks
from magfusion.estimation.solve.sparse_rows import times_spread
from magfusion.model.noise import measurement_cov, sensor_positions, whitening
from magfusion.model.parameters import (
    CLOCK_OFFSET,
    Block,
    Calibration,
    choose_blocks,
    dimension,
    linearize_channels,
    placed,
)
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.samples import FieldSamples
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

SURVEY_GROUPS = ("beacons", "moments", "magnetometer", "extrinsics", "ground")


def survey_jacobians(
    calibration: Calibration,
    nuisances: tuple[Block, ...],
    time: Array,
    world_from_body: Array,
    position_world: Array,
    sqrt_information: Array,
) -> tuple[Array, Array]:
    """Return the whitened Jacobians of the estimated and of the survey parameters of a fix.

    Parameters
    ----------
    calibration : Calibration
        Its ``phase`` and ``log_gain`` may have one row for each pose.
    nuisances : tuple of Block
        Estimated with the pose.
    time : ndarray, shape (m,)
    world_from_body : ndarray, shape (m, 3, 3)
    position_world : ndarray, shape (m, 3)
    sqrt_information : ndarray, shape (m, channels, 3, 3)
        Whitening (1/T); zero where a channel is missing.

    Returns
    -------
    by_found : ndarray, shape (m, rows, 6 + nuisances)
        With respect to the pose and the nuisances.
    by_survey : ndarray, shape (m, rows, parameters)
        With respect to each column of the survey prior's square root: one sigma of each parameter,
        if these are independent.
    """
    site, result = calibration.site, dimension(nuisances)
    clocks = choose_blocks(site, (CLOCK_OFFSET.group,), parameters=(CLOCK_OFFSET,))
    survey = placed((*choose_blocks(site, SURVEY_GROUPS), *clocks))
    _, by_pose, by_calibration = linearize_channels(
        calibration, placed((*nuisances, *survey)), time, world_from_body, position_world
    )
    by_found = np.concatenate([by_pose, by_calibration[..., :result]], axis=-1)
    by_survey = times_spread(by_calibration[..., result:], prior_sqrt_covariance(site, survey))
    return whitened(sqrt_information, by_found), whitened(sqrt_information, by_survey)


def whitened(sqrt_information: Array, columns: Array) -> Array:
    """Return columns of the phasors' rows in units of their sigma.

    `sqrt_information` (m, channels, 3, 3). `columns` (m, channels, 6, k): of real parts, then
    imaginary parts (T). Returns (m, rows, k).
    """
    m, channels, _, width = columns.shape
    halves = columns.reshape(m, channels, 2, 3, width)
    return (sqrt_information[:, :, None] @ halves).reshape(m, 6 * channels, width)


def honest_covariance(
    by_found: Array, by_survey: Array, noise: Array, inverse: Array, information: Array
) -> Array:
    """Return the covariance of an estimate whose weights only approximate the survey error.

    `by_found`, `by_survey` (m, rows, ...): from `survey_jacobians`. `noise` (m, rows, rows):
    covariance of the whitened noise. `inverse`, `information` (m, found, found): of the normal
    matrix, which may include gravity or a prior. Returns (m, found, found).
    """
    transposed = np.swapaxes(by_found, 1, 2)
    spread = transposed @ noise @ by_found + information - transposed @ by_found
    moved = inverse @ transposed @ by_survey
    cov = inverse @ spread @ inverse + moved @ np.swapaxes(moved, 1, 2)
    return 0.5 * (cov + np.swapaxes(cov, 1, 2))


def survey_response(declared: Calibration, samples: FieldSamples, states: Trajectory) -> Array:
    """Return the common effect of the survey error on every fix, shape (n, 6, parameters).

    The graph treats the errors of fixes as independent, but this part does not average out.
    Columns are of one sigma each.
    """
    cov = measurement_cov(
        declared.site,
        samples,
        survey_error=True,
        sensor_world=sensor_positions(declared.site, states),
    )
    by_found, by_survey = survey_jacobians(
        declared,
        nuisance_blocks(declared.site),
        samples.time,
        states.world_from_body,
        states.position_world,
        whitening(cov, samples.there),
    )
    return (np.linalg.pinv(by_found) @ by_survey)[:, :6]
