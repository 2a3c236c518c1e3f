"""Keys of aiding sensors in a site's file."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from magfusion.files.site_magnetometer import MountingEntry
from magfusion.files.site_plain import degree_sigma_entry, plain, rotation_of, rpy_deg, sigma_entry
from magfusion.files.site_values import (
    MAX_ANGLE,
    MAX_DISTANCE,
    AboveZero,
    Angles,
    FromZero,
    NotNegative,
    Position,
    PositionSigma,
    RotationSigma,
    between,
    plain_name,
    zeros,
)
from magfusion.files.yaml_files import StrictModel
from magfusion.model.aiding import AIDING_RATE, AidingSensor, AidingSigma, Quantity
from magfusion.units import DEGREE, STANDARD_GRAVITY, Array

UNITS: dict[Quantity, str] = {
    "velocity": "m_s",
    "range": "m",
    "position": "m",
    "mark": "m",
    "height": "m",
    "pressure": "pa",
    "heading": "deg",
    "relative_pose": "m",
}
_MOVING: tuple[Quantity, ...] = ("velocity", "relative_pose")  # with scale and mounting
DENSEST = 2e4  # kg/m^3; mercury has 13,600
MAX_HEIGHT = 1e5  # m; the space begins there
HIGHEST_PRESSURE = 1e9  # Pa; ten times that of the deepest sea
_Distance = Annotated[float, between(-MAX_DISTANCE, MAX_DISTANCE)]
_Share = Annotated[FromZero, between(0.0, 1.0)]


def _not_zero(value: float) -> float:
    if value == 0.0:
        raise ValueError("is zero; give the SI value of one recorded unit")
    return value


class _Sigma(StrictModel):
    time_offset_s: Annotated[FromZero, between(0.0, 10.0)] = 0.0


class _PositionSigma(_Sigma):
    position_m: PositionSigma = Field(default_factory=zeros)


class _MovingSigma(_PositionSigma):
    rotation_deg: RotationSigma = Field(default_factory=zeros)
    scale: _Share = 0.0


class _OffsetSigma(_PositionSigma):
    offset_m: NotNegative = 0.0


class _PressureSigma(_PositionSigma):
    offset_pa: NotNegative = 0.0


class _HeadingSigma(_Sigma):
    offset_deg: Annotated[FromZero, between(0.0, 360.0)] = 0.0


class _Sensor(StrictModel):
    """What every aiding sensor has; without a name that of its quantity."""

    name: Annotated[str, Field(min_length=1), AfterValidator(plain_name)] | None = None
    time_offset_s: Annotated[float, between(-1e3, 1e3)] = 0.0
    rate_hz: Annotated[AboveZero, between(1e-3, 1e3)] = AIDING_RATE
    unit: Annotated[float, between(-1e6, 1e6), AfterValidator(_not_zero)] = 1.0


class _Mounted(_Sensor):
    body_from_sensor: MountingEntry = Field(default_factory=MountingEntry)


class VelocityEntry(_Mounted):
    """Velocity in axes of the sensor."""

    quantity: Literal["velocity"]
    noise_m_s: AboveZero
    relative_noise: _Share = 0.0
    constraint_noise_m_s: AboveZero | None = None
    scale: Annotated[float, between(0.1, 10.0)] = 1.0
    sigma: _MovingSigma = Field(default_factory=_MovingSigma)


class RelativePoseEntry(_Mounted):
    """Translation and rotation of the sensor since an earlier time."""

    quantity: Literal["relative_pose"]
    noise_m: AboveZero
    noise_deg: Annotated[AboveZero, between(0.0, 180.0)]
    relative_noise: _Share = 0.0
    scale: Annotated[float, between(0.1, 10.0)] = 1.0
    sigma: _MovingSigma = Field(default_factory=_MovingSigma)


class _WithOffset(_Mounted):
    noise_m: AboveZero
    offset_m: _Distance = 0.0
    offset_walk_m: NotNegative = 0.0  # gained in an hour
    sigma: _OffsetSigma = Field(default_factory=_OffsetSigma)


class _RangeSigma(_OffsetSigma):
    point_m: PositionSigma = Field(default_factory=zeros)


class RangeEntry(_WithOffset):
    """Distance from a known point."""

    quantity: Literal["range"]
    point_m: Position
    sigma: _RangeSigma = Field(default_factory=_RangeSigma)


class OriginEntry(StrictModel):
    """Place of the world's origin on the ellipsoid WGS84."""

    latitude_deg: Annotated[float, between(-90.0, 90.0)]
    longitude_deg: Annotated[float, between(-180.0, 360.0)]
    height_m: Annotated[float, between(-MAX_HEIGHT, MAX_HEIGHT)]


class FrameEntry(StrictModel):
    """Axes in which positions are given."""

    rpy_deg: Angles = Field(default_factory=zeros)


class PositionEntry(_Mounted):
    """Position of the sensor."""

    quantity: Literal["position"]
    noise_m: AboveZero
    origin: OriginEntry | None = None
    world_from_sensor: FrameEntry = Field(default_factory=lambda: FrameEntry())
    sigma: _PositionSigma = Field(default_factory=_PositionSigma)


def _named_by_text(marks: Any) -> Any:
    """Return marks whose names are texts: YAML reads 7 as a number, a table as a text."""
    return {str(k): v for k, v in marks.items()} if isinstance(marks, dict) else marks


class MarkEntry(_Mounted):
    """The sensor is on a mark."""

    quantity: Literal["mark"]
    noise_m: AboveZero
    marks_m: Annotated[dict[str, Position], Field(min_length=1), BeforeValidator(_named_by_text)]
    sigma: _PositionSigma = Field(default_factory=_PositionSigma)


class HeightEntry(_WithOffset):
    """Height of the sensor."""

    quantity: Literal["height"]


class PressureEntry(_Mounted):
    """Pressure of air or water at the sensor; the offset is that at the world's zero."""

    quantity: Literal["pressure"]
    noise_pa: AboveZero
    density_kg_m3: Annotated[AboveZero, between(1e-3, DENSEST)]
    offset_pa: Annotated[float, between(-HIGHEST_PRESSURE, HIGHEST_PRESSURE)] = 0.0
    offset_walk_pa: NotNegative = 0.0  # gained in an hour
    sigma: _PressureSigma = Field(default_factory=_PressureSigma)


class HeadingEntry(_Sensor):
    """Heading of the body."""

    quantity: Literal["heading"]
    noise_deg: AboveZero
    offset_deg: Annotated[float, between(-MAX_ANGLE, MAX_ANGLE)] = 0.0
    offset_walk_deg: NotNegative = 0.0  # gained in an hour
    sigma: _HeadingSigma = Field(default_factory=_HeadingSigma)


AidingEntry = Annotated[
    VelocityEntry
    | RangeEntry
    | PositionEntry
    | MarkEntry
    | HeightEntry
    | PressureEntry
    | HeadingEntry
    | RelativePoseEntry,
    Field(discriminator="quantity"),
]


def aiding_sensor(entry: AidingEntry) -> AidingSensor:
    """Return the sensor that an entry describes."""
    unit, size = UNITS[entry.quantity], DEGREE if entry.quantity == "heading" else 1.0

    def number(part: StrictModel, key: str) -> float:
        return size * float(getattr(part, f"{key}_{unit}", 0.0))

    mounting = getattr(entry, "body_from_sensor", MountingEntry())
    constraint, density = (
        getattr(entry, key, None) for key in ("constraint_noise_m_s", "density_kg_m3")
    )
    origin = getattr(entry, "origin", None)
    scale = getattr(entry, "scale", 1.0) if density is None else -density * STANDARD_GRAVITY
    return AidingSensor(
        entry.name or entry.quantity,
        entry.quantity,
        number(entry, "noise"),
        getattr(entry, "relative_noise", 0.0),
        constraint,
        mounting.position_m,
        rotation_of(mounting.rpy_deg),
        getattr(entry, "point_m", None),
        getattr(entry, "marks_m", {}),
        np.array(scale),
        np.array(number(entry, "offset")),
        number(entry, "offset_walk"),
        np.array(entry.time_offset_s),
        entry.rate_hz,
        AidingSigma(
            getattr(entry.sigma, "position_m", zeros()),
            getattr(entry.sigma, "rotation_deg", zeros()) * DEGREE,
            np.array(getattr(entry.sigma, "scale", 0.0)),
            np.array(number(entry.sigma, "offset")),
            np.array(entry.sigma.time_offset_s),
            getattr(entry.sigma, "point_m", zeros()),
        ),
        None if origin is None else (origin.latitude_deg, origin.longitude_deg, origin.height_m),
        entry.noise_deg * DEGREE if isinstance(entry, RelativePoseEntry) else 0.0,
        entry.unit,
        rotation_of(getattr(entry, "world_from_sensor", FrameEntry()).rpy_deg),
    )


def aiding_entries(sensors: tuple[AidingSensor, ...]) -> dict[str, Any]:
    """Return the entries of all aiding sensors under their key; nothing where there are none."""
    return {"aiding": [_entry(sensor) for sensor in sensors]} if sensors else {}


def _entry(sensor: AidingSensor) -> dict[str, Any]:
    """Return what is not as usual."""
    unit, size = UNITS[sensor.quantity], DEGREE if sensor.quantity == "heading" else 1.0
    own: dict[str, Any] = {
        "name": sensor.name,
        "quantity": sensor.quantity,
        f"noise_{unit}": _number(sensor.sigma, size),
    }
    sigma = _sigma_entry(sensor, unit, size)
    optional: dict[str, tuple[Any, Any]] = {
        "relative_noise": (sensor.relative_sigma, 0.0),
        "constraint_noise_m_s": (sensor.constraint_sigma, None),
        f"offset_{unit}": (_number(sensor.offset, size), 0.0),
        f"offset_walk_{unit}": (_number(sensor.offset_walk, size), 0.0),
        "time_offset_s": (float(sensor.time_offset), 0.0),
        "rate_hz": (sensor.rate_hz, AIDING_RATE),
        "unit": (sensor.unit, 1.0),
        "marks_m": (plain(sensor.marks_world), {}),
        "sigma": (sigma, {}),
    }
    if sensor.point_world is not None:
        own["point_m"] = plain(sensor.point_world)
    if sensor.origin is not None:
        own["origin"] = dict(zip(OriginEntry.model_fields, sensor.origin, strict=True))
    if sensor.quantity == "pressure":
        own["density_kg_m3"] = float(-sensor.scale / STANDARD_GRAVITY)
    if sensor.quantity == "relative_pose":
        own["noise_deg"] = _number(sensor.rotation_sigma, DEGREE)
    if sensor.quantity in _MOVING and sensor.scale != 1.0:
        own["scale"] = float(sensor.scale)
    if any(axes := rpy_deg(sensor.world_from_sensor)):
        own["world_from_sensor"] = {"rpy_deg": axes}
    turn = rpy_deg(sensor.body_from_sensor)
    if sensor.position_body.any() or any(turn):
        position = plain(sensor.position_body)
        own["body_from_sensor"] = {"position_m": position, "rpy_deg": turn}
    return own | {key: value for key, (value, usual) in optional.items() if value != usual}


def _sigma_entry(sensor: AidingSensor, unit: str, size: float) -> dict[str, Any]:
    """Return the priors of the parameters that a sensor of its quantity has."""
    sigmas, entry = sensor.sigmas, dict[str, Any]()
    if sensor.quantity != "heading" and sigmas.position_body.any():
        entry["position_m"] = sigma_entry(sigmas.position_body)
    if sensor.quantity in _MOVING and sigmas.rotation_sensor.any():
        entry["rotation_deg"] = degree_sigma_entry(sigmas.rotation_sensor)
    if sensor.quantity in _MOVING and sigmas.scale:
        entry["scale"] = float(sigmas.scale)
    if sensor.quantity not in (*_MOVING, "position", "mark") and sigmas.offset:
        entry[f"offset_{unit}"] = _number(sigmas.offset, size)
    if sensor.quantity == "range" and sigmas.point_world.any():
        entry["point_m"] = sigma_entry(sigmas.point_world)
    if sigmas.time_offset:
        entry["time_offset_s"] = float(sigmas.time_offset)
    return entry


def _number(value: float | Array, size: float) -> float:
    return float(f"{float(value) / size:.15g}")
