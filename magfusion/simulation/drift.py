"""Slow change over hours: coils that warm up, gains that drift, clocks that diverge.

Processes are described by frozen dataclasses; `Drift` selects those of a run, and `draw_drift`
draws their effect at each epoch: a gain of each beacon, the lead of the drives' clock (hence a
phase of each tone), and a scale of the magnetometer.  For a change of the ambient field see
`magfusion.simulation.disturbance`.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.units import DAY, Array

COPPER_PER_KELVIN = 3.9e-3  # relative rise of resistance


@dataclass(frozen=True)
class WarmUp:
    """A body with one thermal time constant, heated uniformly since the log's epoch."""

    rise: float  # final temperature rise (K)
    time_constant: float  # (s)

    def temperature(self, time: Array) -> Array:
        """Return the temperature above that of the epoch (K) at times since then (s)."""
        return -self.rise * np.expm1(-time / self.time_constant)


@dataclass(frozen=True)
class DailySwing:
    """A daily temperature cycle along a cosine."""

    amplitude: float  # half of the peak-to-peak value (K)
    warmest_time: float = 0.0  # seconds since the log's epoch; once a day

    def temperature(self, time: Array) -> Array:
        """Return the temperature above the day's mean (K) at times (s)."""
        turns = (time - self.warmest_time) / DAY
        return self.amplitude * np.cos(2.0 * np.pi * turns)


@dataclass(frozen=True)
class Wander:
    """A random change that stays bounded (Ornstein-Uhlenbeck), stationary from the start."""

    rms: float  # in the unit of the process
    time_constant: float  # time after which the correlation is 1/e (s)

    def draw(self, time: Array, functions: int, rng: np.random.Generator) -> Array:
        """Return independent paths, exact at any spacing of the times.

        `time` (n,): increasing (s). Returns (n, functions).
        """
        path = rng.normal(0.0, self.rms, (len(time), functions))
        kept = np.exp(-np.diff(time) / self.time_constant)
        fresh = np.sqrt(-np.expm1(-2.0 * np.diff(time) / self.time_constant))
        for k in range(1, len(time)):
            path[k] = kept[k - 1] * path[k - 1] + fresh[k - 1] * path[k]
        return path


@dataclass(frozen=True)
class DriveClock:
    """The clock of the drives relative to that of the log; both agree at the log's epoch."""

    # relative error of its frequency, constant; positive for one that runs fast, as
    # `magfusion.simulation.field.Drives.drift`
    rate: float = 0.0
    # white frequency noise, which makes its lead a random walk (s per root second): the Allan
    # deviation at one second
    walk: float = 0.0

    def lead(self, time: Array, rng: np.random.Generator) -> Array:
        """Return the lead of the drives' clock (s), shape (n,).

        `time` (n,): seconds since the log's epoch, increasing. Raises ValueError where time
        decreases, or starts before the epoch.
        """
        elapsed = np.diff(time, prepend=0.0)
        if np.any(elapsed < 0.0):
            raise ValueError("times must increase from the log's epoch")
        steps = self.walk * np.sqrt(elapsed) * rng.standard_normal(len(time))
        return self.rate * time + np.cumsum(steps)


@dataclass(frozen=True)
class Drift:
    """Drift of a run; None where absent."""

    # temperature of all coils and their amplifiers, which are driven equally
    coils: WarmUp | None = None
    ambient: DailySwing | None = None  # temperature around them
    # the moment of a coil warmer by T kelvin is scaled by ``1 / (1 + fading T)``: for a constant
    # voltage `COPPER_PER_KELVIN`, for a constant current the loss of its source
    fading_per_kelvin: float = 0.0
    # of the logarithm of each beacon's moment, independent between beacons
    gain: Wander | None = None
    clock: DriveClock | None = None  # one for all drives, as of a common generator
    sensor: DailySwing | None = None  # temperature of the magnetometer
    scale_per_kelvin: float = 0.0  # relative rise of the magnetometer's scale


@dataclass(frozen=True, eq=False)
class DriftSeries:
    """One draw of a `Drift`."""

    # (n, beacons), natural logarithm of each beacon's moment, relative to the declared
    log_gain: Array
    lead: Array  # (n,), of the drives' clock relative to the log's (s)
    sensor_scale: Array  # (n,), of the magnetometer's output, relative to the declared

    def phase(self, frequencies_hz: Array) -> Array:
        """Return the drive phase in addition to the declared (rad), shape (n, tones)."""
        return 2.0 * np.pi * self.lead[:, None] * frequencies_hz


def draw_drift(drift: Drift, time: Array, beacons: int, rng: np.random.Generator) -> DriftSeries:
    """Draw a realisation of a drift.

    `time` (n,): seconds since the log's epoch, increasing.
    """
    gain_rng, clock_rng = rng.spawn(2)
    log_gain = np.zeros((len(time), beacons))
    for heat in (drift.coils, drift.ambient):
        if heat is not None:
            log_gain -= np.log1p(drift.fading_per_kelvin * heat.temperature(time))[:, None]
    if drift.gain is not None:
        log_gain += drift.gain.draw(time, beacons, gain_rng)
    scale = np.ones(len(time))
    if drift.sensor is not None:
        scale += drift.scale_per_kelvin * drift.sensor.temperature(time)
    lead = np.zeros(len(time)) if drift.clock is None else drift.clock.lead(time, clock_rng)
    return DriftSeries(log_gain, lead, scale)
