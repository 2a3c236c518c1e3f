"""What the error of the survey does to a fix, which takes the site as declared."""

import numpy as np

from magfusion.parameters import Calibration, choose_blocks, linearize_channels, prior_sigma
from magfusion.units import Array

SURVEY_GROUPS = ("beacons", "moments", "phase", "magnetometer", "extrinsics")


def survey_jacobians(
    calibration: Calibration,
    time: Array,
    world_from_body: Array,
    position_world: Array,
    root: Array,
) -> tuple[Array, Array]:
    """Return the whitened Jacobians of what a fix finds, and of the survey it takes for granted.

    Parameters
    ----------
    calibration : Calibration
        Its ``phase`` may have one row for each pose.
    time : ndarray, shape (m,)
    world_from_body : ndarray, shape (m, 3, 3)
    position_world : ndarray, shape (m, 3)
    root : ndarray, shape (m, channels, 6, 6)
        Whitening; zero where a channel is missing.

    Returns
    -------
    by_found : ndarray, shape (m, rows, 6 + phases)
        By the pose and by the drive phases of unsynchronised beacons.
    by_survey : ndarray, shape (m, rows, parameters)
        By one sigma of each parameter of the survey.
    """
    blocks = choose_blocks(calibration.site, SURVEY_GROUPS)
    sizes = [len(b.sigma) for b in blocks]
    survey = np.repeat(np.array([b.group != "phase" for b in blocks], dtype=bool), sizes)
    phase = np.repeat(np.array([b.kind == "phase" for b in blocks], dtype=bool), sizes)
    _, by_pose, by_calibration = linearize_channels(
        calibration, blocks, time, world_from_body, position_world
    )
    found = np.concatenate([by_pose, by_calibration[..., phase]], axis=-1)
    by_survey = by_calibration[..., survey] * prior_sigma(blocks)[survey]
    count = len(time)
    return (root @ found).reshape(count, -1, found.shape[-1]), (root @ by_survey).reshape(
        count, 6 * root.shape[1], -1
    )


def honest_covariance(
    by_found: Array, by_survey: Array, noise: Array, inverse: Array, information: Array
) -> Array:
    """Return the covariance of an estimate whose weights only stand in for the survey's error.

    Parameters
    ----------
    by_found, by_survey : ndarray, shape (m, rows, ...)
        From `survey_jacobians`.
    noise : ndarray, shape (m, rows, rows)
        Covariance of the whitened noise.
    inverse, information : ndarray, shape (m, found, found)
        Of the normal matrix, which may hold more than the field (gravity, a prior).

    Returns
    -------
    ndarray, shape (m, found, found)
    """
    transposed = np.swapaxes(by_found, 1, 2)
    spread = transposed @ noise @ by_found + information - transposed @ by_found
    moved = inverse @ transposed @ by_survey
    cov = inverse @ spread @ inverse + moved @ np.swapaxes(moved, 1, 2)
    return np.asarray(0.5 * (cov + np.swapaxes(cov, 1, 2)))
