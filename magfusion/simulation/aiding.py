"""Records of aiding sensors on a moving body."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.aiding import MAX_INTERVAL, AidingSamples, AidingSensor, Quantity
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


def _relative_pose(motion: SimulatedMotion, sensor: AidingSensor, time: Array) -> Array:
    """Return what it did in the period before: translation and rotation vector."""
    before = time - _interval(sensor)
    mounting = Rotation.from_matrix(sensor.body_from_sensor)
    first, second = (motion.world_from_body(at) * mounting for at in (before, time))
    way = _point_world(motion, sensor, time) - _point_world(motion, sensor, before)
    return np.hstack([first.inv().apply(way), (first.inv() * second).as_rotvec()])


def _interval(sensor: AidingSensor) -> float:
    return min(1.0 / sensor.rate_hz, MAX_INTERVAL)


IDEAL: dict[Quantity, Ideal] = {
    "velocity": _velocity,
    "range": _range,
    "position": _point_world,
    "height": _height,
    "pressure": _height,
    "heading": _heading,
    "relative_pose": _relative_pose,
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
    if sensor.quantity == "relative_pose":
        return _noisy_poses(sensor, time, ideal, rng)
    walk = sensor.offset_walk / np.sqrt(HOUR * sensor.rate_hz)
    offset = sensor.offset + np.cumsum(walk * rng.standard_normal(len(time)))
    speed = np.sqrt(np.nansum(ideal**2, axis=1, keepdims=True))
    share = sensor.relative_sigma if sensor.quantity == "velocity" else 0.0
    noise = np.hypot(sensor.sigma, share * speed) * rng.standard_normal(ideal.shape)
    value = sensor.scale * ideal + offset[:, None] + noise
    own = sensor.quantity == "position"
    recorded = value @ sensor.world_from_sensor if own else value
    return AidingSamples(sensor.quantity, time, recorded / sensor.unit)


def _noisy_poses(
    sensor: AidingSensor, time: Array, ideal: Array, rng: np.random.Generator
) -> AidingSamples:
    way = np.linalg.norm(ideal[:, :3], axis=1, keepdims=True)
    noise = rng.standard_normal(ideal.shape)
    sigma = np.hypot(sensor.sigma, sensor.relative_sigma * way)
    translation = sensor.scale * ideal[:, :3] + sigma * noise[:, :3]
    error = Rotation.from_rotvec(sensor.rotation_sigma * noise[:, 3:])
    turn = (Rotation.from_rotvec(ideal[:, 3:]) * error).as_rotvec()
    interval = np.full((len(time), 1), _interval(sensor))
    recorded = np.hstack([interval, translation / sensor.unit, turn])
    return AidingSamples(sensor.quantity, time, recorded)
