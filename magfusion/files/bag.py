"""Import of ROS 2 bags, SQLite or MCAP, without ROS."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.plausible import check_field, check_imu
from magfusion.files.table import LARGEST_NUMBER, LARGEST_TIME_NS, Span
from magfusion.files.trajectory_table import QUATERNION_TOLERANCE
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, IntArray

BAG_SUFFIXES = (".mcap", ".db3")
_IMU = "sensor_msgs/msg/Imu"
_FIELD = "sensor_msgs/msg/MagneticField"
_ODOMETRY = "nav_msgs/msg/Odometry"
_POSE = "geometry_msgs/msg/PoseStamped"


@dataclass(frozen=True)
class Topics:
    """Names of the topics to read; None takes the only one of the type."""

    imu: str | None = None
    magnetometer: str | None = None
    truth: str | None = None


@dataclass(frozen=True, eq=False)
class _Stream:
    """Messages of one topic as numbers, sorted by the stamps of their headers."""

    place: str
    msgtype: str
    time_ns: IntArray
    values: Array

    def within(self, span: Span) -> "_Stream":
        begin, end = np.searchsorted(self.time_ns, span.bounds_ns)
        return _Stream(self.place, self.msgtype, self.time_ns[begin:end], self.values[begin:end])


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS 2 bag: a directory with its metadata, or a single file."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix in BAG_SUFFIXES


def read_bag(
    path: Path, start: float | None = None, end: float | None = None, topics: Topics | None = None
) -> Log:
    """Read inertial samples, magnetometer and truth of a ROS 2 bag.

    Times are those of the messages' headers, and the first inertial one is the log's epoch. Poses
    are taken for those of the IMU's axes in the world; the twist of an odometry is in body axes.

    Parameters
    ----------
    path : Path
        Directory of a bag, or its file (``.mcap``, ``.db3``).
    start, end : float, optional
        Seconds since the first inertial sample.

    Returns
    -------
    Log
        Without the streams for which the bag has no topic.

    Raises
    ------
    InputError
        Where the bag cannot be read, has no inertial topic or several topics of one kind of which
        none was named, or holds messages that no instrument gives.
    """
    chosen = topics or Topics()
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            imu = _read(reader, path, chosen.imu, "imu", {_IMU: _imu_row})
            field = _read(reader, path, chosen.magnetometer, "magnetometer", {_FIELD: _field_row})
            poses: dict[str, _Row] = {_ODOMETRY: _odometry_row, _POSE: _pose_row}
            truth = _read(reader, path, chosen.truth, "truth", poses)
    except InputError:
        raise
    except Exception as error:  # a damaged bag makes the library fail in any way whatever
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: cannot be read ({reason}); record the bag again.") from error
    if imu is None:
        raise InputError(f"{path}: holds no messages of {_IMU}; record the inertial sensor.")
    span = Span(int(imu.time_ns[0]), start, end)
    return Log(
        name=path.resolve().stem,
        epoch_ns=span.epoch_ns,
        source="ROS 2 bag: " + ", ".join(s.place for s in (imu, field, truth) if s is not None),
        imu=_imu(imu.within(span), span),
        waveform=None if field is None else _waveform(field.within(span), span),
        truth=None if truth is None else _trajectory(truth.within(span), span),
    )


_Row = Callable[[Any], list[float]]


def _read(
    reader: AnyReader, path: Path, topic: str | None, role: str, rows: dict[str, _Row]
) -> _Stream | None:
    connections = _chosen(reader, path, topic, role, tuple(rows))
    if not connections:
        return None
    name, msgtype = connections[0].topic, connections[0].msgtype
    place, row = f"{path} topic {name}", rows[msgtype]
    stamps, values = [], []
    for _, _, raw in reader.messages(connections):
        message: Any = reader.deserialize(raw, msgtype)
        _refuse_absent(message, place)
        stamps.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
        values.append(row(message))
    if not stamps:
        raise InputError(f"{place}: holds no messages; record it, or leave it out.")
    return _sorted(place, msgtype, np.array(stamps), np.array(values, dtype=np.float64))


def _chosen(
    reader: AnyReader, path: Path, topic: str | None, role: str, msgtypes: tuple[str, ...]
) -> list[Connection]:
    """Return the connections of the one topic that plays a role."""
    fitting = [c for c in reader.connections if c.msgtype in msgtypes]
    names = sorted({c.topic for c in fitting})
    if topic is None and len(names) > 1:
        raise InputError(
            f"{path}: has several topics for {role}: {', '.join(names)};"
            f" name one by --topics {role}=... (in Python, by Topics), or keep one in the bag."
        )
    if topic is not None and topic not in names:
        found = ", ".join(names) or "none"
        raise InputError(
            f"{path}: has no topic {topic} of {' or '.join(msgtypes)} for {role} (found {found});"
            " name another."
        )
    connections = [c for c in fitting if topic in (None, c.topic)]
    if len({c.msgtype for c in connections}) > 1:
        raise InputError(f"{path}: topic {names[0]} has several types; record it with one.")
    return connections


def _sorted(place: str, msgtype: str, stamps: IntArray, values: Array) -> _Stream:
    # A bag keeps the order of arrival, which the network may have changed.
    order = np.argsort(stamps, kind="stable")
    stamps, values = stamps[order], values[order]
    bad = ~(np.abs(values) < LARGEST_NUMBER).all(axis=1)
    repeated = np.diff(stamps, prepend=-LARGEST_TIME_NS) == 0
    for wrong, remedy in (
        (bad, "holds a number that is not finite; remove the message"),
        (repeated, "has the stamp of another; stamp each message with its own time"),
    ):
        if wrong.any():
            stamp = stamps[np.argmax(wrong)]
            raise InputError(f"{place}: the message stamped {stamp} ns {remedy}.")
    return _Stream(place, msgtype, stamps, values)


def _refuse_absent(message: Any, place: str) -> None:
    """Refuse what the publisher marked as not measured (sensor_msgs/Imu: covariance of -1)."""
    for part in ("angular_velocity", "linear_acceleration"):
        cov = getattr(message, f"{part}_covariance", None)
        if cov is not None and cov[0] == -1.0:
            raise InputError(f"{place}: {part} is marked as not measured; record a full IMU.")


def _vector(value: Any) -> list[float]:
    return [value.x, value.y, value.z]


def _imu_row(message: Any) -> list[float]:
    return _vector(message.angular_velocity) + _vector(message.linear_acceleration)


def _field_row(message: Any) -> list[float]:
    return _vector(message.magnetic_field)


def _pose_row(message: Any) -> list[float]:
    pose = message.pose
    return [*_vector(pose.position), *_vector(pose.orientation), pose.orientation.w]


def _odometry_row(message: Any) -> list[float]:
    return _pose_row(message.pose) + _vector(message.twist.twist.linear)


def _imu(stream: _Stream, span: Span) -> ImuSamples:
    if not len(stream.time_ns):
        raise InputError(f"{stream.place}: holds no message {span}; choose another span.")
    time = span.seconds(stream.time_ns)
    imu = ImuSamples(time, stream.values[:, :3].copy(), stream.values[:, 3:].copy())
    check_imu(imu, stream.place)
    return imu


def _waveform(stream: _Stream, span: Span) -> Waveform | None:
    check_field(np.linalg.norm(stream.values, axis=1), stream.place)
    return Waveform(span.seconds(stream.time_ns), stream.values) if len(stream.values) else None


def _trajectory(stream: _Stream, span: Span) -> Trajectory | None:
    if not len(stream.values):
        return None
    quaternion = stream.values[:, 3:7]
    length = np.linalg.norm(quaternion, axis=1)
    off = np.abs(length - 1.0) > QUATERNION_TOLERANCE
    if off.any():
        k = int(np.argmax(off))
        raise InputError(
            f"{stream.place}: the message stamped {stream.time_ns[k]} ns has a quaternion of"
            f" length {length[k]:.6g}; write one of length 1."
        )
    rotation = Rotation.from_quat(quaternion)
    velocity = stream.values[:, 7:]
    return Trajectory(
        time=span.seconds(stream.time_ns),
        world_from_body=rotation.as_matrix(),
        position_world=stream.values[:, :3].copy(),
        # Many publishers of odometry leave the twist unfilled.
        velocity_world=rotation.apply(velocity) if velocity.any() else None,
    )
