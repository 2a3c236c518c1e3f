"""Slow change over hours: coils that warm up, gains that wander, clocks that part.

Processes are described by frozen dataclasses; `Drift` says which of them a run has, and
`draw_drift` draws what they do to each epoch: a gain of each beacon, the lead of the drives' clock
(hence a phase of each tone), and a scale of the magnetometer.  A change of the ambient field is no
matter of this module: see `magfusion.simulation.disturbance`.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.simulation.disturbance import DAY
from magfusion.units import Array

COPPER_PER_KELVIN = 3.9e-3  # relative rise of resistance


@dataclass(frozen=True)
class WarmUp:
    """A body with one thermal time constant, heated evenly since the log's epoch.

    Parameters
    ----------
    rise : float
        In the end (K).
    time_constant : float
        (s)
    """

    rise: float
    time_constant: float

    def temperature(self, time: Array) -> Array:
        """Return the temperature above that of the epoch (K) at times since then (s)."""
        return -self.rise * np.expm1(-time / self.time_constant)


@dataclass(frozen=True)
class DailySwing:
    """A temperature that follows the day along a cosine.

    Parameters
    ----------
    amplitude : float
        Half of what lies between least and most (K).
    warmest_time : float
        Seconds since the log's epoch; once a day.
    """

    amplitude: float
    warmest_time: float = 0.0

    def temperature(self, time: Array) -> Array:
        """Return the temperature above the day's mean (K) at times (s)."""
        turns = (time - self.warmest_time) / DAY
        return self.amplitude * np.cos(2.0 * np.pi * turns)


@dataclass(frozen=True)
class Wander:
    """A random change that stays bounded (Ornstein-Uhlenbeck), stationary from the start.

    Parameters
    ----------
    rms : float
        In the unit of what wanders.
    time_constant : float
        After which the correlation has fallen to 1/e (s).
    """

    rms: float
    time_constant: float

    def draw(self, time: Array, functions: int, rng: np.random.Generator) -> Array:
        """Return independent paths, exact at any spacing of the times.

        Parameters
        ----------
        time : ndarray, shape (n,)
            Increasing (s).

        Returns
        -------
        ndarray, shape (n, functions)
        """
        path = rng.normal(0.0, self.rms, (len(time), functions))
        kept = np.exp(-np.diff(time) / self.time_constant)
        fresh = np.sqrt(-np.expm1(-2.0 * np.diff(time) / self.time_constant))
        for k in range(1, len(time)):
            path[k] = kept[k - 1] * path[k - 1] + fresh[k - 1] * path[k]
        return path


@dataclass(frozen=True)
class Clock:
    """The clock of the drives against that of the log; both agree at the log's epoch.

    Parameters
    ----------
    rate : float
        Relative error of its frequency, constant; positive for one that runs fast, as
        `magfusion.simulation.field.Drives.drift`.
    walk : float
        White noise of its frequency, by which its lead walks (s per root second): what its Allan
        deviation is at one second.
    """

    rate: float = 0.0
    walk: float = 0.0

    def lead(self, time: Array, rng: np.random.Generator) -> Array:
        """Return by how much the drives are ahead (s), shape (n,).

        Parameters
        ----------
        time : ndarray, shape (n,)
            Seconds since the log's epoch, increasing.

        Raises
        ------
        ValueError
            Where time runs backwards, or starts before the epoch.
        """
        elapsed = np.diff(time, prepend=0.0)
        if np.any(elapsed < 0.0):
            raise ValueError("times must increase from the log's epoch")
        steps = self.walk * np.sqrt(elapsed) * rng.standard_normal(len(time))
        return self.rate * time + np.cumsum(steps)


@dataclass(frozen=True)
class Drift:
    """What drifts in a run; what is None does not.

    Parameters
    ----------
    coils : WarmUp, optional
        Temperature of all coils and their amplifiers, which are driven alike.
    fading_per_kelvin : float
        The moment of a coil warmer by T kelvin is ``1 / (1 + fading T)`` of what it was: for a
        constant voltage `COPPER_PER_KELVIN`, for a constant current what its source loses.
    gain : Wander, optional
        Of the logarithm of each beacon's moment, independent between beacons.
    clock : Clock, optional
        One for all drives, as where one generator feeds them.
    sensor : DailySwing, optional
        Temperature of the magnetometer.
    scale_per_kelvin : float
        Relative rise of the magnetometer's scale.
    """

    coils: WarmUp | None = None
    fading_per_kelvin: float = 0.0
    gain: Wander | None = None
    clock: Clock | None = None
    sensor: DailySwing | None = None
    scale_per_kelvin: float = 0.0


@dataclass(frozen=True, eq=False)
class DriftSeries:
    """One draw of a `Drift`.

    Parameters
    ----------
    log_gain : ndarray, shape (n, beacons)
        Natural logarithm of each beacon's moment, relative to what is declared.
    lead : ndarray, shape (n,)
        Of the drives' clock before the log's (s).
    sensor_scale : ndarray, shape (n,)
        Of what the magnetometer gives, relative to what is declared.
    """

    log_gain: Array
    lead: Array
    sensor_scale: Array

    def phase(self, frequencies_hz: Array) -> Array:
        """Return the drive phase beyond what is declared (rad), shape (n, tones)."""
        return 2.0 * np.pi * self.lead[:, None] * frequencies_hz


def draw_drift(drift: Drift, time: Array, beacons: int, rng: np.random.Generator) -> DriftSeries:
    """Draw what drifts.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds since the log's epoch, increasing.
    rng : Generator
        Gains and clock have generators of their own, spawned from it, so that runs which differ in
        one of them share the other.
    """
    gain_rng, clock_rng = rng.spawn(2)
    log_gain = np.zeros((len(time), beacons))
    if drift.coils is not None:
        warmer = drift.coils.temperature(time)
        log_gain -= np.log1p(drift.fading_per_kelvin * warmer)[:, None]
    if drift.gain is not None:
        log_gain += drift.gain.draw(time, beacons, gain_rng)
    scale = np.ones(len(time))
    if drift.sensor is not None:
        scale += drift.scale_per_kelvin * drift.sensor.temperature(time)
    lead = np.zeros(len(time)) if drift.clock is None else drift.clock.lead(time, clock_rng)
    return DriftSeries(log_gain, lead, scale)
