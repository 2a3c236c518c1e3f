"""Weights of phasors: noise, model error, and survey error."""

from dataclasses import replace

import numpy as np

from magfusion.model.field import predict
from magfusion.model.field_map import block_diagonal
from magfusion.model.ground import conductivity_of, ground_error
from magfusion.model.once import once_a_site
from magfusion.model.parameters import BeaconParameter, MagnetometerParameter, candidates
from magfusion.model.perturbation import by_matrix as by_matrix
from magfusion.model.perturbation import skew as skew
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import MU0_OVER_4PI, Array, BoolArray, ComplexArray

ROUNDING = 1e-12  # of a covariance's mean eigenvalue


def calibration_error(site: Site, distance: Array, sensor: int = 0) -> Array:
    """Return the relative error of each beacon's field that its survey's sigmas cause.

    `distance` (n, beacons) (m). `sensor`: index of the magnetometer. Returns (n, beacons): to first
    order: the field falls with the cube of the distance.
    """
    variance = np.zeros_like(distance)
    names = [beacon.name for beacon in site.beacons]
    for parameter, owner in candidates(site):
        if isinstance(parameter, MagnetometerParameter) and parameter.sensor(site, owner) != sensor:
            continue
        if parameter.field_error:
            rows = names.index(owner) if isinstance(parameter, BeaconParameter) else slice(None)
            share = parameter.field_error * np.mean(parameter.sigma(site, owner) ** 2)
            variance[:, rows] += share / distance[:, rows] ** parameter.falls
    if site.log_conductivity_sigma and conductivity_of(site):
        variance += ground_error(site, distance) ** 2
    return np.sqrt(variance)


def _distances(site: Site, square: Array) -> Array:
    """Estimate the range of each beacon from its field strength alone, within a sixth.

    By the tones that were measured; NaN where a beacon has none.
    """
    out, start = [], 0
    for beacon in site.beacons:
        rows = slice(start, start + len(beacon.tones))
        drive = np.sum(np.abs(beacon.moments_beacon.T @ beacon.excitation) ** 2, axis=0)
        power = np.sum(square[:, rows], axis=2)
        there = np.isfinite(power)
        measured, driven = np.sum(np.where(there, power, 0.0), axis=1), there @ drive
        ratio = np.divide(
            2.0 * driven, measured, out=np.full(len(square), np.nan), where=driven > 0.0
        )
        out.append(np.cbrt(MU0_OVER_4PI * np.sqrt(ratio)))
        start = rows.stop
    return np.stack(out, axis=1)


def squares(site: Site, samples: FieldSamples, sensor_world: Array | None = None) -> Array:
    """Return the squared amplitude of each component, shape (n, channels, 3) (T^2).

    Where a channel lacks components, all three are the mean of the model field at the position: the
    model error does not vanish with the component along a coil.  Without a position they are the
    mean of the available components. `sensor_world` (n, magnetometers, 3): their positions (m).
    With several magnetometers each has all three components.
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
        fields = [predict(beacon, point, turn, sensor_world[rows, 0]) for beacon in site.beacons]
        gain = np.sum(sensor.matrix**2) / 3.0
        mean = gain * np.sum(np.abs(np.concatenate(fields, axis=1)) ** 2, axis=-1) / 3.0
    square[rows] = np.where(partial[rows, :, None], mean[..., None], square[rows])
    return np.asarray(square)


def model_error(site: Site, sensor_world: Array | None = None) -> Array:
    """Return the relative error of the field model in each channel, one sigma.

    `sensor_world` (n, magnetometers, 3): their positions (m): the uncertainty of a field map
    depends on position. Returns (channels,) or (n, channels).
    """
    if site.platform.further:
        places = [None] if sensor_world is None else np.swapaxes(sensor_world, 0, 1)
        alone = replace(site, platform=replace(site.platform, further=()))
        seen = [model_error(alone, None if at is None else at[:, None]) for at in places]
        return np.concatenate(seen * (len(site.platform.magnetometers) // len(seen)), axis=-1)
    known = _model_error_anywhere(site)
    if known is not None:
        return known
    at = None if sensor_world is None else sensor_world[:, 0]
    parts = [
        np.asarray((site.model_error if beacon.model_error is None else beacon.model_error) ** 2)
        if beacon.field_map is None
        else beacon.field_map.relative_variance(at)
        for beacon in site.beacons
    ]
    return np.sqrt(np.stack(np.broadcast_arrays(*parts), axis=-1))[..., site.owner]


@once_a_site
def _model_error_anywhere(site: Site) -> Array | None:
    """Return the relative error of each channel, (channels,); None if a map makes it local."""
    if any(beacon.field_map is not None for beacon in site.beacons):
        return None
    own = [site.model_error if b.model_error is None else b.model_error for b in site.beacons]
    return np.array(own)[site.owner]


@once_a_site
def _noise_share(site: Site) -> Array:
    """Return the ratio of each channel's noise to the measured noise, (channels,)."""
    return np.array([b.noise_factor for b in site.beacons])[site.owner] ** 2


def sensor_positions(site: Site, poses: Trajectory) -> Array:
    """Return the positions of the magnetometers at each pose, (n, magnetometers, 3), world (m)."""
    return sensors_at(site, poses.world_from_body, poses.position_world)


def sensors_at(site: Site, world_from_body: Array, position_world: Array) -> Array:
    """Return the positions of the magnetometers at poses of any shape (n, ...)."""
    sensors = site.platform.magnetometers
    if len(sensors) == 1:
        return (position_world + world_from_body @ sensors[0].position_body)[:, None]
    return np.stack([position_world + world_from_body @ s.position_body for s in sensors], axis=1)


def magnetometers_sharing_error(site: Site, valid: BoolArray) -> Array:
    """Return how many magnetometers of an epoch share a field-model error, (n, channels).

    The error is caused by iron and correlated over its length scale, so that several magnetometers
    within it do not average it. `valid` (n, channels): available channels of the epochs.
    """
    places = np.array([sensor.position_body for sensor in site.platform.magnetometers])
    if len(places) == 1 or site.model_error_length <= 0.0:
        return np.ones(valid.shape)
    separate = np.linalg.norm(places[:, None] - places, axis=2)
    others = np.exp(-separate / site.model_error_length) - np.eye(len(places))
    there = np.stack([np.any(valid[:, site.of_sensor(k)], axis=1) for k in range(len(places))], 1)
    return np.asarray(1.0 + (there @ others)[:, site.sensor])


def measurement_cov(
    site: Site,
    samples: FieldSamples,
    *,
    survey_error: bool = False,
    sensor_world: Array | None = None,
    shared_by: Array | float = 1.0,
    neighbours: bool = True,
) -> Array:
    """Return the covariance of each phasor component: noise and model error.

    Errors shared by several epochs do not average over them: each epoch gets a part of the weight.
    `survey_error`: add the effect of the calibration sigmas, for a solver that does not estimate
    them. `sensor_world` (n, magnetometers, 3): their approximate positions (m), for the uncertainty
    of a field map. `shared_by` (n,), or float: number of epochs that share a model error.
    `neighbours`: whether magnetometers next to each other count as one for their shared error; not
    where the estimate considers it. Returns (n, channels, 3, 3) (T^2), measured axes.
    """
    ways = ((1.0, shared_by),)
    (total,), square, power = _covs(site, samples, sensor_world, ways, neighbours=neighbours)
    if survey_error:
        relative = _relative_error(site, square)
        total = total + (relative**2 * power / 3.0)[..., None, None] * np.eye(3)
    return total


def weighed_and_alone(
    site: Site,
    samples: FieldSamples,
    sensor_world: Array,
    windows: float,
    shared_by: Array | float,
    *,
    neighbours: bool = True,
) -> tuple[Array, Array]:
    """Return `measurement_cov` of epochs with shared noise and model error, and as independent.

    ``sensor_world``, ``windows``, ``shared_by``, ``neighbours``: as of `measurement_cov`.
    """
    ways = (windows, shared_by), (1.0, 1.0)
    (weighed, alone), _, _ = _covs(site, samples, sensor_world, ways, neighbours=neighbours)
    return weighed, alone


def _covs(
    site: Site,
    samples: FieldSamples,
    sensor_world: Array | None,
    ways: tuple[tuple[float, Array | float], ...],
    *,
    neighbours: bool,
) -> tuple[list[Array], Array, Array]:
    """Return noise and model error for several ways of sharing, with squares and their power."""
    own = model_error(site, sensor_world)
    share = None
    if neighbours and site.platform.further:
        share = np.sqrt(magnetometers_sharing_error(site, samples.valid))
    noise = _noise_share(site)
    square = squares(site, samples, sensor_world)
    power = 0.5 * np.sum(square, axis=-1)
    result = []
    for windows, shared in ways:
        error = own * np.sqrt(np.asarray(shared))[..., None]
        error = error if share is None else error * share
        noisy = (windows * noise)[:, None, None] * samples.phasor_cov
        result.append(noisy + power_error_cov(power, error))
    return result, square, power


def _relative_error(site: Site, square: Array) -> Array:
    """Return the relative error caused by the survey's sigmas, shape (n, channels)."""
    parts = []
    for sensor in range(len(site.platform.magnetometers)):
        mine = site.of_sensor(sensor)
        distance = _distances(site, square[:, mine])
        relative = calibration_error(site, distance, sensor)[:, site.owner[mine]]
        late = site.platform.magnetometers[sensor].sigma.clock_offset
        if late:
            relative = np.hypot(relative, 2.0 * np.pi * late * site.tone_frequencies_hz)
        parts.append(relative)
    return np.concatenate(parts, axis=1)


def cholesky(cov: Array) -> Array:
    """Return lower factors of covariances (..., k, k) of a trace of about k.

    If rounding makes one indefinite, as for a faulty sample, all are increased by `ROUNDING`.
    """
    try:
        return np.asarray(np.linalg.cholesky(cov))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.cholesky(cov + ROUNDING * np.eye(cov.shape[-1])))


def whitening(cov: Array, there: BoolArray) -> Array:
    """Return ``W`` with ``W^T W = cov^-1``, shape (..., 3, 3); zero where a component is missing.

    `cov` (..., 3, 3). `there` (..., 3) or (...): of each component, or of all three. The covariance
    of the available components is inverted, independent of the noise of missing ones.
    """
    each = there.ndim == cov.ndim - 1
    if there.all():
        return _whole_whitening(cov)
    valid = np.any(there, axis=-1) if each else there
    if each and np.any(valid & ~np.all(there, axis=-1)):
        known = np.where(there[..., :, None] & there[..., None, :], cov, 0.0)
        count = np.maximum(np.sum(there, axis=-1), 1)
        size = np.trace(known, axis1=-2, axis2=-1) / count
        other = np.where(there, 0.0, np.where(valid, size, 1.0)[..., None])
        whole = known + other[..., None] * np.eye(3)
        return np.where(there[..., None], whitening(whole, np.ones_like(there)), 0.0)
    whole = _whole_whitening(np.where(valid[..., None, None], cov, np.eye(3)))
    return np.where(valid[..., None, None], whole, 0.0)


def _whole_whitening(cov: Array) -> Array:
    scale = np.sqrt(np.trace(cov, axis1=-2, axis2=-1) / 3.0)[..., None, None]
    return np.asarray(np.linalg.inv(cholesky(cov / scale**2)) / scale)


def paired_whitening(cov: Array, there: BoolArray) -> Array:
    """Return the whitening of real and imaginary part together, shape (..., 6, 6)."""
    single = whitening(cov, there)
    return block_diagonal(np.stack([single, single], axis=-3))


def stacked(phasor: ComplexArray) -> Array:
    """Stack complex vectors as real part, then imaginary part; zero where they are NaN."""
    parts = np.concatenate([phasor.real, phasor.imag], axis=-1)
    return parts if np.isfinite(parts).all() else np.nan_to_num(parts)


def model_error_cov(phasor_sensor: ComplexArray, model_error: float | Array) -> Array:
    """Return the variance that a field-model error adds to each component of a phasor.

    ``eps^2 |b|^2 / 3``, with ``|b|^2`` the mean square of the two quadratures: with weights for
    white noise alone the nearest beacon's model error dominates (paper 004 re-examined).
    `phasor_sensor` (..., 3) (T). `model_error` scalar or (...): relative error of the field model,
    one sigma. Returns (..., 3, 3) (T^2).
    """
    return power_error_cov(0.5 * np.sum(np.abs(phasor_sensor) ** 2, axis=-1), model_error)


def power_error_cov(power: Array, model_error: float | Array) -> Array:
    """Return the same of the field's mean square in either quadrature, shape (...) (T^2)."""
    return (model_error**2 * power)[..., None, None] / 3.0 * np.eye(3)
