"""Errors of fixes at surveyed poses, with the survey's own error subtracted.

The difference between a fix and the surveyed pose contains the errors of both.  The error
predicted for the fix from noise and calibration is scaled by two checks: the differences less the
survey's declared error, which dominates where the survey is less accurate than the tracker; and
the residuals that no pose explains, which are no error of a pose.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.calibration.antenna import AntennaFit
from magfusion.calibration.antenna_site import BodySurvey, of_site
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.field import skew
from magfusion.model.noise import model_error_cov
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, Site
from magfusion.units import Array

MODELLED = 0.3  # relative error of a variance that residuals beside the pose predict
DEVIATES = 3.0  # sigmas


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of fixes, one column for the attitude (rad) and one for the position (m)."""

    difference: Array  # (n, 2), from the surveyed poses
    # rms, rms_sigma: (2,), of the fixes themselves, and its standard deviation
    rms: Array
    rms_sigma: Array
    survey: Array  # (2,), declared error of the survey's poses


def fixed_poses(site: Site, beacon: Beacon, survey: BodySurvey) -> tuple[Array, Array]:
    """Return world_from_body and position (m) of the fixes nearest to the surveyed poses.

    By `magfusion.estimation.snapshot.likelihood.fix_epochs`, as ``magfusion fix`` does.
    """
    alone = replace(site, beacons=(replace(beacon, hemisphere_beacon=None),), region=None)
    turn = np.exp(1j * np.array([coil.phase for coil in beacon.coils]))
    n, count = len(survey.sigma), len(alone.channels)
    cov = (survey.sigma**2)[:, None, None, None] * np.eye(3) * np.ones((1, count, 1, 1))
    samples = FieldSamples(
        np.zeros(n),
        np.ones(n),
        alone.channels,
        np.asarray(np.swapaxes(survey.coupling, 1, 2) * turn[:, None], dtype=np.complex128),
        cov,
    )
    fixes = fix_epochs(samples, initial_calibration(replace(alone, correlation=None), 0.0))
    separate = np.linalg.norm(fixes.position_world - survey.position_world[:, None], axis=-1)
    best = np.argmin(np.where(np.isfinite(fixes.cost), separate, np.inf), axis=1)
    rows = np.arange(n)
    return fixes.world_from_body[rows, best], fixes.position_world[rows, best]


def differences(site: Site, beacon: Beacon, survey: BodySurvey) -> Array:
    """Return the errors of fixes relative to the surveyed poses, shape (n, 2) (rad, m)."""
    rotation, position = fixed_poses(site, beacon, survey)
    turn = np.swapaxes(survey.world_from_body, -1, -2) @ rotation
    off = np.linalg.norm(position - survey.position_world, axis=-1)
    return np.column_stack([Rotation.from_matrix(turn).magnitude(), off])


@dataclass(frozen=True, eq=False)
class Expected:
    """Errors of fixes predicted from noise and calibration, per pose."""

    square: Array  # (n, 2), mean square error (rad^2, m^2)
    # square of the residuals that no pose takes up, by what is expected of it
    excess: Array


def expected(site: Site, beacon: Beacon, fit: AntennaFit, survey: BodySurvey) -> Expected:
    """Return the predicted errors of fixes at poses that the antennas were not fitted to.

    `site`, `beacon`: with the antennas of the fit. `survey`: its poses are the evaluation points.
    """
    sensor = site.platform.magnetometer
    own = survey.of_sensor(beacon, sensor)
    seen = of_site(beacon, sensor)(fit.antenna, own.beacon_from_sensor, own.position_beacon)
    n = len(own.sigma)
    by_pose, by_antenna = seen.pose.reshape(n, 9, 6), seen.antenna.reshape(n, 9, -1)
    cov = by_antenna @ fit.cov @ np.swapaxes(by_antenna, 1, 2)
    cov += (own.sigma**2)[:, None, None] * np.eye(9)
    error = site.model_error if beacon.model_error is None else beacon.model_error
    phasor = np.swapaxes(seen.value, 1, 2).astype(np.complex128)
    model = model_error_cov(phasor, error)[..., 0, 0]
    weight = 1.0 / np.sqrt(own.sigma[:, None] ** 2 + model)  # of each coil's column
    white = np.tile(weight[:, None, :], (1, 3, 1)).reshape(n, 9, 1)
    gain = np.linalg.pinv(white * by_pose) * np.swapaxes(white, 1, 2)
    # From the sensor's origin to the body's.
    lever = -sensor.body_from_sensor.T @ sensor.position_body
    gain[:, 3:] -= skew(lever) @ gain[:, :3]
    of_pose = gain @ cov @ np.swapaxes(gain, 1, 2)
    diagonal = np.diagonal(of_pose, axis1=1, axis2=2).reshape(n, 2, 3)
    residual = np.linalg.svd(by_pose / np.linalg.norm(by_pose, axis=1, keepdims=True))[0][..., 6:]
    others = np.swapaxes(residual, 1, 2)
    rest = others @ (seen.value - survey.coupling).reshape(n, 9, 1)
    declared = others @ cov @ residual
    excess = np.swapaxes(rest, 1, 2) @ np.linalg.solve(declared, rest)
    return Expected(np.sum(diagonal, axis=2), excess[:, 0, 0] / 3.0)


def turned_elsewhere(site: Site, beacon: Beacon, fit: AntennaFit, survey: BodySurvey) -> Array:
    """Return the predicted errors where the body has any attitude at surveyed points, shape (2,).

    Root mean square (rad, m); parameters undetermined by few attitudes increase it in others.
    """
    n = len(survey.sigma)
    turn = Rotation.random(n, rng=np.random.default_rng(0)).as_matrix()
    other = replace(survey, world_from_body=turn)
    return np.sqrt(np.mean(expected(site, beacon, fit, other).square, axis=0))


def own_errors(difference: Array, survey: Array, predicted: Expected | None) -> PoseErrors:
    """Return the errors of the fixes alone.

    `difference` (n, 2): from surveyed poses (rad, m). `survey` (2,): error of these, one sigma an
    axis. `predicted`: predicted errors of the fixes.
    """
    n, of_survey = len(difference), 3.0 * survey**2
    square = difference**2 - of_survey
    plain, spread = np.mean(square, axis=0), np.var(square, axis=0, ddof=1) / n
    if predicted is None:
        own, variance = np.maximum(plain, np.mean(difference**2, axis=0) / n), spread
    else:
        own, variance = _scaled(square, of_survey, predicted)
        # A prediction of another shape than the errors is not informative about them.
        other = np.abs(plain - own) > DEVIATES * np.sqrt(spread + variance)
        own, variance = np.where(other, plain, own), np.where(other, spread, variance)
    rms = np.sqrt(np.maximum(own, 0.0))
    return PoseErrors(difference, rms, 0.5 * np.sqrt(variance) / rms, np.sqrt(of_survey))


def _scaled(square: Array, of_survey: Array, predicted: Expected) -> tuple[Array, Array]:
    """Return the mean square of the errors, and its variance, from the scaled prediction.

    Errors at far poses are many times those at near ones; each is equally informative of the scale.
    """
    model = predicted.square
    share = model / (model + of_survey)
    gain = np.sum(share**2 * square / model, axis=0) / np.sum(share**2, axis=0)
    residual = float(np.mean(predicted.excess))
    size = np.maximum(gain, residual)
    # Three components per pose, each the square of a normal variable.
    of_gain = size**2 * (2.0 / 3.0) / np.sum(share**2, axis=0)
    of_residual = (MODELLED * size) ** 2
    weight = of_residual / (of_residual + of_gain)
    whole, mean = weight * gain + (1.0 - weight) * residual, np.mean(model, axis=0)
    return whole * mean, weight * of_gain * mean**2
