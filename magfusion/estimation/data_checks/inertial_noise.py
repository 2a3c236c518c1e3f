"""The white noise of the inertial samples, from the samples alone, against what is declared."""

from collections.abc import Iterator
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import ImuModel, Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array

BLOCK = 128  # samples, in which the noise is measured
QUIETEST = 0.1  # share of the blocks that are taken for free of vibration
FEWEST = 4  # blocks
MORE = 4.0  # times what is declared; a declared density is a prior with a factor of two


def white_density(time: Array, value: Array) -> Array | None:
    """Return the density of the white noise of each axis, shape (3,); None of too few samples.

    By third differences, in which a motion that a platform makes is nearly nothing and white noise
    of variance ``v`` has ``20 v``; in the quietest blocks, so that vibration has no part in it.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    value : ndarray, shape (n, 3)
        In a unit; the density is in that unit per square root of hertz.
    """
    left = np.diff(value, n=3, axis=0)
    count = len(left) // BLOCK
    if count < FEWEST:
        return None
    blocks = left[: count * BLOCK].reshape(count, BLOCK, 3)
    variance = np.quantile(np.mean(blocks**2, axis=1) / 20.0, QUIETEST, axis=0)
    return np.asarray(np.sqrt(variance * float(np.median(np.diff(time)))))


def noisy_inertial(log: Log, site: Site | None) -> Iterator[Finding]:
    """Yield an inertial sensor whose samples scatter by far more than is declared of it."""
    if site is not None and len(log.imu):
        yield from measured_noise(log.imu, site.platform.imu)[1]


def measured_noise(samples: ImuSamples, declared: ImuModel) -> tuple[ImuModel, list[Finding]]:
    """Return an inertial sensor with the noise that its samples have, where they have far more."""
    findings, model = [], declared
    for name, key, unit, value in (
        ("gyroscope", "gyro_noise", "rad/s", samples.gyro_body),
        ("accelerometer", "accel_noise", "m/s^2", samples.accel_body),
    ):
        usual = float(getattr(declared, key))
        found = white_density(samples.time, value)
        if found is None or not float(np.median(found)) > MORE * usual:
            continue
        density = float(np.median(found))
        model = replace(model, **{key: density})
        text = (
            f"{name}: even where it is quietest, its samples scatter by {density:.2g}"
            f" {unit}/sqrt(Hz), {density / usual:.1f} times the declared {key}: what hangs on"
            f" it is less sure than is claimed. Declare {key}: {density:.2g}, or what its data"
            " sheet says."
        )
        findings.append(Finding("imu_noise", text, Verdict.DOUBTFUL, 50.0 + density / usual))
    return model, findings


# A running estimate asks for it at every state.
_KNOWN: WeakKeyDictionary[Site, tuple[float, float, Site]] = WeakKeyDictionary()


def with_white_noise(site: Site, gyro: float, accel: float) -> Site:
    """Return a site with other densities of its inertial sensor (rad/s, m/s^2, per root of Hz)."""
    imu = site.platform.imu
    if (gyro, accel) == (imu.gyro_noise, imu.accel_noise):
        return site
    known = _KNOWN.get(site)
    if known is None or known[:2] != (gyro, accel):
        own = replace(imu, gyro_noise=gyro, accel_noise=accel)
        other = replace(site, platform=replace(site.platform, imu=own))
        known = _KNOWN[site] = (gyro, accel, other)
    return known[2]
