"""Definition of a calibration parameter: all properties of one kind, in one object."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.channel_effects import driven, of_all_sensors, responded, warmed
from magfusion.model.field import EarthObservation
from magfusion.model.receive_coils import Observation
from magfusion.model.samples import ImuSamples
from magfusion.model.short_repr import short_repr
from magfusion.model.site import Beacon, Site
from magfusion.units import DEGREE, Array, ComplexArray

AXES = ("x", "y", "z")
CLOCK = "clock_offset"  # kind of the parameter of a magnetometer's clock


@dataclass(frozen=True, eq=False)
class Calibration:
    """Current values of everything that can be estimated besides the trajectory.

    Parameters
    ----------
    phase : ndarray, shape (channels,) or (poses, channels)
        Drive phase of each channel at ``reference_time`` beyond the coils' own (rad), the same of
        every magnetometer.
    drift : ndarray, shape (beacons,)
        Relative error of each beacon's clock.
    time_offset : float
        An IMU sample stamped t was taken at t + time_offset (s), at ``imu_begin``.
    reference_time : float
        Reference of ``phase`` (s).
    log_gain : ndarray, shape (channels,) or (poses, channels)
        Logarithm of the ratio of each channel's phasor to that of the site.
    others : mapping
        Values of parameters without a field here, by ``owner.kind``; absent means zero.

    clock_rate : float
        Seconds of the log's clock per second of the IMU's, less one.
    imu_begin : float
        IMU stamp at which its time offset is defined (s): the first.
    """

    __repr__ = short_repr

    site: Site
    phase: Array
    drift: Array
    time_offset: float
    reference_time: float
    log_gain: Array
    others: Mapping[str, Array] = field(default_factory=dict)
    clock_rate: float = 0.0
    imu_begin: float = 0.0

    @property
    def clock_offsets(self) -> Array:
        """Offset of each magnetometer's stamps in addition to the declared one (s)."""
        if not self.others:
            return np.zeros(len(self.site.platform.magnetometers))
        platform = self.site.platform
        names = [m.name for m in platform.magnetometers] if platform.further else ["magnetometer"]
        return np.array([np.sum(self.others.get(f"{name}.{CLOCK}", 0.0)) for name in names])

    def imu_offset(self, time: Array) -> Array:
        """Return the offset of the IMU's stamps at some times, same shape (s)."""
        return self.time_offset + self.clock_rate * (np.asarray(time) - self.imu_begin)

    def on_log_rate(self, imu: ImuSamples) -> ImuSamples:
        """Return the IMU samples with stamps corrected for all but the constant time offset."""
        if not self.clock_rate:
            return imu
        return replace(imu, time=imu.time + self.clock_rate * (imu.time - self.imu_begin))

    def gain_at(self, time: Array) -> Array:
        """Return the gain of phasors relative to those of the site, shape (..., channels).

        Includes temperature effects on the moments, recorded currents and the magnetometer's
        response.
        """
        warmth, current = warmed(self.site, time), driven(self.site, time)
        response = responded(self.site)
        log_gain = self.log_gain if warmth is None else self.log_gain + warmth
        log_gain = log_gain if response is None else log_gain + response[0]
        return np.asarray(np.exp(log_gain if current is None else log_gain + current[0]))

    def drive_phase(self, time: Array) -> Array:
        """Return the phase of every channel at the given times, shape (..., channels) (rad).

        As measured: with recorded currents and the magnetometer's response.
        """
        frequencies = of_all_sensors(self.site, self.site.tone_frequencies_hz)
        rate = 2.0 * np.pi * frequencies * self.drift[self.site.owner]
        phase = self.phase + (time[..., None] - self.reference_time) * rate
        current, response = driven(self.site, time), responded(self.site)
        phase = phase if response is None else phase + response[1]
        late = self.clock_offsets if self.others else None
        if late is not None and late.any():
            phase = phase + 2.0 * np.pi * frequencies * late[self.site.sensor]
        return phase if current is None else phase + current[1]


class ParameterUnit(NamedTuple):
    """Name of a unit, and its size in the unit of the tangent vector."""

    text: str
    size: float


NO_UNIT, METRE, SECOND = ParameterUnit("", 1.0), ParameterUnit("m", 1.0), ParameterUnit("s", 1.0)
DEGREES, PPM, PERCENT = (
    ParameterUnit("deg", DEGREE),
    ParameterUnit("ppm", 1e-6),
    ParameterUnit("%", 1e-2),
)
CENTIMETRE, MILLISECOND = ParameterUnit("cm", 1e-2), ParameterUnit("ms", 1e-3)


class PhasorView(NamedTuple):
    """Inputs of the Jacobian of one beacon's phasors."""

    calibration: Calibration
    beacon: Beacon
    elapsed: Array  # (n,) since the reference time (s)
    phasor: ComplexArray  # (n, tones, 3)
    observation: Observation | None  # None if only factors of the phasor are needed
    sensor: int = 0  # index of the magnetometer that measures them

    @property
    def whole(self) -> Observation:
        """Observation, for a parameter that is no factor of the phasor."""
        assert self.observation is not None
        return self.observation


class StaticView(NamedTuple):
    """Inputs of the Jacobian of the static field."""

    calibration: Calibration
    observation: EarthObservation
    rate_body: Array  # (n, 3) (rad/s)
    time: Array  # (n,) (s)


class Parameter:
    """One kind of calibration parameter.

    Add a new one as a subclass in the list of kinds: estimators, reports and files use only what
    it defines here.  By default it is a value in `Calibration.others` that starts at zero, is
    additive, and affects no measurement.  The tangent vector's unit is ``si``.
    """

    group: ClassVar[str]  # under which it is selected, with others
    owner: ClassVar[str]  # the object it belongs to; ``kind`` is its name there
    kind: ClassVar[str]
    components: ClassVar[Sequence[str]] = ()  # names of its numbers; otherwise their indices
    unit: ClassVar[ParameterUnit] = NO_UNIT  # in figures
    display_unit: ClassVar[ParameterUnit] = NO_UNIT  # in messages
    words: ClassVar[str | Sequence[str]] = "{owner}.{kind} {i}"  # in messages: for all or for each
    si: ClassVar[float] = 1.0  # scale, as numbers of all sizes in one covariance lose digits
    # A parameter surveyed this well is fixed at its declared value; its remaining error is
    # considered in the covariance of the result.
    negligible: ClassVar[float] = 0.0
    declared: ClassVar[bool] = False  # whether the site's file has its value and its sigma
    of_log: ClassVar[bool] = False  # whether it belongs to the log and is only recorded in the site
    each_log: ClassVar[bool] = False  # whether every log has its own value, declared or not
    static_only: ClassVar[bool] = False  # whether only the static field determines it
    factor_of_phasor: ClassVar[bool] = False  # whether its Jacobian is proportional to the phasor
    inertial: ClassVar[bool] = False  # whether it corrects the inertial stream
    # Its mean variance, times this and this power of the inverse distance, is the relative
    # variance of a beacon's field.
    field_error: ClassVar[float] = 0.0
    falls: ClassVar[int] = 0
    is_rotation: ClassVar[bool] = False  # perturbed on its right
    by_turning: ClassVar[str] = ""  # its name in advice to determine it by rotation
    walk: ClassVar[str] = ""  # site attribute of its standard deviation gained in an hour (SI)

    def kept_to(self, site: Site) -> float:
        """Return the largest sigma with which it is fixed at its declared value."""
        return self.negligible

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other)

    def __hash__(self) -> int:
        return hash(type(self))

    def __repr__(self) -> str:
        # Equal in every process for equal settings: checkpoints are identified by it.
        return f"{type(self).__qualname__}()"

    def owners(self, site: Site) -> tuple[str, ...]:
        """Return its owners in a site: one, except for beacons and magnetometers."""
        return (self.owner,)

    def sigma(self, site: Site, owner: str) -> Array:
        """Return the prior standard deviations, flat; all zero where it is known."""
        raise NotImplementedError

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        """Return the calibration moved by a step."""
        name = f"{owner}.{self.kind}"
        value = calibration.others.get(name, 0.0) + step
        return replace(calibration, others={**calibration.others, name: value})

    def all_moved(self, calibration: Calibration, steps: Mapping[str, Array]) -> Calibration:
        """Return the calibration moved by the steps of several owners."""
        for owner, step in steps.items():
            calibration = self.moved(calibration, owner, step)
        return calibration

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        """Return the step from one calibration to another: the inverse of `moved`."""
        name, zero = f"{owner}.{self.kind}", np.zeros(1)
        return new.others.get(name, zero) - old.others.get(name, zero)

    def all_differences(
        self, old: Calibration, new: Calibration, owners: Sequence[str]
    ) -> list[Array]:
        """Return the steps of several owners from one calibration to another."""
        return [self.difference(old, new, owner) for owner in owners]

    def value(self, calibration: Calibration, owner: str) -> Array | None:
        """Return its value, flat, in the unit of a step; None if only changes are numbers."""
        return None

    def refined(self, site: Site, calibration: Calibration, owner: str, sigma: Array) -> Site:
        """Return the site with the value and posterior sigma of a fitted calibration."""
        return site

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        """Return its columns, shape (n, tones, 3, columns); None without an effect."""
        return None

    def static_jacobian(self, view: StaticView) -> Array | None:
        """Return its columns, shape (n, 3, columns); None without an effect."""
        return None

    def corrected_imu(self, calibration: Calibration, owner: str, imu: ImuSamples) -> ImuSamples:
        """Return the inertial samples corrected for this parameter."""
        return imu

    def walk_per_sqrt_hour(self, site: Site, owner: str) -> float:
        """Return the standard deviation that it gains in an hour."""
        return attrgetter(self.walk)(site) / self.si if self.walk else 0.0

    def drags(
        self, calibration: Calibration, owner: str, time: float
    ) -> "tuple[Parameter, Array] | None":
        """Return the effect of a step at a time on another parameter, shape (columns, own)."""
        return None

    def called(self, site: Site, owner: str, i: int) -> str:
        """Return the name of one of its numbers in messages."""
        words = self.words if isinstance(self.words, str) else self.words[i]
        return words.format(owner=owner, kind=self.kind, i=i, axis=AXES[i % 3])


class SiteParameter(Parameter):
    """A parameter that is an attribute of some part of the site, with a sigma there."""

    declared = True
    attribute: ClassVar[str]
    sigma_attribute: ClassVar[str]

    def part(self, site: Site, owner: str) -> Any:
        """Return the part of the site."""
        raise NotImplementedError

    def with_part(self, site: Site, part: Any) -> Site:
        """Return the site with that part replaced."""
        raise NotImplementedError

    def sigma(self, site: Site, owner: str) -> Array:
        """Return the declared standard deviations."""
        return getattr(self.part(site, owner).sigma, self.sigma_attribute).ravel() / self.si

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        """Return the calibration with the part moved."""
        part = self.part(calibration.site, owner)
        value = getattr(part, self.attribute)
        if self.is_rotation:
            value = value @ Rotation.from_rotvec(step).as_matrix()
        else:
            value = np.asarray(value + self.si * step.reshape(value.shape))
        part = replace(part, **{self.attribute: value})
        return replace(calibration, site=self.with_part(calibration.site, part))

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        """Return the step between two states of the part."""
        a, b = (getattr(self.part(c.site, owner), self.attribute) for c in (old, new))
        if a is b:
            return np.zeros(1 if np.ndim(a) == 0 else 3 if self.is_rotation else np.size(a))
        if self.is_rotation:
            return Rotation.from_matrix(a.T @ b).as_rotvec()
        return ((b - a) / self.si).ravel()

    def value(self, calibration: Calibration, owner: str) -> Array | None:
        """Return the attribute; None for a rotation."""
        if self.is_rotation or not hasattr(self, "attribute"):
            return None
        result = getattr(self.part(calibration.site, owner), self.attribute)
        return np.asarray(result / self.si).ravel()

    def refined(self, site: Site, calibration: Calibration, owner: str, sigma: Array) -> Site:
        """Return the site with the posterior sigma; it already has the value."""
        part = self.part(site, owner)
        shape = getattr(part.sigma, self.sigma_attribute).shape
        changed = {self.sigma_attribute: self.si * sigma.reshape(shape)}
        return self.with_part(site, replace(part, sigma=replace(part.sigma, **changed)))


class Block(NamedTuple):
    """One named part of the tangent vector, e.g. the position of beacon A."""

    parameter: Parameter
    owner: str
    columns: slice
    sigma: Array

    @property
    def group(self) -> str:
        """Name under which it is selected."""
        return self.parameter.group

    @property
    def kind(self) -> str:
        """Name of the parameter within its owner."""
        return self.parameter.kind

    @property
    def name(self) -> str:
        """E.g. ``A.position`` or ``magnetometer.matrix``."""
        return f"{self.owner}.{self.kind}"

    @property
    def key(self) -> tuple[Parameter, str]:
        """Unique key; the name is ambiguous, as a beacon may be called sensor."""
        return self.parameter, self.owner


def dimension(blocks: tuple[Block, ...]) -> int:
    """Return the length of the tangent vector."""
    return blocks[-1].columns.stop if blocks else 0
