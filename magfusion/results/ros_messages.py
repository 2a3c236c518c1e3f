"""Messages of ROS 2 and their parts, as ROS sends them by DDS: field by field.

No ROS code is used: on the wire a message is its fields in this order, and its name.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, float64, int8, int32, uint8, uint16, uint32

if TYPE_CHECKING:
    Covariance = list[float]
    AxesCovariance = list[float]
else:
    Covariance = array[float64, 36]
    AxesCovariance = array[float64, 9]


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    """Seconds and nanoseconds since 1970."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    """Time stamp and frame."""

    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    """A place (m)."""

    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    """An attitude, w last."""

    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    """Place and attitude."""

    position: Point
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.PoseWithCovariance_"):
    """A pose, and the covariance of position and rotation about fixed axes, row by row."""

    pose: Pose
    covariance: Covariance


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    """A free vector."""

    x: float64
    y: float64
    z: float64


@dataclass
class Twist(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    """Velocity (m/s) and rate of turning (rad/s)."""

    linear: Vector3
    angular: Vector3


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.TwistWithCovariance_"):
    """A twist and its covariance, row by row."""

    twist: Twist
    covariance: Covariance


@dataclass
class OdometryMessage(IdlStruct, typename="nav_msgs.msg.dds_.Odometry_"):
    """Pose in the header's frame, twist in the child's."""

    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@dataclass
class ImuMessage(IdlStruct, typename="sensor_msgs.msg.dds_.Imu_"):
    """Attitude, rate of rotation (rad/s) and specific force (m/s^2) of an IMU."""

    header: Header
    orientation: Quaternion
    orientation_covariance: AxesCovariance
    angular_velocity: Vector3
    angular_velocity_covariance: AxesCovariance
    linear_acceleration: Vector3
    linear_acceleration_covariance: AxesCovariance


@dataclass
class MagneticFieldMessage(IdlStruct, typename="sensor_msgs.msg.dds_.MagneticField_"):
    """Field of a magnetometer (T)."""

    header: Header
    magnetic_field: Vector3
    magnetic_field_covariance: AxesCovariance


@dataclass
class TwistWithCovarianceStampedMessage(
    IdlStruct, typename="geometry_msgs.msg.dds_.TwistWithCovarianceStamped_"
):
    """Velocity of a visual or laser odometry."""

    header: Header
    twist: TwistWithCovariance


@dataclass
class PoseStampedMessage(IdlStruct, typename="geometry_msgs.msg.dds_.PoseStamped_"):
    """Pose in the header's frame."""

    header: Header
    pose: Pose


@dataclass
class RangeMessage(IdlStruct, typename="sensor_msgs.msg.dds_.Range_"):
    """Distance (m)."""

    header: Header
    radiation_type: uint8
    field_of_view: float32
    min_range: float32
    max_range: float32
    range: float32


@dataclass
class FluidPressureMessage(IdlStruct, typename="sensor_msgs.msg.dds_.FluidPressure_"):
    """Pressure of air or water (Pa)."""

    header: Header
    fluid_pressure: float64
    variance: float64


@dataclass
class NavSatStatus(IdlStruct, typename="sensor_msgs.msg.dds_.NavSatStatus_"):
    """Kind of a fix, below zero if there is none, and the systems that took part."""

    status: int8
    service: uint16


@dataclass
class NavSatFixMessage(IdlStruct, typename="sensor_msgs.msg.dds_.NavSatFix_"):
    """Latitude and longitude (degrees), and height above the ellipsoid WGS84 (m)."""

    header: Header
    status: NavSatStatus
    latitude: float64
    longitude: float64
    altitude: float64
    position_covariance: AxesCovariance
    position_covariance_type: uint8
