"""Parameters of the platform's instruments, and of the Earth field about it."""

from dataclasses import replace
from typing import ClassVar

import numpy as np

from magfusion.model.parameters.parameter import (
    AXES,
    CENTIMETRE,
    DEGREES,
    METRE,
    MILLISECOND,
    PERCENT,
    PPM,
    SECOND,
    Calibration,
    Parameter,
    PhasorView,
    SiteParameter,
    SteadyView,
    Unit,
)
from magfusion.model.site import Magnetometer, Site
from magfusion.units import Array, ComplexArray

MICROTESLA = 1e-6  # T


class _MagnetometerParameter(SiteParameter):
    def part(self, site: Site, owner: str) -> Magnetometer:
        return site.platform.magnetometer

    def with_part(self, site: Site, part: Magnetometer) -> Site:
        return replace(site, platform=replace(site.platform, magnetometer=part))


class _Matrix(_MagnetometerParameter):
    group, owner, kind = "magnetometer", "magnetometer", "matrix"
    attribute = sigma_attribute = "matrix"
    components = tuple(row + column for row in AXES for column in AXES)
    spoken = PERCENT
    words = tuple(
        f"the magnetometer's gain on {row}"
        if row == column
        else f"{column} in the magnetometer's {row}"
        for row in AXES
        for column in AXES
    )
    negligible = 1e-3
    field_error = 3.0
    by_turning = "the magnetometer's matrix"

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        return view.whole.matrix

    def steady_jacobian(self, view: SteadyView) -> Array | None:
        return view.observation.matrix


class _Offset(_MagnetometerParameter):
    group, owner, kind, components = "magnetometer", "magnetometer", "offset", AXES
    attribute = sigma_attribute = "offset"
    unit, spoken, si = Unit("nt", 1e-3), Unit("nT", 1e-3), MICROTESLA
    words = "the magnetometer's offset on {axis}"
    negligible = 5e-3
    steady_only = True
    walk = "platform.magnetometer.offset_walk"

    def steady_jacobian(self, view: SteadyView) -> Array | None:
        return MICROTESLA * view.observation.offset


class _Rotation(_MagnetometerParameter):
    group, owner, kind, components = "extrinsics", "sensor", "rotation", AXES
    attribute, sigma_attribute, is_rotation = "body_from_sensor", "rotation_sensor", True
    unit = spoken = DEGREES
    words = "the mounting's turn about the sensor's {axis}"
    negligible = 1.75e-3
    field_error = 2.0
    by_turning = "the rotation of the mounting"

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        return view.whole.body_from_sensor[..., :3]

    def steady_jacobian(self, view: SteadyView) -> Array | None:
        return view.observation.sensor_rotation


class _Position(_MagnetometerParameter):
    group, owner, kind, components = "extrinsics", "sensor", "position", AXES
    attribute = sigma_attribute = "position_body"
    unit, spoken = METRE, CENTIMETRE
    words = "the lever arm along {axis}"
    negligible = 2e-3
    field_error, falls = 9.0, 2  # the field falls with the cube of the distance
    by_turning = "the lever arm"

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        mounting = view.calibration.site.platform.magnetometer.body_from_sensor
        return view.whole.body_from_sensor[..., 3:] @ mounting.T


class _TimeOffset(Parameter):
    group, owner, kind = "time-offset", "imu", "time_offset"
    unit, spoken = SECOND, MILLISECOND
    words = by_turning = "the IMU's time offset"
    negligible = 1e-4
    declared = each_log = True

    def sigma(self, site: Site, owner: str) -> Array:
        return np.array([site.platform.imu.time_offset_sigma])

    def value(self, calibration: Calibration, owner: str) -> Array | None:
        return np.array([calibration.time_offset])

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        return replace(calibration, time_offset=calibration.time_offset + float(step[0]))

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        return np.array([new.time_offset - old.time_offset])

    def refined(self, site: Site, calibration: Calibration, owner: str, sigma: Array) -> Site:
        value = {"time_offset": calibration.time_offset, "time_offset_sigma": float(sigma[0])}
        imu = replace(site.platform.imu, **value)
        return replace(site, platform=replace(site.platform, imu=imu))

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        if view.whole.time_offset is None:
            raise ValueError("twist_body must be given where the time offset is estimated")
        return view.whole.time_offset[..., None]

    def steady_jacobian(self, view: SteadyView) -> Array | None:
        return -view.observation.platform_rotation @ view.rate_body[..., None]


class _ClockRate(Parameter):
    """What the time offset changes by in each second, from the IMU's first sample on."""

    group, owner, kind = "time-offset", "imu", "clock_rate"
    unit = spoken = PPM
    words = by_turning = "the rate of the IMU's clock"
    negligible = 1e-7
    declared = each_log = True

    def sigma(self, site: Site, owner: str) -> Array:
        imu = site.platform.imu
        # Stamps that are known exactly are of one clock.
        return np.array([imu.clock_rate_sigma if imu.time_offset_sigma else 0.0])

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        return replace(calibration, clock_rate=calibration.clock_rate + float(step[0]))

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        return np.array([new.clock_rate - old.clock_rate])

    def refined(self, site: Site, calibration: Calibration, owner: str, sigma: Array) -> Site:
        value = {"clock_rate": calibration.clock_rate, "clock_rate_sigma": float(sigma[0])}
        imu = replace(site.platform.imu, **value)
        return replace(site, platform=replace(site.platform, imu=imu))

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        by_offset = TIME_OFFSET.phasor_jacobian(view, owner)
        assert by_offset is not None
        time = view.calibration.reference_time + view.elapsed
        return by_offset * _running(view.calibration, time)[:, None, None, None]

    def steady_jacobian(self, view: SteadyView) -> Array | None:
        by_offset = TIME_OFFSET.steady_jacobian(view)
        assert by_offset is not None
        return by_offset * _running(view.calibration, view.time)[:, None, None]


def _running(calibration: Calibration, time: Array) -> Array:
    """Return how long the IMU's clock has run (s)."""
    return time - calibration.imu_begin


def _cylindrical(calibration: Calibration) -> Array:
    """Return the Earth field's azimuth (rad), and its horizontal and vertical part (T)."""
    assert calibration.site.earth_field_world is not None
    x, y, z = calibration.site.earth_field_world
    return np.array([np.arctan2(y, x), np.hypot(x, y), z])


class _EarthParameter(Parameter):
    """Cylindrical coordinates of the Earth field about the vertical."""

    group, owner = "earth", "earth"
    steady_only = True
    coordinates: ClassVar[slice]

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        found = _cylindrical(calibration)
        found[self.coordinates] += self.si * step
        azimuth, level, up = found
        field = np.array([level * np.cos(azimuth), level * np.sin(azimuth), up])
        return replace(calibration, site=replace(calibration.site, earth_field_world=field))

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        change = _cylindrical(new) - _cylindrical(old)
        change[0] = np.angle(np.exp(1j * change[0]))
        return change[self.coordinates] / self.si

    def refined(self, site: Site, calibration: Calibration, owner: str, sigma: Array) -> Site:
        return replace(site, location=None)  # the estimate takes the place of the location's

    def steady_jacobian(self, view: SteadyView) -> Array | None:
        azimuth, level, _ = _cylindrical(view.calibration)
        s, c = np.sin(azimuth), np.cos(azimuth)
        by_all = np.array([[-level * s, c, 0.0], [level * c, s, 0.0], [0.0, 0.0, 1.0]])
        return view.observation.earth_world @ (self.si * by_all[:, self.coordinates])


class _Declination(_EarthParameter):
    kind, coordinates = "declination", slice(0, 1)
    unit = spoken = DEGREES
    words = "the declination of the Earth field"
    walk = "earth.declination_walk"

    def sigma(self, site: Site, owner: str) -> Array:
        return np.array([0.0 if site.earth_field_world is None else site.earth.declination_sigma])


class _Strength(_EarthParameter):
    kind, coordinates = "strength", slice(1, 3)
    unit, spoken, si = Unit("nt", 1e-3), Unit("nT", 1e-3), MICROTESLA
    words = ("the horizontal part of the Earth field", "the vertical part of the Earth field")
    walk = "earth.strength_walk"

    def sigma(self, site: Site, owner: str) -> Array:
        field = site.earth_field_world
        size = 0.0 if field is None else float(np.linalg.norm(field)) / MICROTESLA
        return np.full(2, site.earth.strength_sigma * size)


MATRIX, OFFSET = _Matrix(), _Offset()
SENSOR_ROTATION, SENSOR_POSITION = _Rotation(), _Position()
TIME_OFFSET, CLOCK_RATE = _TimeOffset(), _ClockRate()
DECLINATION, STRENGTH = _Declination(), _Strength()
