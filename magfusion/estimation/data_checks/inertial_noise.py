"""White noise of the inertial samples, measured from them and compared with the declaration."""

from collections.abc import Iterator
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import ImuModel, Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array

BLOCK = 128  # samples in which noise, or the scatter, is measured
QUIETEST = 0.1  # share of the blocks that are assumed to be without vibration
MIN_BLOCKS = 4  # blocks
MORE = 4.0  # times what is declared; a declared density is a prior with a factor of two


def white_density(time: Array, value: Array) -> Array | None:
    """Return the white-noise density of each axis, shape (3,); None for too few samples.

    Third differences suppress the platform's motion and turn white noise of variance ``v`` into
    ``20 v``; only the quietest blocks count, which excludes vibration. `time` (n,) (s).
    `value` (n, 3): in any unit; the density is in that unit per square root of hertz.
    """
    residual = np.diff(value, n=3, axis=0)
    count = len(residual) // BLOCK
    if count < MIN_BLOCKS:
        return None
    blocks = residual[: count * BLOCK].reshape(count, BLOCK, 3)
    variance = np.quantile(np.mean(blocks**2, axis=1) / 20.0, QUIETEST, axis=0)
    return np.asarray(np.sqrt(variance * float(np.median(np.diff(time)))))


def noisy_inertial(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield each inertial sensor whose noise is far above the declared density."""
    if site is not None and len(log.imu):
        yield from measured_noise(log.imu, site.platform.imu)[1]


def measured_noise(samples: ImuSamples, declared: ImuModel) -> tuple[ImuModel, list[Finding]]:
    """Return an inertial sensor, its declared noise replaced where the samples have far more."""
    findings, model = [], declared
    for name, key, unit, value in (
        ("gyroscope", "gyro_noise", "rad/s", samples.gyro_body),
        ("accelerometer", "accel_noise", "m/s^2", samples.accel_body),
    ):
        usual = float(getattr(declared, key))
        result = white_density(samples.time, value)
        if result is None or not float(np.median(result)) > MORE * usual:
            continue
        density = float(np.median(result))
        model = replace(model, **{key: density})
        text = (
            f"{name}: the noise is {density:.2g} {unit}/sqrt(Hz) even in the quietest parts,"
            f" {density / usual:.1f} times the declared {key}. Declare {key}: {density:.2g}, or the"
            " value of the data sheet."
        )
        weight, remedy = 50.0 + density / usual, {f"platform.imu.{key}": float(f"{density:.3g}")}
        findings.append(Finding("imu_noise", text, Verdict.DOUBTFUL, weight, remedy=remedy))
    return model, findings


def with_measured_noise(site: Site, samples: ImuSamples) -> Site:
    """Return a site whose declared noise of the IMU is replaced where the samples have far more."""
    if not site.platform.inertial:
        return site
    model, _ = measured_noise(samples, site.platform.imu)
    return with_white_noise(site, model.gyro_noise, model.accel_noise)


# Called by a running estimator at every state.
_KNOWN: WeakKeyDictionary[Site, tuple[float, float, Site]] = WeakKeyDictionary()


def with_white_noise(site: Site, gyro: float, accel: float) -> Site:
    """Return a site with other noise densities of its IMU (rad/s, m/s^2, per square root of Hz)."""
    imu = site.platform.imu
    if (gyro, accel) == (imu.gyro_noise, imu.accel_noise):
        return site
    known = _KNOWN.get(site)
    if known is None or known[:2] != (gyro, accel):
        own = replace(imu, gyro_noise=gyro, accel_noise=accel)
        other = replace(site, platform=replace(site.platform, imu=own))
        known = _KNOWN[site] = (gyro, accel, other)
    return known[2]
