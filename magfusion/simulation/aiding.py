"""Records of aiding sensors on a moving body."""

from collections.abc import Callable

import numpy as np

from magfusion.model.aiding import AidingSamples, AidingSensor, Quantity
from magfusion.model.site import Site
from magfusion.simulation.motion import SimulatedMotion
from magfusion.units import HOUR, Array

Ideal = Callable[[SimulatedMotion, AidingSensor, Array], Array]


def _point_world(motion: SimulatedMotion, sensor: AidingSensor, time: Array) -> Array:
    lever_world = motion.world_from_body(time).apply(sensor.position_body)
    return motion.position_world(time) + lever_world


def _velocity(motion: SimulatedMotion, sensor: AidingSensor, time: Array) -> Array:
    turning = np.cross(motion.rate_body(time), sensor.position_body)
    body = motion.world_from_body(time).inv().apply(motion.velocity_world(time)) + turning
    velocity = body @ sensor.body_from_sensor
    if sensor.constraint_sigma is not None:  # wheels measure along themselves
        velocity[:, 1:] = np.nan
    return velocity


def _range(motion: SimulatedMotion, sensor: AidingSensor, time: Array) -> Array:
    assert sensor.point_world is not None
    away = _point_world(motion, sensor, time) - sensor.point_world
    return np.linalg.norm(away, axis=1, keepdims=True)


def _height(motion: SimulatedMotion, sensor: AidingSensor, time: Array) -> Array:
    return _point_world(motion, sensor, time)[:, 2:]


def _heading(motion: SimulatedMotion, _: AidingSensor, time: Array) -> Array:
    forward = motion.world_from_body(time).apply([1.0, 0.0, 0.0])
    return np.arctan2(forward[:, :1], forward[:, 1:2])


IDEAL: dict[Quantity, Ideal] = {
    "velocity": _velocity,
    "range": _range,
    "position": _point_world,
    "height": _height,
    "pressure": _height,
    "heading": _heading,
}


def simulate_aiding(
    motion: SimulatedMotion, site: Site, duration: float, rng: np.random.Generator
) -> dict[str, AidingSamples]:
    """Return the record of each aiding sensor of the true site, at its own rate.

    A mark has none: a platform that moves at random is on no mark.
    """
    return {
        sensor.name: _record(motion, sensor, duration, own)
        for sensor, own in zip(site.aiding, rng.spawn(len(site.aiding)), strict=True)
        if sensor.quantity != "mark"
    }


def _record(
    motion: SimulatedMotion, sensor: AidingSensor, duration: float, rng: np.random.Generator
) -> AidingSamples:
    time = np.arange(1.0, duration * sensor.rate_hz) / sensor.rate_hz
    ideal = IDEAL[sensor.quantity](motion, sensor, time + sensor.time_offset)
    walk = sensor.offset_walk / np.sqrt(HOUR * sensor.rate_hz)
    offset = sensor.offset + np.cumsum(walk * rng.standard_normal(len(time)))
    speed = np.sqrt(np.nansum(ideal**2, axis=1, keepdims=True))
    share = sensor.relative_sigma if sensor.quantity == "velocity" else 0.0
    noise = np.hypot(sensor.sigma, share * speed) * rng.standard_normal(ideal.shape)
    value = sensor.scale * ideal + offset[:, None] + noise
    return AidingSamples(sensor.quantity, time, value)
