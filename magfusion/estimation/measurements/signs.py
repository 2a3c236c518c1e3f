"""Unsigned amplitudes as phasors, with the sign or phase of an approximate state.

A change of ``|z|`` is the change of ``z`` along its own phase, so that an amplitude with the phase
of its prediction counts as a phasor measured along that phase only.  Near zero the sign is open and
``|z|`` has a kink: amplitudes predicted there are omitted.  The selection uses the prediction and
not the measurement, which would bias it.
"""

from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.model.noise import measurement_cov, sensor_positions
from magfusion.model.parameters import Calibration, linearize_channels, predict_channels
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, ComplexArray

NEAR_ZERO = 4.0  # sigmas of noise, model error and prediction, below which a sign is open
UNSURE = 0.1  # of the whole field; error of a component at a first guess
OPEN_SIGN = "amplitude near zero, whose sign is open"


def along_axis(fields: FieldSamples, site: Site) -> FieldSamples:
    """Return amplitudes along the one axis of a site's receiver; phasors unchanged.

    Raises InputError where the receiver has more axes.
    """
    own = site.platform.magnetometer.axes
    if fields.signed or fields.axes == own:
        return fields
    if len(own) != 1:
        raise InputError(
            "fields: are amplitudes, which are of a receiver of one axis, but the site's has"
            f" {', '.join(own)}; declare platform.magnetometer.axes"
        )
    phasor = np.full_like(fields.phasor_sensor, np.nan)
    phasor[..., "xyz".index(own)] = fields.phasor_sensor[..., "xyz".index(fields.axes)]
    return replace(fields, phasor_sensor=phasor, axes=own)


def with_signs(
    samples: FieldSamples,
    poses: Trajectory,
    calibration: Calibration,
    *,
    first: bool = False,
    every: bool = False,
) -> FieldSamples:
    """Return amplitudes with the phases predicted at poses, without those of open sign.

    Parameters
    ----------
    samples : FieldSamples
        With `FieldSamples.signed` False; their phases are ignored.
    poses : Trajectory
        At the same epochs; a covariance widens the range near zero.
    first : bool
        Whether the poses are a first guess.
    every : bool
        Whether those near zero are included, to compare guesses by the same amplitudes.
    """
    if samples.signed:
        return samples
    k = "xyz".index(samples.axes)
    at = samples.time, poses.world_from_body, poses.position_world
    seen = predict_channels(calibration, *at)
    one = seen[..., k]
    size = np.abs(one)
    phase = np.exp(1j * np.angle(one))
    phasor = samples.phasor_sensor.copy()
    phasor[..., k] = np.abs(phasor[..., k]) * phase
    if not every:
        guess = UNSURE / NEAR_ZERO * np.linalg.norm(seen, axis=-1) if first else 0.0 * size
        near = _near_zero(samples, poses, calibration, phase, size, guess)
        phasor[..., k] = np.where(near, np.nan, phasor[..., k])
    return replace(samples, phasor_sensor=phasor)


def _near_zero(
    samples: FieldSamples,
    poses: Trajectory,
    calibration: Calibration,
    phase: ComplexArray,
    size: Array,
    guess: Array,
) -> BoolArray:
    """Return which amplitudes have an open sign, shape (n, channels), by phase and size."""
    k, site = "xyz".index(samples.axes), calibration.site
    own = sensor_positions(site, poses)
    variance = measurement_cov(site, samples, sensor_world=own)[..., k, k] + guess**2
    if poses.pose_cov is not None:
        at = samples.time, poses.world_from_body, poses.position_world
        _, by_pose, _ = linearize_channels(calibration, (), *at)
        slope = np.real(np.conj(phase)[..., None] * (by_pose[:, :, k] + 1j * by_pose[:, :, k + 3]))
        variance = variance + np.einsum("nci,nij,ncj->nc", slope, poses.pose_cov, slope)
    return np.asarray(size < NEAR_ZERO * np.sqrt(np.nan_to_num(variance)))


def count_open(samples: FieldSamples, resolved: FieldSamples) -> int:
    """Return how many amplitudes were omitted."""
    return 0 if samples.signed else int(np.sum(samples.valid & ~resolved.valid))


def whitened_along(sqrt_information: Array, samples: FieldSamples) -> Array:
    """Return a whitening (n, channels, 6, 6) of the part along each amplitude's phase only."""
    if samples.signed:
        return sqrt_information
    k = "xyz".index(samples.axes)
    value = samples.phasor_sensor[..., k]
    size = np.abs(value)
    known = np.isfinite(size) & (size > 0.0)
    phase = np.exp(1j * np.angle(np.where(known, value, 1.0)))
    out = np.zeros_like(sqrt_information)
    out[..., k, k] = sqrt_information[..., k, k] * phase.real
    out[..., k, k + 3] = sqrt_information[..., k, k] * phase.imag
    return out
