"""What a site's file may hold: the keys, their types, ranges and defaults."""

import datetime
import math
import sys
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    PlainValidator,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError, PydanticKnownError

from magfusion.files.yaml_files import StrictModel
from magfusion.model.site import Beacon, ClockModel, EarthModel, MotionModel, Site
from magfusion.units import DEGREE, Array

# What no installation reaches and any value written in nT by mistake exceeds.
LARGEST_EARTH_FIELD = 1e-3  # T
LARGEST_OFFSET = 1e-2  # T
LARGEST_NOISE_DENSITY = 1e-4  # T/sqrt(Hz)

LARGEST_CONDITION = 1e6  # of a magnetometer matrix that can be undone to any use


def _refusal(remedy: str) -> PydanticCustomError:
    return PydanticCustomError("site", "{remedy}", {"remedy": remedy})


def _refusal_at(key: tuple[str | int, ...], found: object, remedy: str) -> ValidationError:
    detail = InitErrorDetails(type=_refusal(remedy), loc=key, input=found)
    return ValidationError.from_exception_data("site", [detail])


def _fits(value: object, shape: tuple[int, ...]) -> bool:
    if isinstance(value, list):
        same_length = bool(shape) and len(value) == shape[0]
        return same_length and all(_fits(v, shape[1:]) for v in value)
    if shape or isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= sys.float_info.max


_LISTS = {(3,): "a list of 3 numbers", (3, 3): "3 lists of 3 numbers"}


def _array(*shape: int) -> PlainValidator:
    def read(value: object) -> Array:
        if not _fits(value, shape):
            raise _refusal(f"give {_LISTS[shape]}, all finite")
        return np.array(value, dtype=float)

    return PlainValidator(read)


def _sigma(*shape: int) -> PlainValidator:
    def read(value: object) -> Array:
        return np.broadcast_to(_spread(value, shape, _LISTS[shape]), shape).copy()

    return PlainValidator(read)


def _coil_sigma(value: object) -> Array:
    coils = len(value) if isinstance(value, list) else 1
    return _spread(value, (coils,), "a list of one per coil")


def _spread(value: object, shape: tuple[int, ...], lists: str) -> Array:
    if _fits(value, ()) or _fits(value, shape):
        array = np.array(value, dtype=float)
        if np.all(array >= 0.0):
            return array
    raise _refusal(f"give one number or {lists}, finite and not negative")


def _not_zero(value: Array) -> Array:
    if not value.any():
        raise _refusal("give the peak moment in A m^2, not zero; remove a coil that is not driven")
    return value


def _not_singular(value: Array) -> Array:
    if not np.linalg.cond(value) <= LARGEST_CONDITION:
        raise _refusal("give a matrix that can be inverted")
    return value


def _tesla(largest: float, unit: str = "T") -> AfterValidator:
    def check(value: Any) -> Any:
        if math.hypot(*np.ravel(value)) > largest:
            raise _refusal(f"give it in {unit}, not n{unit} (at most {largest:g} {unit})")
        return value

    return AfterValidator(check)


def _some(what: str) -> AfterValidator:
    def check(value: list[Any]) -> list[Any]:
        if not value:
            raise _refusal(f"describe at least one {what}")
        return value

    return AfterValidator(check)


def _first_version(value: int) -> int:
    if value != 1:
        raise _refusal("write 1, the version of the format that this magfusion reads")
    return value


def _iso_date(value: object) -> str:
    try:
        return datetime.date.fromisoformat(str(value)).isoformat()
    except ValueError:
        raise _refusal("give a date as YYYY-MM-DD") from None


def _zeros() -> Array:
    return np.zeros(3)


_Positive = Annotated[float, Field(gt=0.0)]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]
_NotNegative = Annotated[float, Field(ge=0.0)]
_Vector = Annotated[Array, _array(3)]
_VectorSigma = Annotated[Array, _sigma(3)]


_CLOCK, _EARTH, _MOTION = ClockModel(), EarthModel(), MotionModel()


class LocationEntry(StrictModel):
    """Where and when, for the IGRF."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    date: Annotated[str, PlainValidator(_iso_date)]


class ClockEntry(StrictModel):
    """`magfusion.model.site.ClockModel`, field by field in its order."""

    drift_sigma: _Positive = _CLOCK.drift_sigma
    drift_largest: _Positive = _CLOCK.drift_largest
    phase_walk_deg: _NotNegative = _CLOCK.phase_walk / DEGREE
    drift_walk: _NotNegative = _CLOCK.drift_walk
    log_moment_walk: _NotNegative = _CLOCK.log_moment_walk


class EarthEntry(StrictModel):
    """`magfusion.model.site.EarthModel`, field by field in its order."""

    declination_sigma_deg: _Positive = _EARTH.declination_sigma / DEGREE
    strength_sigma: _Positive = _EARTH.strength_sigma
    declination_walk_deg: _NotNegative = _EARTH.declination_walk / DEGREE
    strength_walk_t: Annotated[_NotNegative, _tesla(LARGEST_EARTH_FIELD)] = _EARTH.strength_walk


class MotionEntry(StrictModel):
    """`magfusion.model.site.MotionModel`, field by field in its order."""

    rest_gyro_rad_s: _Positive = _MOTION.rest_gyro
    rest_accel_m_s2: _Positive = _MOTION.rest_accel
    rest_span_s: Annotated[float, Field(ge=0.2, le=60.0)] = _MOTION.rest_span
    rest_speed_sigma_m_s: _Positive = _MOTION.rest_speed_sigma
    rest_known_speed_m_s: _Positive = _MOTION.rest_known_speed
    speed_sigma_m_s: _Positive = _MOTION.speed_sigma
    accel_sigma_m_s2: _Positive = _MOTION.accel_sigma
    accel_span_s: _Positive = _MOTION.accel_span
    start_speed_sigma_m_s: _Positive = _MOTION.start_speed_sigma


class WorldEntry(StrictModel):
    """Gravity, the Earth's field and the trust in the field model."""

    gravity_m_s2: _Positive = 9.80665
    model_error: _Share = 0.005
    model_error_correlation_m: _NotNegative = Site.model_error_length
    field_map: Annotated[str, Field(min_length=1)] | None = None
    earth_field_t: Annotated[Array, _array(3), _tesla(LARGEST_EARTH_FIELD)] | None = None
    location: LocationEntry | None = None
    earth: EarthEntry = EarthEntry()

    @model_validator(mode="after")
    def _one_earth(self) -> Self:
        if self.earth_field_t is not None and self.location is not None:
            remedy = "give either it or location, not both"
            raise _refusal_at(("earth_field_t",), self.earth_field_t.tolist(), remedy)
        return self


class CoilEntry(StrictModel):
    """One coil in beacon axes; its size, offset, own frequency and slot are optional."""

    moment_a_m2: Annotated[Array, _array(3), AfterValidator(_not_zero)]
    phase_deg: float = 0.0
    centre_m: _Vector = Field(default_factory=_zeros)
    radius_m: _Positive | None = None
    length_m: _Positive | None = None
    frequency_hz: _Positive | None = None
    slot: Annotated[int, Field(ge=0)] | None = None


class SlotsEntry(StrictModel):
    """When the coils of a beacon are driven, one after the other."""

    duration_s: _Positive
    count: Annotated[int, Field(ge=1, le=1000)]
    start_s: float = 0.0


class BeaconSigmaEntry(StrictModel):
    """Priors of a beacon's calibration; an absent one is zero, which means known."""

    position_m: _VectorSigma = Field(default_factory=_zeros)
    rotation_deg: _VectorSigma = Field(default_factory=_zeros)
    log_moment: Annotated[Array, PlainValidator(_coil_sigma)] = Field(
        default_factory=lambda: np.zeros(())
    )


def _direct_current_only_in_slots(value: float, info: ValidationInfo) -> float:
    if value < 0.0 or (value == 0.0 and info.data.get("slots") is None):
        raise PydanticKnownError("greater_than", {"gt": 0})
    return value


class BeaconEntry(StrictModel):
    """One beacon with its coils."""

    name: Annotated[str, Field(min_length=1)]
    position_m: Annotated[Array | None, _array(3)] = None
    rpy_deg: Annotated[Array | None, _array(3)] = None
    unknown: Literal["pose", "position", "attitude"] | None = None
    slots: SlotsEntry | None = None
    frequency_hz: Annotated[float, AfterValidator(_direct_current_only_in_slots)]
    coils: Annotated[list[CoilEntry], _some("coil")]
    synchronised: bool = True
    model_error: _Share | None = None
    noise_factor: _Positive = Beacon.noise_factor
    sigma: BeaconSigmaEntry = Field(default_factory=BeaconSigmaEntry)

    @model_validator(mode="after")
    def _surveyed_or_unknown(self) -> Self:
        for key, part in (("position_m", "position"), ("rpy_deg", "attitude")):
            value, unknown = getattr(self, key), self.unknown in ("pose", part)
            if value is None and not unknown:
                detail = InitErrorDetails(type="missing", loc=(key,), input=None)
                raise ValidationError.from_exception_data("site", [detail])
            if value is not None and unknown:
                remedy = f"remove it or unknown: {self.unknown}, which says that it is not known"
                raise _refusal_at((key,), value.tolist(), remedy)
        return self

    @model_validator(mode="after")
    def _coils_fit_the_slots(self) -> Self:
        if self.slots is None:
            return self
        for i, coil in enumerate(self.coils):
            if coil.slot is None or coil.slot >= self.slots.count:
                remedy = f"give one of the beacon's {self.slots.count} slots, counted from 0"
                raise _refusal_at(("coils", i, "slot"), coil.slot, remedy)
        if not self.synchronised:
            remedy = "write true: slots are counted on the log's clock, which the drive must keep"
            raise _refusal_at(("synchronised",), False, remedy)
        return self

    @model_validator(mode="after")
    def _one_sigma_per_coil(self) -> Self:
        found, coils = self.sigma.log_moment, len(self.coils)
        if found.ndim and len(found) != coils:
            remedy = f"give one number or a list of {coils}, one per coil"
            raise _refusal_at(("sigma", "log_moment"), found.tolist(), remedy)
        return self


class ImuEntry(StrictModel):
    """Inertial noise and the IMU's clock."""

    gyro_noise: _Positive
    accel_noise: _Positive
    gyro_bias_walk: _NotNegative
    accel_bias_walk: _NotNegative
    gyro_bias_sigma: _NotNegative
    accel_bias_sigma: _NotNegative
    time_offset_s: float = 0.0
    time_offset_sigma_s: _NotNegative = 0.01  # undeclared: unknown to some milliseconds


class MagnetometerSigmaEntry(StrictModel):
    """Priors of the magnetometer's calibration; an absent one is zero."""

    matrix: Annotated[Array, _sigma(3, 3)] = Field(default_factory=lambda: np.zeros((3, 3)))
    offset_t: Annotated[Array, _sigma(3), _tesla(LARGEST_OFFSET)] = Field(default_factory=_zeros)
    rotation_deg: _VectorSigma = Field(default_factory=_zeros)
    position_m: _VectorSigma = Field(default_factory=_zeros)


class MountingEntry(StrictModel):
    """Lever arm and attitude of the sensor on the body; absent ones are zero."""

    position_m: _Vector = Field(default_factory=_zeros)
    rpy_deg: _Vector = Field(default_factory=_zeros)


class MagnetometerEntry(StrictModel):
    """``measured = matrix @ field_sensor + offset_t``, and its noise."""

    body_from_sensor: MountingEntry = Field(default_factory=MountingEntry)
    noise_density_t_rthz: Annotated[_Positive, _tesla(LARGEST_NOISE_DENSITY, "T/sqrt(Hz)")]
    matrix: Annotated[Array, _array(3, 3), AfterValidator(_not_singular)] = Field(
        default_factory=lambda: np.eye(3)
    )
    offset_t: Annotated[Array, _array(3), _tesla(LARGEST_OFFSET)] = Field(default_factory=_zeros)
    coil_centres_m: Annotated[Array, _array(3, 3)] | None = None
    offset_walk_t: Annotated[_NotNegative, _tesla(LARGEST_OFFSET)] = 2e-8  # gained in an hour
    sigma: MagnetometerSigmaEntry = Field(default_factory=MagnetometerSigmaEntry)


class PlatformEntry(StrictModel):
    """What moves."""

    imu: ImuEntry
    magnetometer: MagnetometerEntry
    motion: MotionEntry = MotionEntry()


class SiteEntry(StrictModel):
    """The whole file."""

    magfusion_site: Annotated[int, AfterValidator(_first_version)]
    world: WorldEntry = Field(default_factory=WorldEntry)
    beacons: list[BeaconEntry]
    platform: PlatformEntry
    clock: ClockEntry = ClockEntry()
    calibration: dict[str, Any] | None = None
    correlation: Annotated[str, Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _distinct_names(self) -> Self:
        names = [b.name for b in self.beacons]
        for i, name in enumerate(names):
            if name in names[:i]:
                first = names.index(name)
                remedy = f"give it another name than beacons[{first}]"
                raise _refusal_at(("beacons", i, "name"), name, remedy)
        return self
