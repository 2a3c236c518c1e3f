"""Parameters of the platform's instruments, and of the surrounding Earth field."""

from dataclasses import replace
from typing import ClassVar

import numpy as np

from magfusion.model.parameters.parameter import (
    AXES,
    CENTIMETRE,
    CLOCK,
    DEGREES,
    METRE,
    MILLISECOND,
    PERCENT,
    PPM,
    SECOND,
    Calibration,
    Parameter,
    ParameterUnit,
    PhasorView,
    SiteParameter,
    StaticView,
)
from magfusion.model.response import ResponseSigma, changed_axes, log_response
from magfusion.model.site import Magnetometer, Site
from magfusion.units import MICROTESLA, Array, ComplexArray


class MagnetometerParameter(SiteParameter):
    """A parameter of every magnetometer; where there are several, their names are owners."""

    def owners(self, site: Site) -> tuple[str, ...]:
        """Return the names of the magnetometers, or the common name of a single one."""
        several = site.platform.further
        return tuple(m.name for m in site.platform.magnetometers) if several else (self.owner,)

    def part(self, site: Site, owner: str) -> Magnetometer:
        """Return the magnetometer."""
        return site.platform.magnetometers[self.sensor(site, owner)]

    def sensor(self, site: Site, owner: str) -> int:
        """Return the index of the magnetometer."""
        return MagnetometerParameter.owners(self, site).index(owner)

    def with_part(self, site: Site, part: Magnetometer) -> Site:
        """Return the site with the magnetometer of that name replaced."""
        platform = site.platform
        if not platform.further:
            return replace(site, platform=replace(platform, magnetometer=part))
        every = tuple(part if m.name == part.name else m for m in platform.magnetometers)
        return replace(site, platform=platform.with_magnetometers(every))

    def kept_to(self, site: Site) -> float:
        """Return the largest sigma with which it is fixed at its declared value.

        With several magnetometers none is fixed: a difference between two rotates the platform.
        """
        return 0.0 if site.platform.further else self.negligible

    def called(self, site: Site, owner: str, i: int) -> str:
        """Return the name of one of its numbers in messages, with that of the magnetometer."""
        words = super().called(site, owner, i)
        if not site.platform.further:
            return words
        named = words.replace("the magnetometer's", f"magnetometer {owner}'s")
        return named if named != words else f"{words} of magnetometer {owner}"

    def phasor_jacobian(self, view: PhasorView, owner: str) -> ComplexArray | None:
        """Return the columns of its own phasors; it does not affect the others'."""
        site = view.calibration.site
        if site.platform.further and self.sensor(site, owner) != view.sensor:
            return None
        return self.own_jacobian(view)

    def own_jacobian(self, view: PhasorView) -> ComplexArray | None:
        """Return the columns of the magnetometer's own phasors."""
        return None


class _Matrix(MagnetometerParameter):
    group, owner, kind = "magnetometer", "magnetometer", "matrix"
    attribute = sigma_attribute = "matrix"
    components = tuple(row + column for row in AXES for column in AXES)
    display_unit = PERCENT
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

    def own_jacobian(self, view: PhasorView) -> ComplexArray | None:
        return view.whole.matrix

    def static_jacobian(self, view: StaticView) -> Array | None:
        return view.observation.matrix


class _Offset(MagnetometerParameter):
    group, owner, kind, components = "magnetometer", "magnetometer", "offset", AXES
    attribute = sigma_attribute = "offset"
    unit, display_unit, si = ParameterUnit("nt", 1e-3), ParameterUnit("nT", 1e-3), MICROTESLA
    words = "the magnetometer's offset on {axis}"
    negligible = 5e-3
    static_only = True
    walk = "platform.magnetometer.offset_walk"

    def static_jacobian(self, view: StaticView) -> Array | None:
        return MICROTESLA * view.observation.offset


class _Response(MagnetometerParameter):
    """Logarithms of the response of y and z at some frequencies, relative to that of x."""

    group, owner = "magnetometer", "magnetometer"
    factor_of_phasor = True
    field_error = 2.0 / 3.0
    factor: ClassVar[complex]

    def owners(self, site: Site) -> tuple[str, ...]:
        every = super().owners(site)
        return tuple(owner for owner in every if self.part(site, owner).response_sigma is not None)

    def _prior(self, site: Site, owner: str) -> ResponseSigma:
        result = self.part(site, owner).response_sigma
        assert result is not None
        return result

    def sigma(self, site: Site, owner: str) -> Array:
        return np.ravel(getattr(self._prior(site, owner), self.attribute))

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        site, part = calibration.site, self.part(calibration.site, owner)
        nodes_hz, change = self._prior(site, owner).frequency_hz, step.reshape(-1, 2)
        response = changed_axes(part.response, nodes_hz, np.asarray(self.factor * change))
        return replace(calibration, site=self.with_part(site, replace(part, response=response)))

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        before, after = (self.value(calibration, owner) for calibration in (old, new))
        assert before is not None
        assert after is not None
        return after - before

    def value(self, calibration: Calibration, owner: str) -> Array | None:
        nodes_hz = self._prior(calibration.site, owner).frequency_hz
        log = log_response(self.part(calibration.site, owner).response, nodes_hz)[:, 1:]
        return np.ravel((log / self.factor).real)

    def refined(self, site: Site, calibration: Calibration, owner: str, sigma: Array) -> Site:
        part = self.part(site, owner)
        prior = replace(self._prior(site, owner), **{self.attribute: sigma.reshape(-1, 2)})
        return self.with_part(site, replace(part, response_sigma=prior))

    def own_jacobian(self, view: PhasorView) -> ComplexArray | None:
        platform = view.calibration.site.platform
        prior = platform.magnetometers[view.sensor].response_sigma
        assert prior is not None
        tones_hz = view.beacon.tone_frequencies_hz
        node = np.argmin(np.abs(tones_hz[:, None] - prior.frequency_hz), axis=1)
        own = np.eye(len(prior.frequency_hz))[node]  # (tones, k)
        columns = np.einsum("nta,ab,tk->ntakb", view.phasor, np.eye(3)[:, 1:], own)
        return self.factor * columns.reshape(*view.phasor.shape, -1)

    def called(self, site: Site, owner: str, i: int) -> str:
        frequency_hz = self._prior(site, owner).frequency_hz[i // 2]
        return f"{super().called(site, owner, i)} {AXES[1 + i % 2]} at {frequency_hz:g} Hz"


class _ResponseGain(_Response):
    kind, attribute, factor = "response_gain", "gain", 1.0
    display_unit = PERCENT
    words = by_turning = "the magnetometer's gain relative to x, of"


class _ResponsePhase(_Response):
    kind, attribute, factor = "response_phase", "phase", 1j
    unit = display_unit = DEGREES
    words = by_turning = "the magnetometer's phase relative to x, of"


class _Rotation(MagnetometerParameter):
    group, owner, kind, components = "extrinsics", "sensor", "rotation", AXES
    attribute, sigma_attribute, is_rotation = "body_from_sensor", "rotation_sensor", True
    unit = display_unit = DEGREES
    words = "the mounting's turn about the sensor's {axis}"
    negligible = 1.75e-3
    field_error = 2.0
    by_turning = "the rotation of the mounting"

    def own_jacobian(self, view: PhasorView) -> ComplexArray | None:
        return view.whole.body_from_sensor[..., :3]

    def static_jacobian(self, view: StaticView) -> Array | None:
        return view.observation.sensor_rotation


class _Position(MagnetometerParameter):
    group, owner, kind, components = "extrinsics", "sensor", "position", AXES
    attribute = sigma_attribute = "position_body"
    unit, display_unit = METRE, CENTIMETRE
    words = "the lever arm along {axis}"
    negligible = 2e-3
    field_error, falls = 9.0, 2  # the field falls with the cube of the distance
    by_turning = "the lever arm"

    def own_jacobian(self, view: PhasorView) -> ComplexArray | None:
        mounting = view.calibration.site.platform.magnetometers[view.sensor].body_from_sensor
        return view.whole.body_from_sensor[..., 3:] @ mounting.T


class _ClockOffset(MagnetometerParameter):
    """Offset of a magnetometer's stamps in addition to the declared one.

    A stamp that is too early gets a phase that leads, and a position of a later time.
    """

    group, owner, kind = "time-offset", "magnetometer", CLOCK
    unit, display_unit = SECOND, MILLISECOND
    words = "the clock of the magnetometer"
    sigma_attribute = CLOCK
    each_log = True

    def sigma(self, site: Site, owner: str) -> Array:
        return np.array([self.part(site, owner).sigma.clock_offset])

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        return Parameter.moved(self, calibration, owner, step)

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        return Parameter.difference(self, old, new, owner)

    def value(self, calibration: Calibration, owner: str) -> Array | None:
        result = calibration.others.get(f"{owner}.{self.kind}", np.zeros(1))
        return self.part(calibration.site, owner).clock_offset + result

    def refined(self, site: Site, calibration: Calibration, owner: str, sigma: Array) -> Site:
        part, value = self.part(site, owner), self.value(calibration, owner)
        assert value is not None
        known = replace(part.sigma, clock_offset=float(sigma[0]))
        return self.with_part(site, replace(part, clock_offset=float(value[0]), sigma=known))

    def own_jacobian(self, view: PhasorView) -> ComplexArray | None:
        turns = 2j * np.pi * view.beacon.tone_frequencies_hz[:, None]
        by_phase = turns * view.phasor
        # No twist where only the pose is estimated: a fix assumes a nearly stationary platform.
        moved = view.whole.time_offset
        return (by_phase if moved is None else by_phase - moved)[..., None]


class _TimeOffset(Parameter):
    group, owner, kind = "time-offset", "imu", "time_offset"
    unit, display_unit = SECOND, MILLISECOND
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

    def static_jacobian(self, view: StaticView) -> Array | None:
        return -view.observation.platform_rotation @ view.rate_body[..., None]


class _ClockRate(Parameter):
    """Change of the time offset per second, from the IMU's first sample on."""

    group, owner, kind = "time-offset", "imu", "clock_rate"
    unit = display_unit = PPM
    words = by_turning = "the rate of the IMU's clock"
    negligible = 1e-7
    declared = each_log = True

    def sigma(self, site: Site, owner: str) -> Array:
        imu = site.platform.imu
        # Stamps with a known offset are of one clock.
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

    def static_jacobian(self, view: StaticView) -> Array | None:
        by_offset = TIME_OFFSET.static_jacobian(view)
        assert by_offset is not None
        return by_offset * _running(view.calibration, view.time)[:, None, None]


def _running(calibration: Calibration, time: Array) -> Array:
    """Return the running time of the IMU's clock (s)."""
    return time - calibration.imu_begin


def _cylindrical(calibration: Calibration) -> Array:
    """Return the Earth field's azimuth (rad), and its horizontal and vertical part (T)."""
    assert calibration.site.earth_field_world is not None
    x, y, z = calibration.site.earth_field_world
    return np.array([np.arctan2(y, x), np.hypot(x, y), z])


class _EarthParameter(Parameter):
    """Cylindrical coordinates of the Earth field about the vertical."""

    group, owner = "earth", "earth"
    static_only = True
    coordinates: ClassVar[slice]

    def moved(self, calibration: Calibration, owner: str, step: Array) -> Calibration:
        result = _cylindrical(calibration)
        result[self.coordinates] += self.si * step
        azimuth, level, up = result
        field = np.array([level * np.cos(azimuth), level * np.sin(azimuth), up])
        return replace(calibration, site=replace(calibration.site, earth_field_world=field))

    def difference(self, old: Calibration, new: Calibration, owner: str) -> Array:
        change = _cylindrical(new) - _cylindrical(old)
        change[0] = np.angle(np.exp(1j * change[0]))
        return change[self.coordinates] / self.si

    def refined(self, site: Site, calibration: Calibration, owner: str, sigma: Array) -> Site:
        return replace(site, location=None)  # the estimate replaces the location's field

    def static_jacobian(self, view: StaticView) -> Array | None:
        azimuth, level, _ = _cylindrical(view.calibration)
        s, c = np.sin(azimuth), np.cos(azimuth)
        by_all = np.array([[-level * s, c, 0.0], [level * c, s, 0.0], [0.0, 0.0, 1.0]])
        return view.observation.earth_world @ (self.si * by_all[:, self.coordinates])


class _Declination(_EarthParameter):
    kind, coordinates = "declination", slice(0, 1)
    unit = display_unit = DEGREES
    words = "the declination of the Earth field"
    walk = "earth.declination_walk"

    def sigma(self, site: Site, owner: str) -> Array:
        return np.array([0.0 if site.earth_field_world is None else site.earth.declination_sigma])


class _Strength(_EarthParameter):
    kind, coordinates = "strength", slice(1, 3)
    unit, display_unit, si = ParameterUnit("nt", 1e-3), ParameterUnit("nT", 1e-3), MICROTESLA
    words = ("the horizontal part of the Earth field", "the vertical part of the Earth field")
    walk = "earth.strength_walk"

    def sigma(self, site: Site, owner: str) -> Array:
        field = site.earth_field_world
        size = 0.0 if field is None else float(np.linalg.norm(field)) / MICROTESLA
        return np.full(2, site.earth.strength_sigma * size)


MATRIX, OFFSET = _Matrix(), _Offset()
RESPONSE_GAIN, RESPONSE_PHASE = _ResponseGain(), _ResponsePhase()
SENSOR_ROTATION, SENSOR_POSITION, CLOCK_OFFSET = _Rotation(), _Position(), _ClockOffset()
TIME_OFFSET, CLOCK_RATE = _TimeOffset(), _ClockRate()
DECLINATION, STRENGTH = _Declination(), _Strength()
