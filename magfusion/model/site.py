"""The site: beacons, the moving platform, and the uncertainty of their calibration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from magfusion.model.aiding import AidingSensor
from magfusion.model.beacon import Beacon as Beacon
from magfusion.model.beacon import BeaconSigma as BeaconSigma
from magfusion.model.beacon import Coil as Coil
from magfusion.model.beacon import Unknown as Unknown
from magfusion.model.beacon import rotor_coils as rotor_coils
from magfusion.model.correlation import Correlation
from magfusion.model.drive import DriveShares
from magfusion.model.imu_intrinsics import ImuIntrinsics
from magfusion.model.magnetometer import Magnetometer as Magnetometer
from magfusion.model.magnetometer import MagnetometerSigma as MagnetometerSigma
from magfusion.model.platform_motion import A_HAND, MotionPrior, Replaced
from magfusion.model.platform_motion import ImuModel as ImuModel
from magfusion.model.platform_motion import MotionModel as MotionModel
from magfusion.model.region import Bounds, Region, bounds_of
from magfusion.model.rotor import Rotor as Rotor
from magfusion.model.short_repr import short_repr
from magfusion.model.temperature import Temperatures
from magfusion.model.time_division import MarkedSlots as MarkedSlots
from magfusion.model.time_division import Slots as Slots
from magfusion.units import Array, IntArray


@dataclass(frozen=True)
class ClockModel:
    """Clock of an unsynchronised beacon, and stability of all drives."""

    # drift_sigma, drift_largest: prior sigma of a clock's relative error, as of an ordinary
    # crystal; and the largest error that is searched
    drift_sigma: float = 2e-5
    drift_largest: float = 1e-4
    # phase_walk, drift_walk, log_moment_walk: standard deviation that drive phase (rad), relative
    # error of the clock, and logarithm of a moment gain in an hour, by temperature and ageing
    phase_walk: float = 0.02
    drift_walk: float = 1e-8
    log_moment_walk: float = 1e-3


@dataclass(frozen=True)
class EarthModel:
    """Change of the declared Earth field by a building's iron, outside of steel halls."""

    declination_sigma: float = float(np.deg2rad(3.0))  # of its azimuth (rad)
    strength_sigma: float = 0.02  # of its horizontal and of its vertical part, relative to its size
    # declination_walk, strength_walk: standard deviation that azimuth (rad) and parts (T) gain in
    # an hour: the field changes as the platform moves
    declination_walk: float = 0.05
    strength_walk: float = 1e-6


@dataclass(frozen=True)
class Platform:
    """Moving platform: an IMU and one or several magnetometers, rigidly mounted together."""

    __repr__ = short_repr

    imu: ImuModel
    magnetometer: Magnetometer  # the single or first one
    motion: MotionModel = A_HAND
    motion_prior: MotionPrior | None = None  # assumed motion if a log has no inertial samples
    # parts that the prior replaces (`magfusion.model.without_imu`); None if the IMU measures
    replaced: Replaced | None = None
    further: tuple[Magnetometer, ...] = ()  # the other magnetometers
    # magnetometers excluded for a log, each with its index at that time
    left_out: tuple[tuple[int, Magnetometer], ...] = ()
    # scale factors, axes and g-sensitivity of the IMU; None if it is ideal
    imu_intrinsics: ImuIntrinsics | None = None

    @property
    def inertial(self) -> bool:
        """Whether an IMU measures the motion."""
        return self.replaced is None

    @property
    def magnetometers(self) -> tuple[Magnetometer, ...]:
        """Every magnetometer."""
        return (self.magnetometer, *self.further)

    def corrected_imu(self, gyro_body: Array, accel_body: Array) -> tuple[Array, Array]:
        """Return inertial samples (n, 3) without the declared errors of the IMU."""
        if self.imu_intrinsics is None:
            return gyro_body, accel_body
        return self.imu_intrinsics.corrected(gyro_body, accel_body)

    def on_drive_clock(self, time: Array) -> Array:
        """Return stamps of the magnetometer on the clock of the drives (s)."""
        rate, offset = self.log_clock
        return time if rate == offset == 0.0 else time * (1.0 + rate) + offset

    @property
    def log_clock(self) -> tuple[float, float]:
        """Rate and offset (s) of the drives' clock relative to the only magnetometer's stamps."""
        return self.magnetometer.clock_rate, self.magnetometer.clock_offset

    def with_magnetometers(self, magnetometers: tuple[Magnetometer, ...]) -> "Platform":
        """Return the platform with other magnetometers."""
        return replace(self, magnetometer=magnetometers[0], further=magnetometers[1:])


@dataclass(frozen=True)
class Location:
    """Location and date for the geomagnetic reference field; ``date`` is ISO 8601 (YYYY-MM-DD)."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    date: str


@dataclass(frozen=True, eq=False)
class Site:
    """Prior knowledge before a log is read.

    Parameters
    ----------
    gravity : float
        (m/s^2)
    model_error : float
        Relative error of the field model, one sigma per phasor.
    beacons : tuple of Beacon
        In the order of the file, which is that of ``channels``.
    platform : Platform
        IMU, magnetometers, and models of the motion.
    clock : ClockModel
        Of the drives.
    earth : EarthModel
        Sigmas of the declared Earth field.
    model_error_length : float
        Correlation length of that error (m): it is caused by iron, is constant in place, and does
        not average over epochs that are closer.
    location : Location, optional
        Place and date, for the IGRF.
    earth_field_world : ndarray, shape (3,), optional
        (T); from ``location`` by the IGRF if that is given instead.
    calibration : mapping, optional
        Source of refined values: log, and parameters that it did and did not determine.
    correlation : Correlation, optional
        Of the errors behind the sigmas; None if all are independent.
    region : Region, optional
        Region that contains the magnetometer.
    temperatures : Temperatures, optional
        Of its beacons, from a log or a stream.
    drives : DriveShares, optional
        Of its beacons' currents, from a log or a stream.
    log_conductivity_sigma : float
        Of the logarithm of its conductivity; zero means known.
    reference_world : ndarray, shape (3,), optional
        Position of a second magnetometer that measures the noise (m).
    undetected : tuple of (int, Beacon)
        Beacons not detected in a log, with their indices among all; they remain as declared.
    aiding : tuple of AidingSensor
        Further sensors of the platform, with different names.
    """

    __repr__ = short_repr

    gravity: float
    model_error: float
    beacons: tuple[Beacon, ...]
    platform: Platform
    earth_field_world: Array | None = None
    location: Location | None = None
    calibration: Mapping[str, object] | None = None
    correlation: Correlation | None = None
    clock: ClockModel = ClockModel()
    earth: EarthModel = EarthModel()
    model_error_length: float = 0.5
    region: Region | None = None
    temperatures: Temperatures | None = None
    drives: DriveShares | None = None
    log_conductivity_sigma: float = 0.0
    reference_world: Array | None = None
    undetected: tuple[tuple[int, Beacon], ...] = ()
    aiding: tuple[AidingSensor, ...] = ()

    @cached_property
    def bounds(self) -> Bounds | None:
        """Planes that bound the magnetometer's position; None if none is declared."""
        return bounds_of(self.region, self.beacons)

    @property
    def every_beacon(self) -> tuple[Beacon, ...]:
        """Detected and undetected beacons, in the order of the file."""
        every = list(self.beacons)
        for number, beacon in self.undetected:
            every.insert(number, beacon)
        return tuple(every)

    def without_steel(self) -> "Site":
        """Return the site without a map of steel; itself if it has none."""
        if all(beacon.steel is None for beacon in self.every_beacon):
            return self
        return replace(
            self,
            beacons=tuple(replace(b, steel=None) for b in self.beacons),
            undetected=tuple((number, replace(b, steel=None)) for number, b in self.undetected),
        )

    @cached_property
    def channels(self) -> tuple[tuple[str, int], ...]:
        """(beacon, tone) of each phasor, in site order: the channel axis of `FieldSamples`.

        With several magnetometers, those of the first, then of the next.
        """
        own = tuple((b.name, k) for b in self.beacons for k in range(len(b.tones)))
        return own * len(self.platform.magnetometers)

    @cached_property
    def tone_frequencies_hz(self) -> Array:
        """Frequency of each channel of a magnetometer (Hz)."""
        return np.concatenate([beacon.tone_frequencies_hz for beacon in self.beacons])

    def frequencies_of(self, channels: Sequence[tuple[str, int]]) -> Array:
        """Return the frequency of some channels (Hz); zero where the site has none of that name."""
        known = {
            (beacon.name, tone): frequency_hz
            for beacon in self.beacons
            for tone, frequency_hz in enumerate(beacon.tone_frequencies_hz)
        }
        return np.array([known.get(channel, 0.0) for channel in channels])

    @cached_property
    def owner(self) -> IntArray:
        """Index of each channel's beacon, shape (channels,)."""
        own = [i for i, beacon in enumerate(self.beacons) for _ in beacon.tones]
        return np.array(own * len(self.platform.magnetometers), dtype=np.int64)

    @cached_property
    def sensor(self) -> IntArray:
        """Index of each channel's magnetometer, shape (channels,)."""
        count = len(self.platform.magnetometers)
        return np.repeat(np.arange(count), len(self.channels) // count)

    @property
    def relative_clock(self) -> ClockModel:
        """Return the clock of a drive relative to that of the magnetometer."""
        own, clock = self.platform.magnetometer.clock_rate_sigma, self.clock
        if not own:
            return clock
        sigma, largest = np.hypot(clock.drift_sigma, own), clock.drift_largest + 3.0 * own
        return replace(clock, drift_sigma=float(sigma), drift_largest=float(largest))

    def of_sensor(self, sensor: int) -> slice:
        """Return the channels of one magnetometer."""
        count = len(self.channels) // len(self.platform.magnetometers)
        return slice(sensor * count, (sensor + 1) * count)
