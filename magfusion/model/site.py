"""The site: beacons, the moving platform, and the uncertainty of their calibration."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from magfusion.model.aiding import AidingSensor
from magfusion.model.correlation import Correlation
from magfusion.model.drive import DriveShares
from magfusion.model.field_map import FieldMap
from magfusion.model.imu_intrinsics import ImuIntrinsics
from magfusion.model.magnetometer import Magnetometer as Magnetometer
from magfusion.model.magnetometer import MagnetometerSigma as MagnetometerSigma
from magfusion.model.platform_motion import A_HAND, MotionPrior, Replaced
from magfusion.model.platform_motion import ImuModel as ImuModel
from magfusion.model.platform_motion import MotionModel as MotionModel
from magfusion.model.region import Bounds, Region, bounds_of
from magfusion.model.rotor import Rotor as Rotor
from magfusion.model.short_repr import short_repr
from magfusion.model.temperature import MomentTemperatureModel, Temperatures
from magfusion.model.time_division import MarkedSlots as MarkedSlots
from magfusion.model.time_division import Slots as Slots
from magfusion.units import Array, ComplexArray, IntArray

Unknown = Literal["pose", "position", "attitude"]


@dataclass(frozen=True, eq=False)
class Coil:
    """One coil of a beacon, driven by ``cos(2 pi f t + phase)``.

    Parameters
    ----------
    moment_beacon : ndarray, shape (3,)
        Peak moment (A m^2).
    phase : float
        Drive phase relative to the log clock (rad).
    centre_beacon : ndarray, shape (3,)
        Magnetic centre relative to the beacon's origin (m).
    radius, length : float, optional
        Finite size (m), see `magfusion.model.coil_field`; None for a dipole.
    frequency_hz : float, optional
        Drive frequency where it differs from the beacon's (frequency division).
    slot : int, optional
        Time slot, counted from 0, where coils are driven in turn (time division).
    current : float, optional
        Peak current of the declared moment (A).
    """

    moment_beacon: Array
    phase: float = 0.0
    centre_beacon: Array = field(default_factory=lambda: np.zeros(3))
    radius: float | None = None
    length: float | None = None
    frequency_hz: float | None = None
    slot: int | None = None
    current: float | None = None


def rotor_coils(rotor: Rotor, frequency_hz: float) -> tuple[Coil, ...]:
    """Return the coils equivalent to a magnet on a shaft rotating at a frequency.

    Their current is one; a measured angle is recorded as its cosine.
    """
    cosine, sine = rotor.turning_moments
    turning = (Coil(cosine, current=1.0), Coil(sine, -np.pi / 2.0, current=1.0))
    return turning + tuple(
        Coil(one.moment_beacon, one.phase, frequency_hz=one.order * frequency_hz, current=1.0)
        for one in rotor.harmonics
    )


@dataclass(frozen=True, eq=False)
class BeaconSigma:
    """Prior standard deviations of a beacon's calibration; zero means known.

    Parameters
    ----------
    position_world : ndarray, shape (3,)
        Of the centre, world axes (m).
    rotation_beacon : ndarray, shape (3,)
        Of the attitude, beacon axes (rad).
    log_moment : ndarray, shape (coils,)
        Of the natural logarithm of each coil's moment.
    """

    position_world: Array
    rotation_beacon: Array
    log_moment: Array


@dataclass(frozen=True, eq=False)
class Beacon:
    """A magnetic source: one or more coils on a common rigid frame.

    Parameters
    ----------
    position_world : ndarray, shape (3,)
        Surveyed centre (m).
    world_from_beacon : ndarray, shape (3, 3)
        Rotation of the coil axes.
    synchronised : bool
        False where the drive phase relative to the log clock is unknown and drifts.
    field_map : FieldMap, optional
        Deviation of its field from the model where it was surveyed.
    slots : Slots or MarkedSlots, optional
        Time slots of its coils, if driven in turn on a known schedule; a frequency of zero then
        means pulses of direct current.
    unknown : {"pose", "position", "attitude"}, optional
        Unsurveyed part, to be estimated from a log; its values are NaN.
    model_error : float, optional
        Of its own field; the site's if None.
    noise_factor : float
        Noise of its phasors relative to that measured near its tones.
    temperature_model : MomentTemperatureModel, optional
        Temperature dependence of its moments.
    hemisphere_beacon : ndarray, shape (3,), optional
        Direction, of any length, of the half space that contains the magnetometer.
    conductivity : float
        Of the surrounding ground or water (S/m), uniform, isotropic and unbounded; equal for all
        beacons of a site.
    rotor : Rotor, optional
        Magnet on a shaft from which its coils are derived.
    planned : bool
        Whether its frequency is not chosen yet, so that it is shared with no other beacon.
    """

    __repr__ = short_repr

    name: str
    position_world: Array
    world_from_beacon: Array
    frequency_hz: float
    coils: tuple[Coil, ...]
    synchronised: bool
    sigma: BeaconSigma
    field_map: FieldMap | None = None
    slots: Slots | MarkedSlots | None = None
    unknown: Unknown | None = None
    model_error: float | None = None
    noise_factor: float = 1.0
    hemisphere_beacon: Array | None = None
    temperature_model: MomentTemperatureModel | None = None
    conductivity: float = 0.0
    rotor: Rotor | None = None
    planned: bool = False

    @cached_property
    def tones(self) -> tuple[tuple[float, int | None], ...]:
        """Distinct (frequency in Hz, slot) pairs in the order of the coils."""
        return tuple(
            dict.fromkeys((c.frequency_hz or self.frequency_hz, c.slot) for c in self.coils)
        )

    @cached_property
    def tone_frequencies_hz(self) -> Array:
        """Frequency of each tone (Hz), shape (tones,)."""
        return np.array([frequency for frequency, _ in self.tones])

    @cached_property
    def excitation(self) -> ComplexArray:
        """Complex drive of each coil in each tone, shape (coils, tones)."""
        drive = np.zeros((len(self.coils), len(self.tones)), dtype=np.complex128)
        for j, coil in enumerate(self.coils):
            k = self.tones.index((coil.frequency_hz or self.frequency_hz, coil.slot))
            drive[j, k] = np.exp(1j * coil.phase)
        return drive

    @cached_property
    def tone_moments(self) -> Array:
        """Magnitude of the complex moment of each tone (A m^2), shape (tones,)."""
        return np.asarray(np.linalg.norm(self.moments_beacon.T @ self.excitation, axis=0))

    @cached_property
    def moments_beacon(self) -> Array:
        """Peak moments (A m^2), shape (coils, 3)."""
        return np.array([c.moment_beacon for c in self.coils])

    @cached_property
    def centres_beacon(self) -> Array:
        """Magnetic centres of the coils (m), shape (coils, 3)."""
        return np.array([c.centre_beacon for c in self.coils])

    @cached_property
    def concentric(self) -> bool:
        """Whether all coils are at one place."""
        return bool(np.all(self.centres_beacon == self.centres_beacon[0]))


@dataclass(frozen=True)
class ClockModel:
    """Clock of an unsynchronised beacon, and stability of all drives.

    Parameters
    ----------
    drift_sigma, drift_largest : float
        Prior sigma of a clock's relative error, as of an ordinary crystal; and the largest error
        that is searched.
    phase_walk, drift_walk, log_moment_walk : float
        Standard deviation that drive phase (rad), relative error of the clock, and logarithm of a
        moment gain in an hour, by temperature and ageing.
    """

    drift_sigma: float = 2e-5
    drift_largest: float = 1e-4
    phase_walk: float = 0.02
    drift_walk: float = 1e-8
    log_moment_walk: float = 1e-3


@dataclass(frozen=True)
class EarthModel:
    """Change of the declared Earth field by a building's iron, outside of steel halls.

    Parameters
    ----------
    declination_sigma : float
        Of its azimuth (rad).
    strength_sigma : float
        Of its horizontal and of its vertical part, relative to its size.
    declination_walk, strength_walk : float
        Standard deviation that azimuth (rad) and parts (T) gain in an hour: the field changes as
        the platform moves.
    """

    declination_sigma: float = float(np.deg2rad(3.0))
    strength_sigma: float = 0.02
    declination_walk: float = 0.05
    strength_walk: float = 1e-6


@dataclass(frozen=True)
class Platform:
    """Moving platform: an IMU and one or several magnetometers, rigidly mounted together.

    Parameters
    ----------
    magnetometer : Magnetometer
        The single or first one.
    further : tuple of Magnetometer
        The other magnetometers.
    left_out : tuple of (int, Magnetometer)
        Magnetometers excluded for a log, each with its index at that time.
    imu_intrinsics : ImuIntrinsics, optional
        Scale factors, axes and g-sensitivity of the IMU; None if it is ideal.
    motion_prior : MotionPrior, optional
        Assumed motion if a log has no inertial samples.
    replaced : Replaced, optional
        Parts that the prior replaces (`magfusion.model.without_imu`); None if the IMU
        measures.
    """

    __repr__ = short_repr

    imu: ImuModel
    magnetometer: Magnetometer
    motion: MotionModel = A_HAND
    motion_prior: MotionPrior | None = None
    replaced: Replaced | None = None
    further: tuple[Magnetometer, ...] = ()
    left_out: tuple[tuple[int, Magnetometer], ...] = ()
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
        rate = self.magnetometer.clock_rate
        return time if rate == 0.0 else time * (1.0 + rate)

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
    model_error_length : float
        Correlation length of that error (m): it is caused by iron, is constant in place, and does
        not average over epochs that are closer.
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
