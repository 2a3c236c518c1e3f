"""Bags of ROS 1 and 2 with known samples, for tests of their import."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

START_NS = 1_403_636_579_758_555_392  # EuRoC V1_01's own
N = 40
STEP_NS = 5_000_000

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE_1 = get_typestore(Stores.ROS1_NOETIC)
IMU = "sensor_msgs/msg/Imu"
FIELD = "sensor_msgs/msg/MagneticField"
POSE = "geometry_msgs/msg/PoseStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
STAMPS = START_NS + STEP_NS * np.arange(N)

_rng = np.random.default_rng(1)
GYRO = _rng.standard_normal((N, 3))
ACCEL = np.array([0.0, 0.0, 9.81]) + 0.1 * _rng.standard_normal((N, 3))
MEASURED = np.array([2e-5, 0.0, -4e-5]) + 1e-6 * _rng.standard_normal((N, 3))
POSITION = _rng.standard_normal((N, 3))
ROTATION = Rotation.random(N, random_state=_rng)
VELOCITY_BODY = _rng.standard_normal((N, 3))
BIASES = 0.01 * _rng.standard_normal((N, 6))


def header(stamp: int) -> Any:
    time = STORE.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return STORE.types["std_msgs/msg/Header"](time, "base")


def xyz(msgtype: str, values: np.ndarray) -> Any:
    return STORE.types[f"geometry_msgs/msg/{msgtype}"](*map(float, values))


def _pose(k: int) -> Any:
    quaternion = xyz("Quaternion", ROTATION[k].as_quat())
    return STORE.types["geometry_msgs/msg/Pose"](xyz("Point", POSITION[k]), quaternion)


def imu_message(k: int, absent: float = 0.0) -> Any:
    cov = np.zeros(9)
    return STORE.types[IMU](
        header(int(STAMPS[k])),
        xyz("Quaternion", np.array([0, 0, 0, 1])),
        cov,
        xyz("Vector3", GYRO[k]),
        np.full(9, absent),
        xyz("Vector3", ACCEL[k]),
        cov,
    )


def field_message(k: int) -> Any:
    return STORE.types[FIELD](header(int(STAMPS[k])), xyz("Vector3", MEASURED[k]), np.zeros(9))


def pose_message(k: int) -> Any:
    return STORE.types[POSE](header(int(STAMPS[k])), _pose(k))


def odometry_message(k: int, moving: float = 1.0) -> Any:
    twist = STORE.types["geometry_msgs/msg/Twist"](
        xyz("Vector3", moving * VELOCITY_BODY[k]), xyz("Vector3", np.zeros(3))
    )
    return STORE.types[ODOMETRY](
        header(int(STAMPS[k])),
        "imu",
        STORE.types["geometry_msgs/msg/PoseWithCovariance"](_pose(k), np.zeros(36)),
        STORE.types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
    )


Make = Callable[[int], Any]
SENSORS: dict[str, tuple[str, Make]] = {
    "/imu/data": (IMU, imu_message),
    "/imu/mag": (FIELD, field_message),
}


def write_bag(
    path: Path,
    topics: dict[str, tuple[str, Make]],
    plugin: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode | None = None,
    arrival: np.ndarray | None = None,
    samples: range = range(N),
) -> Path:
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    order = np.array(samples) if arrival is None else arrival
    with writer:
        for name, (msgtype, make) in topics.items():
            connection = writer.add_connection(name, msgtype, typestore=STORE)
            for received, k in enumerate(order, samples.start):
                raw = STORE.serialize_cdr(make(int(k)), msgtype)
                # Received late, and on another clock than the headers'.
                writer.write(connection, 10**9 + STEP_NS * received, raw)
    return path


def _of_ros1(k: int, message: Any) -> Any:
    """Return a message of ROS 2, header first, as ROS 1 has it: the header is numbered."""
    types, kind = STORE_1.types, message.__msgtype__
    stamp = message.header.stamp
    head = types["std_msgs/msg/Header"](
        k, types["builtin_interfaces/msg/Time"](stamp.sec, stamp.nanosec), "base"
    )
    names = [name for name in types[kind].__dataclass_fields__ if name != "__msgtype__"]
    return types[kind](head, *(getattr(message, name) for name in names[1:]))


def write_ros1_bag(
    path: Path, topics: dict[str, tuple[str, Make]], samples: range = range(N)
) -> Path:
    with Writer1(path) as writer:
        for name, (msgtype, make) in topics.items():
            connection = writer.add_connection(name, msgtype, typestore=STORE_1)
            for k in samples:
                raw = STORE_1.serialize_ros1(_of_ros1(k, make(k)), msgtype)
                writer.write(connection, int(STAMPS[k]), raw)
    return path
