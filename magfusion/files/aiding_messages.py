"""Messages of ROS that aiding sensors send, as samples of what these measure."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.messages import (
    ODOMETRY,
    POSE,
    POSE_WITH_COVARIANCE,
    Row,
    components,
    odometry_row,
    pose_row,
    sure_pose_row,
)
from magfusion.model.aiding import MAX_INTERVAL, AidingSensor, Quantity
from magfusion.model.physics.earth import east_north_up
from magfusion.units import Array

NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
POSE_COLUMNS = 7  # position and quaternion; a twist follows
MIN_QUATERNION = 0.5  # an attitude that was left unfilled is zero
MAX_STEP = 2.0  # periods of the sensor's rate between poses whose difference is a sample


def _fix_row(sensor: AidingSensor, message: Any) -> list[float]:
    if sensor.origin is None:
        raise InputError(
            f"{sensor.name}: {NAV_SAT_FIX} gives latitudes; add the origin of the world to the"
            " sensor in the site's aiding: origin: {latitude_deg, longitude_deg, height_m}."
        )
    if message.status.status < 0:  # no fix
        return [np.nan] * 3
    place = message.latitude, message.longitude, message.altitude
    return [float(x) for x in east_north_up(*place, sensor.origin)]


_ROWS: Mapping[Quantity, Mapping[str, Row]] = {
    "velocity": {
        ODOMETRY: odometry_row,
        "geometry_msgs/msg/TwistWithCovarianceStamped": components("twist.twist.linear.xyz"),
        "geometry_msgs/msg/TwistStamped": components("twist.linear.xyz"),
        POSE: pose_row,
        POSE_WITH_COVARIANCE: sure_pose_row,
    },
    "relative_pose": {ODOMETRY: odometry_row, POSE: pose_row, POSE_WITH_COVARIANCE: sure_pose_row},
    "range": {"sensor_msgs/msg/Range": lambda message: [message.range]},
    "position": {
        ODOMETRY: components("pose.pose.position.xyz"),
        POSE: components("pose.position.xyz"),
        POSE_WITH_COVARIANCE: components("pose.pose.position.xyz"),
        "geometry_msgs/msg/PointStamped": components("point.xyz"),
    },
    "height": {POSE: lambda message: [message.pose.position.z]},
    "pressure": {"sensor_msgs/msg/FluidPressure": lambda message: [message.fluid_pressure]},
}


def aiding_rows(sensor: AidingSensor) -> dict[str, Row]:
    """Return how messages become numbers, by the types that a sensor may send."""
    rows = dict(_ROWS.get(sensor.quantity, {}))
    if sensor.quantity == "position":
        rows[NAV_SAT_FIX] = partial(_fix_row, sensor)
    return rows


class SensorMessages:
    """Converts the messages of one sensor, in the order of their stamps, to samples.

    Attribute `without_value`: messages left out so far.
    """

    def __init__(self, sensor: AidingSensor) -> None:
        self._sensor, self._last = sensor, np.zeros((0, 1 + POSE_COLUMNS))
        self.without_value = 0

    def samples(self, time: Array, rows: Array) -> tuple[Array, Array]:
        """Return times (s) and values of messages; those without a value are left out.

        A velocity without a twist is that of the poses' differences, in the middle of each; a
        relative pose is such a difference. `time` (n,). `rows` (n, columns): as of `aiding_rows`.
        """
        there = ~np.isnan(rows).any(axis=1)
        self.without_value += int(np.sum(~there))
        time, rows = time[there], rows[there]
        relative = self._sensor.quantity == "relative_pose"
        if not (relative or self._sensor.quantity == "velocity") or rows.shape[1] < POSE_COLUMNS:
            return time, rows
        twist = rows[:, POSE_COLUMNS:]
        if twist.any() and not relative:
            return time, twist
        poses = np.hstack([time[:, None], rows[:, :POSE_COLUMNS]])
        return self._differences(np.concatenate([self._last, poses]))

    def _differences(self, poses: Array) -> tuple[Array, Array]:
        """Return what moves poses (n, 8) in their axes, the first of each period of the rate."""
        rate = self._sensor.rate_hz
        poses = poses[np.linalg.norm(poses[:, 4:], axis=1) > MIN_QUATERNION]
        period = np.floor(poses[:, 0] * rate * (1.0 + 1e-9))
        poses = poses[np.diff(period, prepend=-np.inf) > 0.0]
        self._last = poses[-1:]
        step, attitude = np.diff(poses[:, 0]), Rotation.from_quat(poses[:, 4:])
        near = step <= MAX_STEP / rate
        first, second = attitude[:-1], attitude[1:]
        way, turn = np.diff(poses[:, 1:4], axis=0), (first.inv() * second).as_rotvec()
        if self._sensor.quantity == "relative_pose":
            near &= step <= MAX_INTERVAL
            moved = np.hstack([step[:, None], first.inv().apply(way), turn])
            return poses[1:, 0][near], moved[near]
        middle = first * Rotation.from_rotvec(0.5 * turn)
        velocity = middle.inv().apply(way / step[:, None])
        return (poses[:-1, 0] + 0.5 * step)[near], velocity[near]
