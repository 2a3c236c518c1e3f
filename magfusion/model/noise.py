"""How much a phasor counts: noise, model error, and the error of the survey."""

import numpy as np

from magfusion.model.field import model_error_cov
from magfusion.model.field_map import block_diagonal
from magfusion.model.ground import conductivity_of, ground_error
from magfusion.model.parameters import BeaconParameter, candidates
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import MU0_OVER_4PI, Array, BoolArray, ComplexArray

ROUNDING = 1e-12  # of a covariance's mean eigenvalue


def calibration_error(site: Site, distance: Array) -> Array:
    """Return the relative error of each beacon's field that its survey's sigmas cause.

    Parameters
    ----------
    distance : ndarray, shape (n, beacons)
        (m)

    Returns
    -------
    ndarray, shape (n, beacons)
        To first order: the field falls with the cube of the distance.
    """
    variance = np.zeros_like(distance)
    names = [beacon.name for beacon in site.beacons]
    for parameter, owner in candidates(site):
        if parameter.field_error:
            rows = names.index(owner) if isinstance(parameter, BeaconParameter) else slice(None)
            share = parameter.field_error * np.mean(parameter.sigma(site, owner) ** 2)
            variance[:, rows] += share / distance[:, rows] ** parameter.falls
    if site.log_conductivity_sigma and conductivity_of(site):
        variance += ground_error(site, distance) ** 2
    return np.sqrt(variance)


def _distances(site: Site, samples: FieldSamples) -> Array:
    """Range of each beacon from the strength of its field alone, within a sixth."""
    out, start = [], 0
    for beacon in site.beacons:
        rows = slice(start, start + len(beacon.tones))
        drive = beacon.moments_beacon.T @ beacon.excitation
        power = np.sum(np.abs(samples.phasor_sensor[:, rows]) ** 2, axis=(1, 2))
        out.append(np.cbrt(MU0_OVER_4PI * np.sqrt(2.0 * np.sum(np.abs(drive) ** 2) / power)))
        start = rows.stop
    return np.stack(out, axis=1)


def model_error(site: Site, sensor_world: Array | None = None) -> Array:
    """Return the relative error of the field model in each channel, one sigma.

    Parameters
    ----------
    sensor_world : ndarray, shape (n, 3), optional
        Where the magnetometer is (m): a field map is not equally well known everywhere.

    Returns
    -------
    ndarray, shape (channels,) or (n, channels)
    """
    parts = [
        np.asarray((site.model_error if beacon.model_error is None else beacon.model_error) ** 2)
        if beacon.field_map is None
        else beacon.field_map.relative_variance(sensor_world)
        for beacon in site.beacons
    ]
    owner = [i for i, b in enumerate(site.beacons) for _ in b.tones]
    return np.sqrt(np.stack(np.broadcast_arrays(*parts), axis=-1))[..., owner]


def sensor_positions(site: Site, poses: Trajectory) -> Array:
    """Return where the magnetometer is at each pose of the body, shape (n, 3), world (m)."""
    lever_body = site.platform.magnetometer.position_body
    return poses.position_world + poses.world_from_body @ lever_body


def measurement_cov(
    site: Site,
    samples: FieldSamples,
    *,
    survey_error: bool = False,
    sensor_world: Array | None = None,
    windows: float = 1.0,
    alike: Array | float = 1.0,
) -> Array:
    """Return the covariance of each phasor component: noise and model error.

    What several epochs share does not average over them: each then counts as a part of one.

    Parameters
    ----------
    survey_error : bool
        Add what the sigmas of the site's calibration cause, for a solver that does not estimate it.
    sensor_world : ndarray, shape (n, 3), optional
        Where the magnetometer is (m), as far as it is known: how well a field map is known there.
    windows : float
        How many windows hold each sample, and with it its noise.
    alike : ndarray, shape (n,), or float
        How many epochs have the same model error.

    Returns
    -------
    ndarray, shape (n, channels, 3, 3)
        (T^2), measured axes.
    """
    error = model_error(site, sensor_world) * np.sqrt(np.asarray(alike))[..., None]
    owner = [i for i, b in enumerate(site.beacons) for _ in b.tones]
    factor = windows * np.array([b.noise_factor for b in site.beacons])[owner] ** 2
    total = factor[:, None, None] * samples.phasor_cov
    total = total + model_error_cov(samples.phasor_sensor, error)
    if survey_error:
        relative = calibration_error(site, _distances(site, samples))[:, owner]
        power = 0.5 * np.sum(np.abs(samples.phasor_sensor) ** 2, axis=-1)
        total = total + (relative**2 * power / 3.0)[..., None, None] * np.eye(3)
    return total


def cholesky(cov: Array) -> Array:
    """Return lower factors of covariances (..., k, k) of trace k or so.

    Where rounding leaves one indefinite, as a false sample does, all are larger by `ROUNDING`.
    """
    try:
        return np.asarray(np.linalg.cholesky(cov))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.cholesky(cov + ROUNDING * np.eye(cov.shape[-1])))


def whitening(cov: Array, valid: BoolArray) -> Array:
    """Return ``W`` with ``W^T W = cov^-1``, shape (..., 3, 3); zero where a channel is missing."""
    safe = np.where(valid[..., None, None], cov, np.eye(3))
    scale = np.sqrt(np.trace(safe, axis1=-2, axis2=-1) / 3.0)[..., None, None]
    root = cholesky(safe / scale**2)
    sqrt_information = np.linalg.inv(root) / scale
    return np.where(valid[..., None, None], sqrt_information, 0.0)


def paired_whitening(cov: Array, valid: BoolArray) -> Array:
    """Return the whitening of real and imaginary part together, shape (..., 6, 6)."""
    single = whitening(cov, valid)
    return block_diagonal(np.stack([single, single], axis=-3))


def stacked(phasor: ComplexArray) -> Array:
    """Return complex vectors as real part, then imaginary part; zero where they are NaN."""
    return np.nan_to_num(np.concatenate([phasor.real, phasor.imag], axis=-1))
