"""Streams of a log as arrays, time first."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from magfusion.model.aiding import AidingSamples
from magfusion.model.drive import DriveSamples
from magfusion.model.marks import Marks
from magfusion.model.rotor import Depths as Depths
from magfusion.model.rotor import RotorAngles as RotorAngles
from magfusion.model.short_repr import short_repr
from magfusion.model.temperature import Temperatures
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

MAX_MOVING_WINDOW = 5.0  # s; of a window, unless the platform rests


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Inertial stream."""

    __repr__ = short_repr

    time: Array  # (n,), seconds since the log's epoch, strictly increasing; the IMU's own stamps
    gyro_body: Array  # (n, 3), angular rate (rad/s)
    accel_body: Array  # (n, 3), specific force (m/s^2): +g on z at rest, level

    def __len__(self) -> int:
        return len(self.time)

    @staticmethod
    def empty() -> "ImuSamples":
        """Return a stream without samples."""
        return ImuSamples(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Waveform:
    """Raw magnetometer stream of the instrument."""

    __repr__ = short_repr

    time: Array  # (n,), seconds since the log's epoch, strictly increasing
    # (n, 3), uncalibrated flux density (T); zero in the columns of axes that the receiver lacks
    measured_sensor: Array
    # times at which coils were driven, if recorded; includes bursts outside the samples
    marks: Marks | None = None
    axes: str = "xyz"  # axes of the receiver; the other columns are invalid
    ac_coupled: bool = False  # whether the samples hold no static field

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, kept: IntArray | BoolArray | slice) -> "Waveform":
        """Return a subset of the samples."""
        time, measured = self.time[kept], self.measured_sensor[kept]
        return replace(self, time=time, measured_sensor=measured)


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
        Covariance of the real part, and equally of the imaginary part (T^2).
    ahead : ndarray, shape (n, channels), optional
        Time of each measurement after ``time`` (s): of coils driven in turn, whose phasors are
        nevertheless in the sensor's axes of ``time``.
    axes : str
        Components that the receiver has; the others are NaN.
    signed : bool
        False for amplitudes of a one-axis receiver, whose sign and phase, if any, are those of a
        prediction.
    magnetometers : tuple of str
        Name of the magnetometer of each channel; empty for a single one.
    channel_rotation : ndarray, shape (n, channels, 3, 3), optional
        From the body's axes at the measurement to those at ``time``, where phasors are in the
        former: of coils driven in turn, by a receiver that lacks axes.
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
    channel_rotation: Array | None = None

    def __post_init__(self) -> None:
        n, c = len(self.time), len(self.channels)
        for name, shape in (
            ("window", (n,)),
            ("phasor_sensor", (n, c, 3)),
            ("phasor_cov", (n, c, 3, 3)),
        ):
            if getattr(self, name).shape != shape:
                result = getattr(self, name).shape
                raise ValueError(f"{name} must have shape {shape}; got {result}")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def of_rests(self) -> bool:
        """Whether each epoch is a whole stationary interval: long, without overlap."""
        if len(self) == 0 or float(np.max(self.window)) <= MAX_MOVING_WINDOW:
            return False
        end, begin = self.time + 0.5 * self.window, self.time - 0.5 * self.window
        return bool(np.all(begin[1:] >= end[:-1] - 1e-6))

    def is_stationary(self, time: Array) -> BoolArray:
        """Return which times are within a stationary interval that is an epoch, shape (n,)."""
        if not self.of_rests:
            return np.zeros(len(time), dtype=bool)
        begin, end = self.rest_about(time)
        return np.asarray((time >= begin - 1e-6) & (time <= end + 1e-6))

    def rest_about(self, time: Array) -> tuple[Array, Array]:
        """Return begin and end of the stationary interval nearest after times, or the last (s)."""
        end = self.time + 0.5 * self.window
        at = np.minimum(np.searchsorted(end, time - 1e-6), len(self) - 1)
        return end[at] - self.window[at], end[at]

    @staticmethod
    def empty(channels: tuple[tuple[str, int], ...]) -> "FieldSamples":
        """Return samples of these channels without epochs."""
        shape = (0, len(channels), 3)
        none, phasor = np.zeros(0), np.zeros(shape, dtype=np.complex128)
        return FieldSamples(none, none, channels, phasor, np.zeros((*shape, 3)))

    @staticmethod
    def joined(parts: list["FieldSamples"]) -> "FieldSamples":
        """Concatenate the epochs of several."""
        ahead, rotation = None, [p.channel_rotation for p in parts]
        if any(p.ahead is not None for p in parts):
            ahead = np.concatenate([p.ahead_or_zero for p in parts])
        return replace(
            parts[0],
            time=np.concatenate([p.time for p in parts]),
            window=np.concatenate([p.window for p in parts]),
            phasor_sensor=np.concatenate([p.phasor_sensor for p in parts]),
            phasor_cov=np.concatenate([p.phasor_cov for p in parts]),
            ahead=ahead,
            channel_rotation=np.concatenate([r for r in rotation if r is not None])
            if all(r is not None for r in rotation)
            else None,
        )

    def epochs(self) -> list["FieldSamples"]:
        """Return each epoch separately."""
        return [self.rows(slice(i, i + 1)) for i in range(len(self))]

    def rows(self, kept: IntArray | BoolArray | slice) -> "FieldSamples":
        """Return a subset of the epochs."""
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
            None if self.channel_rotation is None else self.channel_rotation[kept],
        )

    def of_magnetometer(self, name: str) -> "FieldSamples":
        """Return the channels of one magnetometer at the epochs that have any of them."""
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
        """Time of each phasor after that of its row (s), shape (n, channels)."""
        shape = (len(self.time), len(self.channels))
        return np.zeros(shape) if self.ahead is None else self.ahead

    @property
    def there(self) -> BoolArray:
        """Which components each row has, shape (n, channels, 3)."""
        return np.isfinite(self.phasor_sensor)

    @property
    def valid(self) -> BoolArray:
        """Channels of which each row has at least one component, shape (n, channels)."""
        there = self.there  # three components: a reduction over so few is slower
        return np.asarray(there[..., 0] | there[..., 1] | there[..., 2])

    @property
    def partial(self) -> BoolArray:
        """Channels of which each row has some components and lacks others, (n, channels)."""
        there = self.there
        x, y, z = there[..., 0], there[..., 1], there[..., 2]
        return np.asarray((x | y | z) & ~(x & y & z))

    @property
    def numbers(self) -> IntArray:
        """Number of real values of each channel in each row, shape (n, channels)."""
        return (2 if self.signed else 1) * np.sum(self.there, axis=2)

    @property
    def is_measured(self) -> BoolArray:
        """Real, then imaginary, parts measured in each row, shape (n, channels, 6).

        An amplitude is one part, in place of the real one.
        """
        there = self.there
        return np.concatenate([there, there & self.signed], axis=2)


@dataclass(frozen=True, eq=False)
class StaticFields:
    """Steady part of the waveform, one row for each window: the Earth field and the offset."""

    __repr__ = short_repr

    time: Array  # (n,), centre of the window, seconds since the log's epoch
    measured_sensor: Array  # (n, 3) (T), measured axes at the centre
    cov: Array  # (n, 3, 3), of the instrument's noise alone (T^2)

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, kept: BoolArray | slice) -> "StaticFields":
        """Return a subset of the epochs."""
        return StaticFields(self.time[kept], self.measured_sensor[kept], self.cov[kept])


@dataclass(frozen=True)
class StreamClock:
    """Time stamps of a stream relative to its uniform sampling clock."""

    step: float  # between two samples (s)
    scatter: float  # root mean square of the stamps about the clock (s)
    lost_count: int  # missing samples outside gaps
    # whether the clock replaces the stamps; otherwise the samples were taken at the stamps
    replaced: bool
    # to which the stamps were rounded (s), where that explains their scatter; otherwise zero
    resolution: float = 0.0


@dataclass(frozen=True, eq=False)
class Log:
    """One recording; missing streams are None, a missing IMU is empty.

    ``epoch_ns`` is the log clock's zero, to which drive phases and every ``time`` refer.
    ``static`` has the times of ``fields`` and is not stored in a file.  ``clocks`` lists streams
    with scattered stamps, ``findings`` other repairs.  If not ``inertial``, the samples of the IMU
    are those of a motion prior (`magfusion.model.without_imu`), not measurements.
    ``temperatures`` are those for which the samples are not corrected yet.  ``drive`` has the
    recorded currents of coils, ``reference`` the samples of a remote second magnetometer by its own
    stamps, ``rotation`` the angles of rotors, ``depths`` those of wells, for ranging.
    ``waveforms`` are the samples of several magnetometers, by name and each by its own stamps; then
    ``waveform`` is None.  ``recorded_imu`` has the inertial samples as recorded where ``imu`` is
    without the errors that the site declares (`magfusion.model.without_imu.logged`), ``clock_rate``
    the rate by which the stamps of ``waveform`` are corrected.  ``aiding`` has the samples of
    further sensors, by name.
    """

    __repr__ = short_repr

    name: str
    epoch_ns: int
    source: str
    imu: ImuSamples
    waveform: Waveform | None = None
    fields: FieldSamples | None = None
    truth: Trajectory | None = None
    static: StaticFields | None = None
    clocks: Mapping[str, StreamClock] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    inertial: bool = True
    temperatures: Temperatures | None = None
    drive: DriveSamples | None = None
    reference: Waveform | None = None
    rotation: RotorAngles | None = None
    depths: Depths | None = None
    waveforms: Mapping[str, Waveform] = field(default_factory=dict)
    recorded_imu: ImuSamples | None = None
    clock_rate: float = 0.0
    clock_offset: float = 0.0
    aiding: Mapping[str, AidingSamples] = field(default_factory=dict)

    @property
    def vectors(self) -> Waveform | None:
        """Raw samples of the whole field; None if axes or the static field are missing."""
        wave = self.waveform
        return None if wave is None or wave.axes != "xyz" or wave.ac_coupled else wave
