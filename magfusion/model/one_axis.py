"""Receiver of one axis: direction and position of its coil, and the unobservable roll.

Without an IMU the roll about the coil is unobservable.  The estimators then follow a frame that
does not rotate about the coil, equivalent to any roll of the platform.  Their covariance is widened
to any roll, and with it the position of the body on its circle about the coil.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.platform_motion import NO_IMU
from magfusion.model.site import Magnetometer, Site
from magfusion.units import Array

ANY_ROLL = np.pi / np.sqrt(3.0)  # rad; standard deviation of a uniformly distributed angle
CIRCLE = 1.5  # of a lever's square, for a position on a circle about the coil, not on its tangent


def axis_of(sensor: Magnetometer) -> Array:
    """Return the sensitive direction of a magnetometer of one axis, body axes, shape (3,)."""
    affected = sensor.body_from_sensor @ sensor.matrix["xyz".index(sensor.axes)]
    return np.asarray(affected / np.linalg.norm(affected))


def coil_lever(sensor: Magnetometer) -> Array:
    """Return the position of its coil, body axes, shape (3,) (m)."""
    if sensor.coil_centres_sensor is None:
        return sensor.position_body
    own = sensor.coil_centres_sensor["xyz".index(sensor.axes)]
    return np.asarray(sensor.position_body + sensor.body_from_sensor @ own)


def least_turn(from_vector: Array, to_vector: Array) -> Array:
    """Return the smallest rotations between pairs of directions, shape (..., 3, 3)."""
    start = np.broadcast_to(from_vector, to_vector.shape)
    across = np.cross(start, to_vector)
    sine = np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.arctan2(sine, np.sum(start * to_vector, axis=-1, keepdims=True))
    smallest = np.eye(3)[np.argmin(np.abs(start), axis=-1)]
    other = np.cross(start, smallest)  # any perpendicular axis, for the opposite direction
    other = other / np.linalg.norm(other, axis=-1, keepdims=True)
    about = np.where(sine > 1e-12, across / np.maximum(sine, 1e-300), other)
    return Rotation.from_rotvec(about * angle).as_matrix()


def roll_is_open(site: Site) -> bool:
    """Return whether neither fields nor an IMU determine the roll about the single axis."""
    platform = site.platform
    one = not platform.further and len(platform.magnetometer.axes) == 1
    return one and (platform.imu == NO_IMU or not platform.inertial)


def opened_poses(site: Site, pose_cov: Array) -> Array:
    """Add any roll about the coil to covariances of poses (..., 6, 6), body axes."""
    sensor = site.platform.magnetometer
    axis, lever = axis_of(sensor), coil_lever(sensor)
    along = np.concatenate([axis, np.cross(lever, axis)])
    out = pose_cov + ANY_ROLL**2 * np.outer(along, along)
    across = lever - (lever @ axis) * axis
    out[..., 3:6, 3:6] += CIRCLE * np.outer(across, across)
    return np.asarray(out)


def opened_state(
    site: Site, cov: Array, world_from_body: Array, gyro_bias_body: Array, rate_sigma: float
) -> Array:
    """Add any roll about the coil to the covariance of a state's tangent.

    `cov` (k, k): pose (body axes), velocity (world), accelerometer and gyro bias, calibration.
    `gyro_bias_body` (3,): negative rate of a motion prior (rad/s). `rate_sigma`: of the rate about
    the coil (rad/s).
    """
    sensor = site.platform.magnetometer
    axis, lever = axis_of(sensor), coil_lever(sensor)
    # The rate rotates with the roll, in body axes; about the coil it has the prior's spread.
    rolled, spun = np.zeros(len(cov)), np.zeros(len(cov))
    swing, rate = np.cross(axis, lever), -gyro_bias_body
    rolled[6:9] = -world_from_body @ np.cross(rate, swing)
    rolled[12:15] = np.cross(axis, rate)
    rolled[:6] = np.concatenate([axis, -swing])
    spun[6:9], spun[12:15] = -world_from_body @ swing, -axis
    out = cov.copy()
    out[:6, :6] = opened_poses(site, cov[:6, :6])
    pose = np.zeros_like(rolled)
    pose[:6] = rolled[:6]
    out += ANY_ROLL**2 * (np.outer(rolled, rolled) - np.outer(pose, pose))
    out += rate_sigma**2 * np.outer(spun, spun)
    return np.asarray(out)
