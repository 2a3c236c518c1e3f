"""Messages of ROS, 1 and 2, as rows of numbers."""

from collections.abc import Callable
from typing import Any

from magfusion.errors import InputError
from magfusion.model.aiding import Quantity

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


def _vector(value: Any) -> list[float]:
    return [value.x, value.y, value.z]


def _imu_row(message: Any) -> list[float]:
    return _vector(message.angular_velocity) + _vector(message.linear_acceleration)


def _field_row(message: Any) -> list[float]:
    return _vector(message.magnetic_field)


def _pose(pose: Any) -> list[float]:
    return [*_vector(pose.position), *_vector(pose.orientation), pose.orientation.w]


def _pose_row(message: Any) -> list[float]:
    return _pose(message.pose)


def _sure_pose_row(message: Any) -> list[float]:
    return _pose(message.pose.pose)


def _odometry_row(message: Any) -> list[float]:
    return _pose(message.pose.pose) + _vector(message.twist.twist.linear)


def transform_row(message: Any) -> list[float]:
    """Return translation and quaternion, x first, of a stamped transform."""
    turn = message.transform.rotation
    return [*_vector(message.transform.translation), *_vector(turn), turn.w]


# By role and type: a pose's quaternion has x first; of an odometry the velocity follows, in body
# axes.
ROWS: dict[str, dict[str, Row]] = {
    "imu": {IMU: _imu_row},
    "magnetometer": {FIELD: _field_row},
    "truth": {
        ODOMETRY: _odometry_row,
        POSE: _pose_row,
        POSE_WITH_COVARIANCE: _sure_pose_row,
        TRANSFORM: transform_row,
    },
}


def _sure_twist_row(message: Any) -> list[float]:
    return _vector(message.twist.twist.linear)


def _twist_row(message: Any) -> list[float]:
    return _vector(message.twist.linear)


def _position_row(message: Any) -> list[float]:
    return _vector(message.pose.position)


def _sure_position_row(message: Any) -> list[float]:
    return _vector(message.pose.pose.position)


def _point_row(message: Any) -> list[float]:
    return _vector(message.point)


def _pose_height_row(message: Any) -> list[float]:
    return [message.pose.position.z]


def _range_row(message: Any) -> list[float]:
    return [message.range]


def _pressure_row(message: Any) -> list[float]:
    return [message.fluid_pressure]


# Of aiding sensors, by what they measure and type.
AIDING_ROWS: dict[Quantity, dict[str, Row]] = {
    "velocity": {
        ODOMETRY: _sure_twist_row,
        "geometry_msgs/msg/TwistWithCovarianceStamped": _sure_twist_row,
        "geometry_msgs/msg/TwistStamped": _twist_row,
    },
    "range": {"sensor_msgs/msg/Range": _range_row},
    "position": {
        ODOMETRY: _sure_position_row,
        POSE: _position_row,
        POSE_WITH_COVARIANCE: _sure_position_row,
        "geometry_msgs/msg/PointStamped": _point_row,
    },
    "height": {POSE: _pose_height_row},
    "pressure": {"sensor_msgs/msg/FluidPressure": _pressure_row},
}


def stamp_ns(header: Any) -> int:
    """Return the stamp of a header (ns)."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def refuse_absent(message: Any, place: str) -> None:
    """Refuse what the publisher marked as not measured (sensor_msgs/Imu: covariance of -1).

    Raises
    ------
    InputError
    """
    for part in ("angular_velocity", "linear_acceleration"):
        cov = getattr(message, f"{part}_covariance", None)
        if cov is not None and cov[0] == -1.0:
            raise InputError(f"{place}: {part} is marked as not measured; record a full IMU.")
