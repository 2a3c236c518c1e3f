"""The streams of a log as arrays, time first."""

from dataclasses import dataclass

import numpy as np

from magfusion.trajectory import Trajectory
from magfusion.units import Array, BoolArray, ComplexArray


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Inertial stream.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds since the log's epoch, strictly increasing; the IMU's own stamps.
    gyro_body : ndarray, shape (n, 3)
        Angular rate (rad/s).
    accel_body : ndarray, shape (n, 3)
        Specific force (m/s^2): +g on z at rest, level.
    """

    time: Array
    gyro_body: Array
    accel_body: Array

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, eq=False)
class Waveform:
    """Raw magnetometer stream, as the instrument gave it.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds since the log's epoch, strictly increasing.
    measured_sensor : ndarray, shape (n, 3)
        Uncalibrated flux density (T).
    """

    time: Array
    measured_sensor: Array

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """Demodulated phasors, one row per window; a channel is one tone of one beacon.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Centre of the window, seconds since the log's epoch.
    window : ndarray, shape (n,)
        Length of the window (s).
    channels : tuple of (str, int)
        Beacon name and tone of each channel, in the site's order.
    phasor_sensor : complex ndarray, shape (n, channels, 3)
        (T), measured axes; NaN where the channel is missing.
    phasor_cov : ndarray, shape (n, channels, 3, 3)
        Covariance of the real part, and of the imaginary part alike (T^2).
    """

    time: Array
    window: Array
    channels: tuple[tuple[str, int], ...]
    phasor_sensor: ComplexArray
    phasor_cov: Array

    def __post_init__(self) -> None:
        n, c = len(self.time), len(self.channels)
        for name, shape in (
            ("window", (n,)),
            ("phasor_sensor", (n, c, 3)),
            ("phasor_cov", (n, c, 3, 3)),
        ):
            if getattr(self, name).shape != shape:
                found = getattr(self, name).shape
                raise ValueError(f"{name} must have shape {shape}; got {found}")

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, kept: BoolArray | slice) -> "FieldSamples":
        """Return some epochs."""
        return FieldSamples(
            self.time[kept],
            self.window[kept],
            self.channels,
            self.phasor_sensor[kept],
            self.phasor_cov[kept],
        )

    @property
    def valid(self) -> BoolArray:
        """Which channels each row holds, shape (n, channels)."""
        return np.asarray(np.isfinite(self.phasor_sensor).all(axis=2))


@dataclass(frozen=True, eq=False)
class SteadyFields:
    """Steady part of the waveform, one row for each window: the Earth field and the offset.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Centre of the window, seconds since the log's epoch.
    measured_sensor : ndarray, shape (n, 3)
        (T), measured axes at the centre.
    cov : ndarray, shape (n, 3, 3)
        Of the instrument's noise alone (T^2).
    """

    time: Array
    measured_sensor: Array
    cov: Array

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, kept: BoolArray | slice) -> "SteadyFields":
        """Return some epochs."""
        return SteadyFields(self.time[kept], self.measured_sensor[kept], self.cov[kept])


@dataclass(frozen=True, eq=False)
class Log:
    """One recording; streams that it does not hold are None.

    ``epoch_ns`` is the log clock's zero, to which drive phases and every ``time`` refer.
    ``steady`` stands beside ``fields``, at the same times; no file holds it.
    """

    name: str
    epoch_ns: int
    source: str
    imu: ImuSamples
    waveform: Waveform | None = None
    fields: FieldSamples | None = None
    truth: Trajectory | None = None
    steady: SteadyFields | None = None
