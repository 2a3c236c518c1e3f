"""Inertial samples along a true motion."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import ImuSamples
from magfusion.model.site import ImuModel
from magfusion.simulation.motion import SimulatedMotion
from magfusion.units import Array

# A first-order Gauss-Markov process of standard deviation s and correlation time T has its largest
# Allan deviation, 0.618 s, at the averaging time 1.89 T (IEEE Std 952-1997, annex C).
_PEAK_HEIGHT = 0.618
_PEAK_TIME = 1.89


@dataclass(frozen=True)
class BiasInstability:
    """The flat part of an Allan deviation plot, as a first-order Gauss-Markov process."""

    gyro: float  # largest Allan deviation of the process (rad/s)
    accel: float  # the same of the accelerometer (m/s^2)
    time: float  # averaging time at which it is largest (s)

    @property
    def sigma(self) -> Array:
        """Standard deviation of the process: gyro (rad/s), accelerometer (m/s^2)."""
        return np.array([self.gyro, self.accel]) / _PEAK_HEIGHT

    def decay(self, rate_hz: float) -> float:
        """Return the correlation of the process over one sample."""
        return float(np.exp(-_PEAK_TIME / (self.time * rate_hz)))


class SimulatedImu(NamedTuple):
    """Samples and the true biases in them, shape (n, 3) each (rad/s, m/s^2)."""

    samples: ImuSamples
    gyro_bias_body: Array
    accel_bias_body: Array


def simulate_imu(
    motion: SimulatedMotion,
    imu: ImuModel,
    gravity: float,
    rate_hz: float,
    duration: float,
    rng: np.random.Generator,
    time_offset: float = 0.0,
    instability: BiasInstability | None = None,
    clock_rate: float = 0.0,
) -> SimulatedImu:
    """Return inertial samples: the exact values of one instant, bias and white noise.

    Samples are not averages over their interval; to integrate them, treat them as points of a
    smooth curve.  Noise is discretised as GTSAM's preintegration assumes: white noise of
    density * sqrt(rate), walk steps of walk / sqrt(rate).

    Parameters
    ----------
    imu : ImuModel
        Its noise; its clock is not used.
    gravity : float
        (m/s^2)
    duration : float
        (s); stamps run from 0 to less than this.
    time_offset : float
        Offset (s) of the first sample: stamped t, it is taken at t + time_offset on the log's
        clock.
    instability : BiasInstability, optional
        Added to the bias walk.
    clock_rate : float
        Rate of change of the time offset (s/s).

    Raises
    ------
    InputError
        If there is no sample.
    """
    count = int(np.floor(duration * rate_hz * (1.0 + 1e-12)))
    if not rate_hz > 0.0 or count < 1:
        raise InputError(
            f"imu_rate_hz: found {rate_hz} Hz for {duration} s; give at least one sample"
        )
    stamp = np.arange(count) / rate_hz
    instant = (1.0 + clock_rate) * stamp + time_offset
    gyro_bias = _bias_walk(rng, count, rate_hz, imu.gyro_bias_sigma, imu.gyro_bias_walk)
    accel_bias = _bias_walk(rng, count, rate_hz, imu.accel_bias_sigma, imu.accel_bias_walk)
    if instability is not None:
        decay = instability.decay(rate_hz)
        for bias, sigma in zip((gyro_bias, accel_bias), instability.sigma, strict=True):
            bias += _instability(rng, count, sigma, decay)
    white = np.sqrt(rate_hz) * rng.normal(size=(2, count, 3))
    gyro = motion.rate_body(instant) + gyro_bias + imu.gyro_noise * white[0]
    force = motion.specific_force_body(instant, gravity)
    accel = force + accel_bias + imu.accel_noise * white[1]
    return SimulatedImu(ImuSamples(stamp, gyro, accel), gyro_bias, accel_bias)


def _bias_walk(
    rng: np.random.Generator, count: int, rate_hz: float, initial_sigma: float, walk: float
) -> Array:
    """Return a random walk with a random start, shape (count, 3)."""
    steps = rng.normal(0.0, walk / np.sqrt(rate_hz), (count, 3))
    steps[0] = rng.normal(0.0, initial_sigma, 3)
    return np.cumsum(steps, axis=0)


def _instability(rng: np.random.Generator, count: int, sigma: float, decay: float) -> Array:
    """Return a stationary first-order Gauss-Markov process, shape (count, 3)."""
    from scipy.signal import lfilter  # takes as long as all else to import

    drive = rng.normal(0.0, sigma * np.sqrt(1.0 - decay**2), (count, 3))
    drive[0] = rng.normal(0.0, sigma, 3)
    return lfilter([1.0], [1.0, -decay], drive, axis=0)
