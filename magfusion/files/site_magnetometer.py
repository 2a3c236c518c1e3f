"""Keys of magnetometers in a site's file."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, ValidationError
from pydantic_core import InitErrorDetails

from magfusion.files.site_casing import CasingEntry, casing_entry
from magfusion.files.site_motion import MILLION, ppm
from magfusion.files.site_plain import (
    degree_sigma_entry,
    model_of,
    plain,
    rotation_of,
    rpy_deg,
    sigma_entry,
)
from magfusion.files.site_response import (
    AxisCoilsEntry,
    AxisResponsesEntry,
    CoilEntry,
    Listed,
    ResponseSigmaEntry,
    check_response,
    check_response_sigma,
    response_entry,
    response_sigma,
    response_sigma_entry,
    responses_of,
)
from magfusion.files.site_temperature import SensorTemperatureEntry, temperature_entry
from magfusion.files.site_values import (
    MAX_NOISE_DENSITY,
    MAX_OFFSET,
    MAX_SCALE,
    AboveZero,
    Angles,
    FromZero,
    NotNegative,
    Position,
    PositionSigma,
    RotationSigma,
    array,
    at_least_one,
    between,
    not_singular,
    plain_name,
    refusal_at,
    sigma_array,
    tesla,
    zeros,
)
from magfusion.files.yaml_files import StrictModel
from magfusion.model.site import Magnetometer, MagnetometerSigma, Platform
from magfusion.units import Array

RESPONSE_KEYS = ("response", "axis_responses", "coil", "axis_coils")
MAX_PHASE = 0.2  # rad; of a tone by a clock's sigma: three of them are still nearly linear


class MagnetometerSigmaEntry(StrictModel):
    """Priors of the magnetometer's calibration; an absent one is zero."""

    matrix: Annotated[Array, sigma_array(3, 3, largest=10.0)] = Field(
        default_factory=lambda: np.zeros((3, 3))
    )
    offset_t: Annotated[Array, sigma_array(3, largest=1e9), tesla(MAX_OFFSET)] = Field(
        default_factory=zeros
    )
    rotation_deg: RotationSigma = Field(default_factory=zeros)
    position_m: PositionSigma = Field(default_factory=zeros)
    clock_offset_s: Annotated[FromZero, between(0.0, 1.0)] = 0.0


class MountingEntry(StrictModel):
    """Lever arm and attitude of the sensor on the body; absent ones are zero."""

    position_m: Position = Field(default_factory=zeros)
    rpy_deg: Angles = Field(default_factory=zeros)


class MagnetometerEntry(StrictModel):
    """``measured = matrix @ field_sensor + offset_t``, and its noise."""

    body_from_sensor: MountingEntry = Field(default_factory=MountingEntry)
    noise_density_t_rthz: Annotated[
        AboveZero, tesla(MAX_NOISE_DENSITY, "T/sqrt(Hz)"), between(1e-18, MAX_NOISE_DENSITY)
    ]
    matrix: Annotated[Array, array(3, 3, largest=MAX_SCALE), AfterValidator(not_singular)] = Field(
        default_factory=lambda: np.eye(3)
    )
    offset_t: Annotated[Array, array(3), tesla(MAX_OFFSET)] = Field(default_factory=zeros)
    coil_centres_m: Annotated[Array, array(3, 3, largest=10.0, unit="m")] | None = None
    coil_kappa_m2: Annotated[float, between(-1.0, 1.0)] = Magnetometer.coil_kappa
    offset_walk_t: Annotated[NotNegative, tesla(MAX_OFFSET)] = 2e-8  # gained in an hour
    warming: SensorTemperatureEntry | None = None
    response: Listed | None = None
    response_sigma: Annotated[list[ResponseSigmaEntry], at_least_one("frequency")] | None = None
    axis_responses: AxisResponsesEntry | None = None
    coil: CoilEntry | None = None
    axis_coils: AxisCoilsEntry | None = None
    ac_coupled: bool = Magnetometer.ac_coupled
    casing: CasingEntry | None = None
    axes: Annotated[list[Literal["x", "y", "z"]], Field(min_length=1, max_length=3)] | None = None
    name: Annotated[str, Field(min_length=1), AfterValidator(plain_name)] | None = None
    clock_offset_s: Annotated[float, between(-1e3, 1e3)] = Magnetometer.clock_offset
    clock_rate_ppm: Annotated[float, between(-1e4, 1e4)] = Magnetometer.clock_rate
    clock_rate_sigma_ppm: Annotated[float, between(0.0, 1e4)] = Magnetometer.clock_rate_sigma
    range_t: Annotated[
        AboveZero, tesla(Magnetometer.field_range), between(1e-9, Magnetometer.field_range)
    ] = Magnetometer.field_range
    sigma: MagnetometerSigmaEntry = Field(default_factory=MagnetometerSigmaEntry)


def check_magnetometers(
    one: MagnetometerEntry | None, several: list[MagnetometerEntry] | None
) -> None:
    """Refuse none, both forms, and magnetometers of equal names."""
    if several is None:
        _check_single(one)
        return
    if one is not None:
        remedy = "remove it, or magnetometers: a platform has one or a list"
        raise refusal_at(("magnetometer",), "both", remedy)
    names = [sensor.name for sensor in several]
    for i, sensor in enumerate(several):
        at = ("magnetometers", i)
        if sensor.name is None:
            detail = InitErrorDetails(type="missing", loc=(*at, "name"), input=None)
            raise ValidationError.from_exception_data("site", [detail])
        if sensor.name in names[:i]:
            remedy = f"give it another name than magnetometers[{names.index(sensor.name)}]"
            raise refusal_at((*at, "name"), sensor.name, remedy)
        if len(several) > 1 and sensor.axes is not None and len(set(sensor.axes)) < 3:
            remedy = "give all three axes: with others a receiver of fewer is not supported"
            raise refusal_at((*at, "axes"), sensor.axes, remedy)
    for i, sensor in enumerate(several):
        if sensor.clock_rate_ppm and len(several) > 1:
            remedy = "remove it: of several magnetometers no rate of a clock is known"
            raise refusal_at(("magnetometers", i, "clock_rate_ppm"), sensor.clock_rate_ppm, remedy)
    if several[0].clock_offset_s or several[0].sigma.clock_offset_s:
        remedy = "give it to the others: the clock of the first magnetometer is that of the log"
        raise refusal_at(("magnetometers", 0, "clock_offset_s"), several[0].clock_offset_s, remedy)


def _check_single(one: MagnetometerEntry | None) -> None:
    if one is None:
        detail = InitErrorDetails(type="missing", loc=("magnetometer",), input=None)
        raise ValidationError.from_exception_data("site", [detail])
    if one.sigma.clock_offset_s:
        remedy = "declare imu.time_offset_sigma_s: a single magnetometer has the log's clock"
        at = ("magnetometer", "sigma", "clock_offset_s")
        raise refusal_at(at, one.sigma.clock_offset_s, remedy)


def check_tones(sensor: MagnetometerEntry, tones_hz: Array, at: tuple[str | int, ...]) -> None:
    """Refuse a response that does not reach all tones, and a clock that leaves no phase known.

    `at`: place of the magnetometer in the site's file.
    """
    given = [key for key in RESPONSE_KEYS if getattr(sensor, key) is not None]
    if len(given) > 1:
        raise refusal_at((*at, given[0]), "both", f"remove it, or {given[1]}")
    if sensor.response is not None:
        check_response(sensor.response, tones_hz, (*at, "response"))
    if sensor.axis_responses is not None:
        for axis, entries in sensor.axis_responses.axes.items():
            check_response(entries, tones_hz, (*at, "axis_responses", axis))
    if sensor.response_sigma is not None:
        check_response_sigma(sensor.response_sigma, tones_hz, (*at, "response_sigma"))
    highest = float(np.max(tones_hz, initial=0.0))
    if 2.0 * np.pi * highest * sensor.sigma.clock_offset_s > MAX_PHASE:
        maximum = MAX_PHASE / (2.0 * np.pi * highest)
        remedy = (
            f"give at most {maximum:.2g} s, {MAX_PHASE:g} rad of the tone at {highest:g} Hz:"
            " beyond it the phases of magnetometers cannot be compared; record all by one clock"
        )
        raise refusal_at((*at, "sigma", "clock_offset_s"), sensor.sigma.clock_offset_s, remedy)


def magnetometer_of(entry: MagnetometerEntry) -> Magnetometer:
    """Return the magnetometer that an entry describes."""
    return Magnetometer(
        position_body=entry.body_from_sensor.position_m,
        body_from_sensor=rotation_of(entry.body_from_sensor.rpy_deg),
        noise_density=entry.noise_density_t_rthz,
        matrix=entry.matrix,
        offset=entry.offset_t,
        sigma=model_of(MagnetometerSigma, entry.sigma),
        coil_centres_sensor=entry.coil_centres_m,
        offset_walk=entry.offset_walk_t,
        coil_kappa=entry.coil_kappa_m2,
        temperature_model=None if entry.warming is None else entry.warming.temperature_model(),
        response=responses_of(
            entry.response or entry.coil, entry.axis_responses or entry.axis_coils
        ),
        response_sigma=response_sigma(entry.response_sigma),
        casing=None if entry.casing is None else entry.casing.casing(),
        axes="".join(sorted(set(entry.axes or Magnetometer.axes))),
        name=entry.name or Magnetometer.name,
        clock_offset=entry.clock_offset_s,
        clock_rate=entry.clock_rate_ppm / MILLION,
        clock_rate_sigma=entry.clock_rate_sigma_ppm / MILLION,
        field_range=entry.range_t,
        ac_coupled=entry.ac_coupled or bool(entry.coil or entry.axis_coils),
    )


def with_left_out(platform: Platform) -> tuple[Magnetometer, ...]:
    """Return all that a platform carries, in their order.

    Those that were left out of a log are as declared: the first of all keeps the clock.
    """
    sensors = list(platform.magnetometers)
    for place, sensor in reversed(platform.left_out):
        sensors.insert(place, sensor)
    return tuple(sensors)


def magnetometer_entries(sensors: tuple[Magnetometer, ...]) -> dict[str, Any]:
    """Return the entries of all magnetometers under their key."""
    if len(sensors) == 1 and sensors[0].name == Magnetometer.name:
        return {"magnetometer": _magnetometer_entry(sensors[0])}
    return {"magnetometers": [{"name": s.name} | _magnetometer_entry(s) for s in sensors]}


_UNLESS_USUAL: tuple[tuple[str, str, Callable[[Any], Any]], ...] = (
    ("coil_kappa_m2", "coil_kappa", float),
    ("offset_walk_t", "offset_walk", float),
    ("axes", "axes", list),
    ("clock_offset_s", "clock_offset", float),
    ("clock_rate_ppm", "clock_rate", ppm),
    ("clock_rate_sigma_ppm", "clock_rate_sigma", ppm),
    ("range_t", "field_range", float),
    ("ac_coupled", "ac_coupled", bool),
)


def _magnetometer_entry(magnetometer: Magnetometer) -> dict[str, Any]:
    sigma, centres = magnetometer.sigma, magnetometer.coil_centres_sensor
    own = {} if centres is None else {"coil_centres_m": plain(centres)}
    for key, name, written in _UNLESS_USUAL:
        value = getattr(magnetometer, name)
        own |= {} if value == getattr(Magnetometer, name) else {key: written(value)}
    clock = {"clock_offset_s": float(sigma.clock_offset)} if sigma.clock_offset else {}
    return (
        own
        | temperature_entry(magnetometer.temperature_model)
        | response_entry(magnetometer.response)
        | response_sigma_entry(magnetometer.response_sigma)
        | casing_entry(magnetometer.casing)
        | {
            "body_from_sensor": {
                "position_m": plain(magnetometer.position_body),
                "rpy_deg": rpy_deg(magnetometer.body_from_sensor),
            },
            "noise_density_t_rthz": float(magnetometer.noise_density),
            "matrix": plain(magnetometer.matrix),
            "offset_t": plain(magnetometer.offset),
            "sigma": {
                "matrix": sigma_entry(sigma.matrix),
                "offset_t": sigma_entry(sigma.offset),
                "rotation_deg": degree_sigma_entry(sigma.rotation_sensor),
                "position_m": sigma_entry(sigma.position_body),
                **clock,
            },
        }
    )
