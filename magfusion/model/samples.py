"""The streams of a log as arrays, time first."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from magfusion.model.drive import DriveSamples
from magfusion.model.marks import Marks
from magfusion.model.rotor import Depths as Depths
from magfusion.model.rotor import RotorAngles as RotorAngles
from magfusion.model.short_repr import short_repr
from magfusion.model.temperature import Temperatures
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

LONGEST_IN_MOTION = 5.0  # s; of a window, unless the platform rests


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

    __repr__ = short_repr

    time: Array
    gyro_body: Array
    accel_body: Array

    def __len__(self) -> int:
        return len(self.time)

    @staticmethod
    def empty() -> "ImuSamples":
        """Return no sample."""
        return ImuSamples(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Waveform:
    """Raw magnetometer stream, as the instrument gave it.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds since the log's epoch, strictly increasing.
    measured_sensor : ndarray, shape (n, 3)
        Uncalibrated flux density (T); zero in the columns of axes that the receiver lacks.
    marks : Marks, optional
        When which coil was driven, where that was recorded; bursts outside the samples, too.
    axes : str
        Those that the receiver has: the other columns say nothing.
    """

    __repr__ = short_repr

    time: Array
    measured_sensor: Array
    marks: Marks | None = None
    axes: str = "xyz"

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, kept: IntArray | BoolArray | slice) -> "Waveform":
        """Return some samples."""
        return Waveform(self.time[kept], self.measured_sensor[kept], self.marks, self.axes)


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
        (T), measured axes; NaN where the channel, or a component of it, is missing.
    phasor_cov : ndarray, shape (n, channels, 3, 3)
        Covariance of the real part, and of the imaginary part alike (T^2).
    ahead : ndarray, shape (n, channels), optional
        How much later than at ``time`` the sensor was where each phasor was measured (s): of coils
        driven in turn, whose phasors are in the sensor's axes of ``time`` all the same.
    axes : str
        Components that the receiver has; the others are NaN.
    signed : bool
        False of amplitudes, whose sign and phase, if any, are those of a prediction: of the one
        axis.
    magnetometers : tuple of str
        Name of the one that measures each channel; empty where there are not several.
    turned : ndarray, shape (n, channels, 3, 3), optional
        From the body's axes when each phasor was measured to those of ``time``, where phasors are
        in the axes of then: of coils driven in turn, by a receiver that lacks axes.
    """

    __repr__ = short_repr

    time: Array
    window: Array
    channels: tuple[tuple[str, int], ...]
    phasor_sensor: ComplexArray
    phasor_cov: Array
    ahead: Array | None = None
    axes: str = "xyz"
    signed: bool = True
    magnetometers: tuple[str, ...] = ()
    turned: Array | None = None

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

    @property
    def of_rests(self) -> bool:
        """Whether each epoch is a whole rest: long, and without a part of any other."""
        if len(self) == 0 or float(np.max(self.window)) <= LONGEST_IN_MOTION:
            return False
        end, begin = self.time + 0.5 * self.window, self.time - 0.5 * self.window
        return bool(np.all(begin[1:] >= end[:-1] - 1e-6))

    def at_rest(self, time: Array) -> BoolArray:
        """Tell which times lie in a whole rest that is an epoch, shape (n,)."""
        if not self.of_rests:
            return np.zeros(len(time), dtype=bool)
        begin, end = self.rest_about(time)
        return np.asarray((time >= begin - 1e-6) & (time <= end + 1e-6))

    def rest_about(self, time: Array) -> tuple[Array, Array]:
        """Return beginning and end of the whole rest that is nearest after times, or last (s)."""
        end = self.time + 0.5 * self.window
        at = np.minimum(np.searchsorted(end, time - 1e-6), len(self) - 1)
        return end[at] - self.window[at], end[at]

    @staticmethod
    def empty(channels: tuple[tuple[str, int], ...]) -> "FieldSamples":
        """Return no epoch of these channels."""
        shape = (0, len(channels), 3)
        none, phasor = np.zeros(0), np.zeros(shape, dtype=np.complex128)
        return FieldSamples(none, none, channels, phasor, np.zeros((*shape, 3)))

    @staticmethod
    def joined(parts: list["FieldSamples"]) -> "FieldSamples":
        """Return the epochs of several, one after the other."""
        return FieldSamples(
            time=np.concatenate([p.time for p in parts]),
            window=np.concatenate([p.window for p in parts]),
            channels=parts[0].channels,
            phasor_sensor=np.concatenate([p.phasor_sensor for p in parts]),
            phasor_cov=np.concatenate([p.phasor_cov for p in parts]),
            ahead=None
            if all(p.ahead is None for p in parts)
            else np.concatenate([p.ahead_or_zero for p in parts]),
            axes=parts[0].axes,
            signed=parts[0].signed,
            magnetometers=parts[0].magnetometers,
        )

    def epochs(self) -> list["FieldSamples"]:
        """Return each epoch alone."""
        return [self.rows(slice(i, i + 1)) for i in range(len(self))]

    def rows(self, kept: IntArray | BoolArray | slice) -> "FieldSamples":
        """Return some epochs."""
        return FieldSamples(
            self.time[kept],
            self.window[kept],
            self.channels,
            self.phasor_sensor[kept],
            self.phasor_cov[kept],
            None if self.ahead is None else self.ahead[kept],
            self.axes,
            self.signed,
            self.magnetometers,
            None if self.turned is None else self.turned[kept],
        )

    def of_magnetometer(self, name: str) -> "FieldSamples":
        """Return the channels of one magnetometer at the epochs that hold any of them."""
        own = np.array([magnetometer == name for magnetometer in self.magnetometers], dtype=bool)
        channels = tuple(c for c, mine in zip(self.channels, own, strict=True) if mine)
        phasor, cov = self.phasor_sensor[:, own], self.phasor_cov[:, own]
        ahead = None if self.ahead is None else self.ahead[:, own]
        alone = replace(
            self,
            channels=channels,
            phasor_sensor=phasor,
            phasor_cov=cov,
            ahead=ahead,
            magnetometers=(),
        )
        return alone.rows(np.any(alone.valid, axis=1))

    @property
    def ahead_or_zero(self) -> Array:
        """How much later each phasor was measured (s), shape (n, channels)."""
        shape = (len(self.time), len(self.channels))
        return np.zeros(shape) if self.ahead is None else self.ahead

    @property
    def there(self) -> BoolArray:
        """Which components each row holds, shape (n, channels, 3)."""
        return np.isfinite(self.phasor_sensor)

    @property
    def valid(self) -> BoolArray:
        """Of which channels each row holds a component at least, shape (n, channels)."""
        there = self.there  # of three components: a reduction over so few costs more
        return np.asarray(there[..., 0] | there[..., 1] | there[..., 2])

    @property
    def partial(self) -> BoolArray:
        """Of which channels each row holds some components and lacks others, (n, channels)."""
        there = self.there
        x, y, z = there[..., 0], there[..., 1], there[..., 2]
        return np.asarray((x | y | z) & ~(x & y & z))

    @property
    def numbers(self) -> IntArray:
        """How many real numbers of each channel each row holds, shape (n, channels)."""
        return (2 if self.signed else 1) * np.sum(self.there, axis=2)

    @property
    def told(self) -> BoolArray:
        """Which real, then imaginary, parts each row tells, shape (n, channels, 6).

        An amplitude tells one part, in the place of the real one.
        """
        there = self.there
        return np.concatenate([there, there & self.signed], axis=2)


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

    __repr__ = short_repr

    time: Array
    measured_sensor: Array
    cov: Array

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, kept: BoolArray | slice) -> "SteadyFields":
        """Return some epochs."""
        return SteadyFields(self.time[kept], self.measured_sensor[kept], self.cov[kept])


@dataclass(frozen=True)
class StreamClock:
    """How the stamps of a stream lie about the even clock that it was sampled by.

    Parameters
    ----------
    step : float
        Between two samples (s).
    scatter : float
        Root mean square of the stamps about the clock (s).
    lost : int
        Samples that are missing, gaps aside.
    replaced : bool
        Whether the clock has taken the stamps' place; otherwise the samples were taken at them.
    """

    step: float
    scatter: float
    lost: int
    replaced: bool


@dataclass(frozen=True, eq=False)
class Log:
    """One recording; streams that it does not hold are None, an IMU that it does not is empty.

    ``epoch_ns`` is the log clock's zero, to which drive phases and every ``time`` refer.
    ``steady`` goes with ``fields``, at the same times; no file holds it.  ``clocks`` says of which
    streams the stamps scatter, ``noticed`` what else was mended in it.  Where not ``inertial``, the
    samples of the IMU are those of a motion prior (`magfusion.model.without_imu`), and measured
    nothing.  ``temperatures`` are those of whatever the samples are not yet freed of,
    ``drive`` is what was recorded of the currents of coils beside the waveform, ``reference`` the
    samples of a second magnetometer that stands elsewhere, by its own stamps,
    ``rotation`` the angles of rotors.  ``depths`` are those of wells, for ranging.
    ``waveforms`` are the samples of several magnetometers, by name and each by its own stamps; then
    ``waveform`` is None.
    """

    __repr__ = short_repr

    name: str
    epoch_ns: int
    source: str
    imu: ImuSamples
    waveform: Waveform | None = None
    fields: FieldSamples | None = None
    truth: Trajectory | None = None
    steady: SteadyFields | None = None
    clocks: Mapping[str, StreamClock] = field(default_factory=dict)
    noticed: tuple[Finding, ...] = ()
    inertial: bool = True
    temperatures: Temperatures | None = None
    drive: DriveSamples | None = None
    reference: Waveform | None = None
    rotation: RotorAngles | None = None
    depths: Depths | None = None
    waveforms: Mapping[str, Waveform] = field(default_factory=dict)

    @property
    def vectors(self) -> Waveform | None:
        """Raw samples of all three axes; None where there are none."""
        wave = self.waveform
        return None if wave is None or wave.axes != "xyz" else wave
