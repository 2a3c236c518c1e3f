"""How much a phasor counts: noise, model error, and the error of the survey."""

from dataclasses import replace

import numpy as np

from magfusion.model.field import power_error_cov, predict
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


def _distances(site: Site, square: Array) -> Array:
    """Range of each beacon from the strength of its field alone, within a sixth."""
    out, start = [], 0
    for beacon in site.beacons:
        rows = slice(start, start + len(beacon.tones))
        drive = beacon.moments_beacon.T @ beacon.excitation
        power = np.sum(square[:, rows], axis=(1, 2))
        out.append(np.cbrt(MU0_OVER_4PI * np.sqrt(2.0 * np.sum(np.abs(drive) ** 2) / power)))
        start = rows.stop
    return np.stack(out, axis=1)


def squares(site: Site, samples: FieldSamples, sensor_world: Array | None = None) -> Array:
    """Return the squared amplitude of each component, shape (n, channels, 3) (T^2).

    Where a channel lacks components all of its three are the mean of the field that the model has
    at the place: the error of the model does not vanish with the component along a coil.  Without a
    place they are the mean of those that are there.

    Parameters
    ----------
    sensor_world : ndarray, shape (n, 3), optional
        Where the magnetometer is (m).
    """
    square, partial = np.abs(samples.phasor_sensor) ** 2, samples.partial
    if not np.any(partial):
        return np.asarray(square)
    rows = np.flatnonzero(np.any(partial, axis=1))
    if sensor_world is None:
        number = np.maximum(np.sum(samples.there[rows], axis=-1), 1)
        mean = np.nansum(square[rows], axis=-1) / number
    else:
        sensor = site.platform.magnetometer
        none, along = np.zeros(3), np.eye(3)
        point = replace(
            sensor, position_body=none, matrix=along, body_from_sensor=along, coil_kappa=0.0
        )
        point = replace(point, coil_centres_sensor=None)
        turn = np.broadcast_to(along, (len(rows), 3, 3))
        fields = [predict(beacon, point, turn, sensor_world[rows]) for beacon in site.beacons]
        gain = np.sum(sensor.matrix**2) / 3.0
        mean = gain * np.sum(np.abs(np.concatenate(fields, axis=1)) ** 2, axis=-1) / 3.0
    square[rows] = np.where(partial[rows, :, None], mean[..., None], square[rows])
    return np.asarray(square)


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
    square = squares(site, samples, sensor_world)
    power = 0.5 * np.sum(square, axis=-1)
    total = total + power_error_cov(power, error)
    if survey_error:
        relative = calibration_error(site, _distances(site, square))[:, owner]
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


def whitening(cov: Array, there: BoolArray) -> Array:
    """Return ``W`` with ``W^T W = cov^-1``, shape (..., 3, 3); zero where a component is missing.

    Parameters
    ----------
    cov : ndarray, shape (..., 3, 3)
    there : bool ndarray, shape (..., 3) or (...)
        Of each component, or of all three.  The covariance of the components that are there is
        what is inverted: what is missing was not measured, however large its noise is.
    """
    each = there.ndim == cov.ndim - 1
    valid = np.any(there, axis=-1) if each else there
    if each and np.any(valid & ~np.all(there, axis=-1)):
        known = np.where(there[..., :, None] & there[..., None, :], cov, 0.0)
        count = np.maximum(np.sum(there, axis=-1), 1)
        size = np.trace(known, axis1=-2, axis2=-1) / count
        other = np.where(there, 0.0, np.where(valid, size, 1.0)[..., None])
        whole = known + other[..., None] * np.eye(3)
        return np.where(there[..., None], whitening(whole, np.ones_like(there)), 0.0)
    safe = np.where(valid[..., None, None], cov, np.eye(3))
    scale = np.sqrt(np.trace(safe, axis1=-2, axis2=-1) / 3.0)[..., None, None]
    root = cholesky(safe / scale**2)
    sqrt_information = np.linalg.inv(root) / scale
    return np.where(valid[..., None, None], sqrt_information, 0.0)


def paired_whitening(cov: Array, there: BoolArray) -> Array:
    """Return the whitening of real and imaginary part together, shape (..., 6, 6)."""
    single = whitening(cov, there)
    return block_diagonal(np.stack([single, single], axis=-3))


def twice(there: BoolArray) -> BoolArray:
    """Return what is said of components (..., 3) of real part, then imaginary part, (..., 6)."""
    return np.concatenate([there, there], axis=-1)


def stacked(phasor: ComplexArray) -> Array:
    """Return complex vectors as real part, then imaginary part; zero where they are NaN."""
    return np.nan_to_num(np.concatenate([phasor.real, phasor.imag], axis=-1))
