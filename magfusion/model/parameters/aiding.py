"""Parameters of aiding sensors: scale, offset, mounting."""

from dataclasses import replace

import numpy as np

from magfusion.model.aiding import QUANTITIES, AidingSensor, Quantity, sensor_named
from magfusion.model.parameters.parameter import (
    AXES,
    CENTIMETRE,
    DEGREES,
    METRE,
    MILLISECOND,
    PERCENT,
    SECOND,
    ParameterUnit,
    SiteParameter,
)
from magfusion.model.site import Site
from magfusion.units import HOUR, Array


class AidingParameter(SiteParameter):
    """A parameter of every aiding sensor of some kinds; their names are its owners."""

    group, owner = "aiding", "aiding"
    of_quantities: tuple[Quantity, ...]

    def owners(self, site: Site) -> tuple[str, ...]:
        """Return the names of the sensors that have it."""
        return tuple(sensor.name for sensor in site.aiding if sensor.quantity in self.of_quantities)

    def part(self, site: Site, owner: str) -> AidingSensor:
        """Return the sensor."""
        return sensor_named(site.aiding, owner)

    def with_part(self, site: Site, part: AidingSensor) -> Site:
        """Return the site with the sensor of that name replaced."""
        every = tuple(part if sensor.name == part.name else sensor for sensor in site.aiding)
        return replace(site, aiding=every)

    def sigma(self, site: Site, owner: str) -> Array:
        """Return the declared standard deviations."""
        return np.ravel(getattr(self.part(site, owner).sigmas, self.sigma_attribute)) / self.si

    def refined(self, site: Site, calibration: object, owner: str, sigma: Array) -> Site:
        """Return the site with the posterior sigma; it already has the value."""
        part = self.part(site, owner)
        shape = getattr(part.sigmas, self.sigma_attribute).shape
        sigmas = replace(part.sigmas, **{self.sigma_attribute: self.si * sigma.reshape(shape)})
        return self.with_part(site, replace(part, sigmas=sigmas))


class _Scale(AidingParameter):
    kind = attribute = sigma_attribute = "scale"
    display_unit = PERCENT
    words = "the scale of {owner}"
    of_quantities = ("velocity", "relative_pose")


class _Offset(AidingParameter):
    kind = attribute = sigma_attribute = "offset"
    words = "the offset of {owner}"
    of_quantities: tuple[Quantity, ...] = ("range", "height", "heading")

    def sigma(self, site: Site, owner: str) -> Array:
        """Return the declared standard deviation; one that walks gains that of a second at once."""
        a_second = self.walk_per_sqrt_hour(site, owner) / np.sqrt(HOUR)
        return np.maximum(super().sigma(site, owner), a_second)

    def walk_per_sqrt_hour(self, site: Site, owner: str) -> float:
        """Return the standard deviation that it gains in an hour."""
        return self.part(site, owner).offset_walk / self.si


class _PressureOffset(_Offset):
    of_quantities = ("pressure",)
    si = 10.0  # Pa; near a metre of air
    unit = display_unit = ParameterUnit("Pa", 0.1)


class _Clock(AidingParameter):
    kind, attribute, sigma_attribute = "clock_offset", "time_offset", "time_offset"
    unit, display_unit = SECOND, MILLISECOND
    words = "the clock of {owner}"
    of_quantities = QUANTITIES


class _Rotation(AidingParameter):
    kind, components = "rotation", AXES
    attribute, sigma_attribute, is_rotation = "body_from_sensor", "rotation_sensor", True
    unit = display_unit = DEGREES
    words = "the mounting of {owner}, turned about its {axis}"
    of_quantities = ("velocity", "relative_pose")


class _Position(AidingParameter):
    kind, components = "position", AXES
    attribute = sigma_attribute = "position_body"
    unit, display_unit = METRE, CENTIMETRE
    words = "the lever arm of {owner} along {axis}"
    of_quantities = tuple(kind for kind in QUANTITIES if kind != "heading")


class _Point(AidingParameter):
    kind, components = "point", AXES
    attribute = sigma_attribute = "point_world"
    unit, display_unit = METRE, CENTIMETRE
    words = "{axis} of the point of {owner}"
    of_quantities = ("range",)


AIDING_SCALE, AIDING_OFFSET, AIDING_PRESSURE = _Scale(), _Offset(), _PressureOffset()
AIDING_CLOCK = _Clock()
AIDING_ROTATION, AIDING_POSITION, AIDING_POINT = _Rotation(), _Position(), _Point()
