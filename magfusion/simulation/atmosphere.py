"""Noise that is the same at every place: storms far away, which a second magnetometer hears too."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from magfusion.units import Array

OVERSAMPLED = 4  # of the grid that samples of any clock are taken from
LOWEST_HZ = 1e-2  # below, it is flat
MARGIN = 10.0  # s, before and after


@dataclass(frozen=True)
class Atmosphere:
    """Gaussian noise of a density that falls with the frequency, alike for whoever listens.

    Parameters
    ----------
    density : float
        One-sided, at 1 Hz (T/sqrt(Hz)), of each world component.
    seed : int
        Two instruments with the same hear the same.
    exponent : float
        With which power of the frequency the density falls.
    duration : float
        What it covers (s).
    highest_hz : float
        Above, there is none.
    """

    density: float
    seed: int
    duration: float
    highest_hz: float
    exponent: float = 0.5

    def field_world(self, time: Array) -> Array:
        """Return it at times within what it covers, shape (n, 3) (T)."""
        step = 0.5 / (self.highest_hz * OVERSAMPLED)
        count = int((self.duration + 2.0 * MARGIN) / step)
        hertz = np.fft.rfftfreq(count, step)
        size = self.density * np.maximum(hertz, LOWEST_HZ) ** -self.exponent
        size[(hertz > self.highest_hz) | (hertz == 0.0)] = 0.0
        rng = np.random.default_rng(self.seed)
        drawn = rng.standard_normal((len(hertz), 3)) + 1j * rng.standard_normal((len(hertz), 3))
        # A one-sided density d has a variance of d^2 / (2 step) of white samples.
        scale = 0.5 * np.sqrt(count / step)
        even = np.fft.irfft(drawn * (size * scale)[:, None], count, axis=0)
        grid = step * np.arange(count) - MARGIN
        return np.asarray(CubicSpline(grid, even)(time))
