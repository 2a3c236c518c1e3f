"""Amplitudes without sign as phasors: the sign, or phase, is that of a state that is about right.

What ``|z|`` changes by is what ``z`` changes by along its own phase, so an amplitude that is given
the phase of its prediction counts as a phasor of which the one part along that phase was measured.
Near zero the sign is open and ``|z|`` has a kink: what is predicted there is left out, by the
prediction and not by what was measured, which would choose among errors.
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
UNSURE = 0.1  # of the whole field; by so much a first guess of a component may err
OPEN_SIGN = "amplitude near zero, whose sign is open"


def along_axis(fields: FieldSamples, site: Site) -> FieldSamples:
    """Return amplitudes along the one axis of a site's receiver; phasors as they are.

    Raises
    ------
    InputError
        Where the receiver has more axes.
    """
    own = site.platform.magnetometer.axes
    if fields.signed or fields.axes == own:
        return fields
    if len(own) != 1:
        raise InputError(
            "fields: are amplitudes, which are of a receiver of one axis, and the site's has"
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
    """Return amplitudes with the phases that poses predict, without those whose sign is open.

    Parameters
    ----------
    samples : FieldSamples
        Whose `FieldSamples.signed` is False; whatever phases they have are not looked at.
    poses : Trajectory
        Of the same epochs; its covariance, where there is one, widens what is near zero.
    first : bool
        Whether the poses are a first guess.
    every : bool
        Whether those near zero stay in, too: so that guesses are compared by the same amplitudes.
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
    """Tell of which amplitudes the sign is open, shape (n, channels), by their phase and size."""
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
    """Return how many amplitudes were left out."""
    return 0 if samples.signed else int(np.sum(samples.valid & ~resolved.valid))


def whitened_along(sqrt_information: Array, samples: FieldSamples) -> Array:
    """Return a whitening (n, channels, 6, 6) of the part along each amplitude's phase alone."""
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
