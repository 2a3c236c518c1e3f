"""Messages of ROS, 1 and 2, as rows of numbers."""

from collections.abc import Callable, Sequence
from operator import attrgetter
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

Row = Callable[[Any], Sequence[float]]


def components(*paths: str) -> Row:
    """Return how a message becomes numbers: ``twist.linear.xyz`` are three of them."""
    parts = (path.rpartition(".") for path in paths)
    return attrgetter(*(f"{stem}.{axis}" for stem, _, axes in parts for axis in axes))


pose_row = components("pose.position.xyz", "pose.orientation.xyzw")
_SURE_POSE = ("pose.pose.position.xyz", "pose.pose.orientation.xyzw")
sure_pose_row = components(*_SURE_POSE)
odometry_row = components(*_SURE_POSE, "twist.twist.linear.xyz")
transform_row = components("transform.translation.xyz", "transform.rotation.xyzw")
# By role and type: a pose's quaternion has x first; of an odometry the velocity follows, in body
# axes.
ROWS: dict[str, dict[str, Row]] = {
    "imu": {IMU: components("angular_velocity.xyz", "linear_acceleration.xyz")},
    "magnetometer": {FIELD: components("magnetic_field.xyz")},
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
