"""What a site's file may hold: the keys, their types, ranges and defaults."""

from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, Field, PlainValidator, model_validator

from magfusion.files.site_aiding import AidingEntry
from magfusion.files.site_beacon import BeaconEntry
from magfusion.files.site_magnetometer import MagnetometerEntry, check_magnetometers, check_tones
from magfusion.files.site_motion import ImuEntry, ImuIntrinsicsEntry, MotionEntry, MotionPriorEntry
from magfusion.files.site_region import RegionEntry
from magfusion.files.site_values import (
    MAX_CONDUCTIVITY,
    MAX_EARTH_FIELD,
    AboveZero,
    FromZero,
    NotNegative,
    Position,
    Positive,
    Share,
    a_conductivity,
    array,
    at_least_one,
    between,
    first_version,
    iso_date,
    refusal_at,
    tesla,
)
from magfusion.files.yaml_files import StrictModel
from magfusion.model.site import ClockModel, EarthModel, Site
from magfusion.units import DEGREE, Array

_CLOCK, _EARTH = ClockModel(), EarthModel()


class LocationEntry(StrictModel):
    """Where and when, for the IGRF."""

    latitude_deg: float
    longitude_deg: float
    height_m: Annotated[float, between(-2e4, 1e6)]
    date: Annotated[str, PlainValidator(iso_date)]


class ClockEntry(StrictModel):
    """`magfusion.model.site.ClockModel`, field by field in its order."""

    drift_sigma: Positive = _CLOCK.drift_sigma
    drift_largest: Positive = _CLOCK.drift_largest
    phase_walk_deg: NotNegative = _CLOCK.phase_walk / DEGREE
    drift_walk: NotNegative = _CLOCK.drift_walk
    log_moment_walk: NotNegative = _CLOCK.log_moment_walk


class EarthEntry(StrictModel):
    """`magfusion.model.site.EarthModel`, field by field in its order."""

    declination_sigma_deg: Positive = _EARTH.declination_sigma / DEGREE
    strength_sigma: Positive = _EARTH.strength_sigma
    declination_walk_deg: NotNegative = _EARTH.declination_walk / DEGREE
    strength_walk_t: Annotated[NotNegative, tesla(MAX_EARTH_FIELD)] = _EARTH.strength_walk


class WorldSigmaEntry(StrictModel):
    """Priors of the world's calibration; an absent one is zero, which means known."""

    conductivity_s_m: Annotated[FromZero, between(0.0, MAX_CONDUCTIVITY)] = 0.0


class WorldEntry(StrictModel):
    """Gravity, the Earth's field and the trust in the field model."""

    gravity_m_s2: Annotated[AboveZero, between(1e-3, 100.0)] = 9.80665
    model_error: Share = 0.005
    model_error_correlation_m: NotNegative = Site.model_error_length
    field_map: Annotated[str, Field(min_length=1)] | None = None
    steel: Annotated[str, Field(min_length=1)] | None = None
    earth_field_t: Annotated[Array, array(3), tesla(MAX_EARTH_FIELD)] | None = None
    location: LocationEntry | None = None
    earth: EarthEntry = EarthEntry()
    conductivity_s_m: Annotated[FromZero, AfterValidator(a_conductivity)] = 0.0
    sigma: WorldSigmaEntry = WorldSigmaEntry()

    @model_validator(mode="after")
    def _one_earth(self) -> Self:
        if self.earth_field_t is not None and self.location is not None:
            remedy = "give either it or location, not both"
            raise refusal_at(("earth_field_t",), self.earth_field_t.tolist(), remedy)
        return self

    @model_validator(mode="after")
    def _ground_that_conducts(self) -> Self:
        if self.sigma.conductivity_s_m and not self.conductivity_s_m:
            remedy = "give the likely conductivity too, not zero: it is estimated as a factor of it"
            raise refusal_at(("conductivity_s_m",), self.conductivity_s_m, remedy)
        return self


class PlatformEntry(StrictModel):
    """What moves."""

    imu: ImuEntry | None = None
    imu_intrinsics: ImuIntrinsicsEntry | None = None
    magnetometer: MagnetometerEntry | None = None
    magnetometers: Annotated[list[MagnetometerEntry], at_least_one("magnetometer")] | None = None
    motion: MotionEntry = MotionEntry()
    motion_prior: MotionPriorEntry | None = None

    @model_validator(mode="after")
    def _one_or_several(self) -> Self:
        check_magnetometers(self.magnetometer, self.magnetometers)
        return self

    @property
    def every(self) -> list[MagnetometerEntry]:
        """All magnetometers."""
        if self.magnetometers is not None:
            return self.magnetometers
        return [] if self.magnetometer is None else [self.magnetometer]


class ReferenceEntry(StrictModel):
    """A reference magnetometer for the noise."""

    position_m: Position


_OWN_NAMES = ("imu", "magnetometer", "sensor", "site", "truth")  # owners of parameters and roles


class SiteEntry(StrictModel):
    """The whole file."""

    magfusion_site: Annotated[int, AfterValidator(first_version)]
    world: WorldEntry = Field(default_factory=WorldEntry)
    beacons: list[BeaconEntry]
    platform: PlatformEntry
    clock: ClockEntry = ClockEntry()
    region: RegionEntry | None = None
    reference: ReferenceEntry | None = None
    aiding: list[AidingEntry] = Field(default_factory=list)
    calibration: dict[str, Any] | None = None
    correlation: Annotated[str, Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _magnetometers_fit_the_beacons(self) -> Self:
        tones = [f for b in self.beacons for f in b.tones_hz]
        several = self.platform.magnetometers is not None
        for i, sensor in enumerate(self.platform.every):
            key = ("magnetometers", i) if several else ("magnetometer",)
            check_tones(sensor, np.array(tones), ("platform", *key))
        selected = [sensor.name for sensor in self.platform.every] if several else []
        for i, beacon in enumerate(self.beacons):
            if beacon.name in selected:
                place = ("platform", "magnetometers", selected.index(beacon.name), "name")
                raise refusal_at(place, beacon.name, f"give it another name than beacons[{i}]")
        return self

    @model_validator(mode="after")
    def _distinct_names(self) -> Self:
        names = [b.name for b in self.beacons]
        for i, name in enumerate(names):
            if name in names[:i]:
                first = names.index(name)
                remedy = f"give it another name than beacons[{first}]"
                raise refusal_at(("beacons", i, "name"), name, remedy)
        used = {name: f"beacons[{i}]" for i, name in enumerate(names)}
        used |= {m.name: f"magnetometers[{i}]" for i, m in enumerate(self.platform.every) if m.name}
        used |= {name: f"the platform's {name}" for name in _OWN_NAMES}
        for i, sensor in enumerate(self.aiding):
            name = sensor.name or sensor.quantity
            if name in used:
                remedy = f"give it another name than {used[name]}"
                raise refusal_at(("aiding", i, "name"), name, remedy)
            used[name] = f"aiding[{i}]"
        return self
