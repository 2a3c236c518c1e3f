"""What is wrongly declared of aiding sensors: scale, lever arm, frame, clock; and outliers.

All rows are of one platform that has a sensor of several kinds besides its magnetometer; those of a
relative pose are of one with such a sensor in addition.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from mistake_case import Case, Change, Mistake, again
from scipy.spatial.transform import Rotation

from magfusion.model.aiding import AidingSensor
from magfusion.units import DEGREE, Array

REST = ("rest",)
LEVER = np.array([0.3, -0.2, 0.1])  # m
AWAY = np.array([0.12, 0.0, 0.16])  # m; 20 cm
SHARE = 0.05  # of samples that are outliers
SENSOR_ATTITUDE = Rotation.from_euler("xyz", [3.0, -5.0, 20.0], degrees=True).as_matrix()
SENSORS = (
    AidingSensor("visual", "velocity", 0.02, position_body=LEVER, body_from_sensor=SENSOR_ATTITUDE),
    AidingSensor(
        "anchor", "range", 0.05, position_body=LEVER, point_world=np.array([6.0, 1.0, 2.0])
    ),
    AidingSensor("prism", "position", 0.01, position_body=LEVER),
    AidingSensor("level", "height", 0.02, position_body=LEVER),
    AidingSensor("compass", "heading", 0.5 * DEGREE),
)
KEYFRAMES = AidingSensor(
    "keyframes",
    "relative_pose",
    0.005,
    position_body=LEVER,
    body_from_sensor=SENSOR_ATTITUDE,
    rate_hz=2.0,
    rotation_sigma=0.2 * DEGREE,
)


def _aided(case: Case, name: str = "") -> Case:
    """Return the case of a platform with aiding sensors, declared as they are."""
    site = replace(case.site, aiding=(*SENSORS, KEYFRAMES) if name == KEYFRAMES.name else SENSORS)
    return replace(again(case, site), site=site)


def _declared(name: str, change: Callable[[AidingSensor], AidingSensor]) -> Change:
    """Return a mistake in the declaration of a sensor."""

    def changed(case: Case) -> Case:
        aided = _aided(case, name)
        sensors = tuple(change(s) if s.name == name else s for s in aided.site.aiding)
        return replace(aided, site=replace(aided.site, aiding=sensors))

    return changed


def _scaled(sensor: AidingSensor) -> AidingSensor:
    return replace(sensor, scale=1.05 * sensor.scale)


def _levered(sensor: AidingSensor) -> AidingSensor:
    return replace(sensor, position_body=sensor.position_body + AWAY)


def _late(sensor: AidingSensor) -> AidingSensor:
    return replace(sensor, time_offset=sensor.time_offset + 0.2)


def _rotated(sensor: AidingSensor) -> AidingSensor:
    turn = Rotation.from_rotvec([0.0, 0.0, 3.0], degrees=True).as_matrix()
    return replace(sensor, body_from_sensor=sensor.body_from_sensor @ turn)


def _offset(sensor: AidingSensor) -> AidingSensor:
    return replace(sensor, offset=sensor.offset + 3.0 * DEGREE)


def _outliers(name: str, size: float) -> Change:
    """Return data of which one sample in twenty is wrong by up to a size."""

    def changed(case: Case) -> Case:
        aided = _aided(case, name)
        samples = aided.log.aiding[name]
        hit = case.rng.random(len(samples)) < SHARE
        wrong: Array = case.rng.uniform(-size, size, samples.value.shape)
        wrong[:, :1] *= samples.quantity != "relative_pose"  # its interval
        wrong = np.abs(wrong) if samples.quantity == "range" else wrong  # a reflection is longer
        value = samples.value + hit[:, None] * wrong
        aiding = {**aided.log.aiding, name: replace(samples, value=value)}
        return replace(aided, log=replace(aided.log, aiding=aiding))

    return changed


def _recorded(name: str, factor: float | Array, offset: float = 0.0) -> Change:
    """Return data of a sensor in another unit, with another sign or in other axes."""

    def changed(case: Case) -> Case:
        aided = _aided(case, name)
        samples = aided.log.aiding[name]
        by = factor if isinstance(factor, np.ndarray) else factor * np.eye(samples.value.shape[1])
        own = replace(samples, value=samples.value @ by.T + offset)
        return replace(aided, log=replace(aided.log, aiding={**aided.log.aiding, name: own}))

    return changed


def _off(sensor: AidingSensor) -> AidingSensor:
    assert sensor.point_world is not None
    return replace(sensor, point_world=sensor.point_world + np.array([8.0, -4.0, 0.0]))


def _mirrored(sensor: AidingSensor) -> AidingSensor:
    assert sensor.point_world is not None
    return replace(sensor, point_world=sensor.point_world * [-1.0, 1.0, 1.0])


def _too_exact(sensor: AidingSensor) -> AidingSensor:
    return replace(sensor, sigma=0.1 * sensor.sigma)


FLU = np.diag([1.0, -1.0, -1.0])  # axes forward, left, up in place of forward, right, down
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_UNITS, _POINT = ("aiding_units",), ("aiding_point",)
_LEVER, _CLOCK = ("aiding_lever_arm",), ("aiding_clock",)
_LEVER_OR_OFFSET = ("aiding_lever_arm", "aiding_offset")  # of one attitude they are one

MISTAKES = (
    Mistake("aiding_as_declared", "aiding", _aided, harmless=True),
    Mistake("velocity_scale_5pct", "aiding", _declared("visual", _scaled), ("aiding_scale",), REST),
    Mistake("velocity_lever_20cm", "aiding", _declared("visual", _levered), _LEVER, REST),
    Mistake(
        "velocity_turned_3deg", "aiding", _declared("visual", _rotated), ("aiding_mounting",), REST
    ),
    Mistake("velocity_clock_200ms", "aiding", _declared("visual", _late), _CLOCK, REST),
    Mistake("velocity_outliers", "aiding", _outliers("visual", 1.0), harmless=True),
    Mistake("range_lever_20cm", "aiding", _declared("anchor", _levered), _LEVER_OR_OFFSET),
    Mistake("range_clock_200ms", "aiding", _declared("anchor", _late), _CLOCK, REST),
    Mistake("range_outliers", "aiding", _outliers("anchor", 3.0), harmless=True),
    Mistake("position_lever_20cm", "aiding", _declared("prism", _levered), _LEVER),
    Mistake("position_clock_200ms", "aiding", _declared("prism", _late), _CLOCK, REST),
    Mistake("position_outliers", "aiding", _outliers("prism", 2.0), harmless=True),
    Mistake("height_lever_20cm", "aiding", _declared("level", _levered), _LEVER_OR_OFFSET),
    Mistake("height_clock_200ms", "aiding", _declared("level", _late), _CLOCK, REST),
    Mistake("height_outliers", "aiding", _outliers("level", 2.0), harmless=True),
    Mistake("heading_turned_3deg", "aiding", _declared("compass", _offset), ("aiding_offset",)),
    Mistake("heading_clock_200ms", "aiding", _declared("compass", _late), _CLOCK, REST),
    *(
        Mistake(f"relative_{kind}", "aiding", _declared("keyframes", change), (code,), REST)
        for kind, change, code in (
            ("scale_5pct", _scaled, "aiding_scale"),
            ("lever_20cm", _levered, "aiding_lever_arm"),
            ("turned_3deg", _rotated, "aiding_mounting"),
            ("clock_200ms", _late, "aiding_clock"),
        )
    ),
    Mistake("relative_outliers", "aiding", _outliers("keyframes", 0.3), harmless=True),
    Mistake("velocity_kmh", "aiding", _recorded("visual", 3.6), _UNITS, REST),
    Mistake("velocity_flu", "aiding", _recorded("visual", FLU), ("aiding_mounting",), REST),
    Mistake("range_mm", "aiding", _recorded("anchor", 1e3), _UNITS),
    Mistake("position_ned", "aiding", _recorded("prism", NED), ("aiding_mounting",)),
    Mistake("height_depth", "aiding", _recorded("level", -1.0), (*_UNITS, "aiding_offset")),
    Mistake(
        "heading_ccw", "aiding", _recorded("compass", -1.0, 90 * DEGREE), (*_UNITS, "aiding_offset")
    ),
    Mistake("heading_rad", "aiding", _recorded("compass", DEGREE), (*_UNITS, "aiding_offset")),
    Mistake("range_point_9m", "aiding", _declared("anchor", _off), _POINT),
    Mistake("range_point_mirrored", "aiding", _declared("anchor", _mirrored), _POINT),
    Mistake("range_noise_tenth", "aiding", _declared("anchor", _too_exact), ("aiding_noise",)),
    Mistake("heading_outliers", "aiding", _outliers("compass", 90.0 * DEGREE), harmless=True),
)
