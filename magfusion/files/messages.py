"""Messages of ROS, 1 and 2, as rows of numbers."""

from collections.abc import Callable
from typing import Any

from magfusion.errors import InputError

IMU = "sensor_msgs/msg/Imu"
FIELD = "sensor_msgs/msg/MagneticField"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
USUAL = (IMU, FIELD, ODOMETRY, POSE)  # taken before others that play the same role
TRANSFORMS = "tf2_msgs/msg/TFMessage"
# ROS 1 had it in a package of its own before.
FORMER_TRANSFORMS = "tf/msg/tfMessage"

Row = Callable[[Any], list[float]]


def vector_row(value: Any) -> list[float]:
    """Return the components of a vector or point."""
    return [value.x, value.y, value.z]


def _imu_row(message: Any) -> list[float]:
    return vector_row(message.angular_velocity) + vector_row(message.linear_acceleration)


def _field_row(message: Any) -> list[float]:
    return vector_row(message.magnetic_field)


def _pose(pose: Any) -> list[float]:
    return [*vector_row(pose.position), *vector_row(pose.orientation), pose.orientation.w]


def pose_row(message: Any) -> list[float]:
    """Return position and quaternion, x first, of a stamped pose."""
    return _pose(message.pose)


def sure_pose_row(message: Any) -> list[float]:
    """Return the same of a pose with its covariance."""
    return _pose(message.pose.pose)


def odometry_row(message: Any) -> list[float]:
    """Return the same of an odometry, and its velocity in axes of its child frame."""
    return _pose(message.pose.pose) + vector_row(message.twist.twist.linear)


def transform_row(message: Any) -> list[float]:
    """Return translation and quaternion, x first, of a stamped transform."""
    turn = message.transform.rotation
    return [*vector_row(message.transform.translation), *vector_row(turn), turn.w]


# By role and type: a pose's quaternion has x first; of an odometry the velocity follows, in body
# axes.
ROWS: dict[str, dict[str, Row]] = {
    "imu": {IMU: _imu_row},
    "magnetometer": {FIELD: _field_row},
    "truth": {
        ODOMETRY: odometry_row,
        POSE: pose_row,
        POSE_WITH_COVARIANCE: sure_pose_row,
        TRANSFORM: transform_row,
    },
}


def stamp_ns(header: Any) -> int:
    """Return the stamp of a header (ns)."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def refuse_absent(message: Any, place: str) -> None:
    """Refuse what the publisher marked as not measured (sensor_msgs/Imu: covariance of -1)."""
    for part in ("angular_velocity", "linear_acceleration"):
        cov = getattr(message, f"{part}_covariance", None)
        if cov is not None and cov[0] == -1.0:
            raise InputError(f"{place}: {part} is marked as not measured; record a full IMU.")
