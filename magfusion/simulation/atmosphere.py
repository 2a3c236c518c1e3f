"""Noise common to all places, from distant storms, which a second magnetometer also receives."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from magfusion.units import Array

OVERSAMPLED = 4  # of the grid that samples of any clock are taken from
LOWEST_HZ = 1e-2  # below, it is flat
MARGIN = 10.0  # s, before and after


@dataclass(frozen=True)
class Atmosphere:
    """Gaussian noise of a density that falls with the frequency, common to all instruments."""

    density: float  # one-sided, at 1 Hz (T/sqrt(Hz)), of each world component
    seed: int  # instruments with the same seed receive the same noise
    duration: float  # length of the noise (s)
    highest_hz: float  # upper cutoff frequency
    exponent: float = 0.5  # power of the frequency with which the density falls

    def field_world(self, time: Array) -> Array:
        """Return the noise at times within its duration, shape (n, 3) (T)."""
        step = 0.5 / (self.highest_hz * OVERSAMPLED)
        count = int((self.duration + 2.0 * MARGIN) / step)
        hertz = np.fft.rfftfreq(count, step)
        size = self.density * np.maximum(hertz, LOWEST_HZ) ** -self.exponent
        size[(hertz > self.highest_hz) | (hertz == 0.0)] = 0.0
        rng = np.random.default_rng(self.seed)
        drawn = rng.standard_normal((len(hertz), 3)) + 1j * rng.standard_normal((len(hertz), 3))
        # A one-sided density d is a variance of d^2 / (2 step) of white samples.
        scale = 0.5 * np.sqrt(count / step)
        even = np.fft.irfft(drawn * (size * scale)[:, None], count, axis=0)
        grid = step * np.arange(count) - MARGIN
        return np.asarray(CubicSpline(grid, even)(time))
