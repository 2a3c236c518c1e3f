"""Trajectories as ROS 2 bags, MCAP or SQLite, without ROS: odometry, and poses with covariance."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.result_states import ResultStates
from magfusion.model.fixed_axes import fixed_axes_covariance
from magfusion.model.trajectory import Trajectory
from magfusion.units import NS_PER_S, Array

ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped"
# ROS has no word for "not known", and who fuses takes a zero for certain.
UNKNOWN_VARIANCE = 1e6  # m^2, rad^2, and a second's of them
_LAST_STAMP = (1 << 31) * NS_PER_S  # of builtin_interfaces/Time, whose seconds have 31 bits
_STORAGES = {"mcap": StoragePlugin.MCAP, "db3": StoragePlugin.SQLITE3}


class Frames(NamedTuple):
    """Names of the frames, and the namespace of the topics."""

    world: str = "world"
    body: str = "body"
    namespace: str = "/magfusion"


def _pose_covariance(trajectory: Trajectory) -> Array:
    """Return covariances of poses, shape (n, 6, 6); `UNKNOWN_VARIANCE` where there are none."""
    if trajectory.pose_cov is None:
        return np.tile(UNKNOWN_VARIANCE * np.eye(6), (len(trajectory), 1, 1))
    return fixed_axes_covariance(trajectory.world_from_body, trajectory.pose_cov)


def write_bag(
    states: ResultStates,
    path: Path,
    form: Literal["mcap", "db3"],
    frames: Frames,
    report: Callable[[int], None],
) -> None:
    """Write ``odometry`` and ``pose`` below the namespace, in one file.

    Velocities are in body axes, as the child frame's are to be.  The rate of turning is no part of
    a result: it is zero with `UNKNOWN_VARIANCE`, and so is the variance of velocity. `report`:
    called from time to time with the number of states written. Raises InputError where a stamp is
    none of ROS.
    """
    stamps = states.stamp_ns
    wrong = stamps[(stamps < 0) | (stamps >= _LAST_STAMP)]
    if len(wrong):
        raise InputError(
            f"the stamp {wrong[0]} ns is none that ROS can write (1970 to 2038); give the log an"
            " epoch_ns of its date, or export csv"
        )
    store = get_typestore(Stores.ROS2_HUMBLE)
    # The library writes a directory, of which the one file is wanted, with a name of its own.
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".bag-") as place:
        bag = Path(place) / "bag"
        with Writer(bag, version=9, storage_plugin=_STORAGES[form]) as writer:
            topics = [
                writer.add_connection(f"{frames.namespace}/{name}", msgtype, typestore=store)
                for name, msgtype in (("odometry", ODOMETRY), ("pose", POSE))
            ]
            for k, messages in enumerate(_messages(states, frames, store.types)):
                for topic, message in zip(topics, messages, strict=True):
                    raw = store.serialize_cdr(message, topic.msgtype)
                    writer.write(topic, int(stamps[k]), raw)
                if k % 1000 == 0:
                    report(k)
        (bag / f"bag.{form}").replace(path)


def _messages(states: ResultStates, frames: Frames, types: Any) -> Iterator[tuple[Any, Any]]:
    """Yield odometry and pose of each state."""
    result = states.trajectory
    quaternion = Rotation.from_matrix(result.world_from_body).as_quat().tolist()
    cov = _pose_covariance(result).reshape(-1, 36)
    velocity = np.zeros((len(result), 3))
    if result.velocity_world is not None:
        velocity = np.einsum("nji,nj->ni", result.world_from_body, result.velocity_world)
    vector, unknown = types["geometry_msgs/msg/Vector3"], (UNKNOWN_VARIANCE * np.eye(6)).ravel()
    for k, stamp in enumerate(states.stamp_ns.tolist()):
        time = types["builtin_interfaces/msg/Time"](*divmod(stamp, NS_PER_S))
        header = types["std_msgs/msg/Header"](time, frames.world)
        pose = types["geometry_msgs/msg/PoseWithCovariance"](
            types["geometry_msgs/msg/Pose"](
                types["geometry_msgs/msg/Point"](*result.position_world[k].tolist()),
                types["geometry_msgs/msg/Quaternion"](*quaternion[k]),
            ),
            cov[k],
        )
        twist = types["geometry_msgs/msg/TwistWithCovariance"](
            types["geometry_msgs/msg/Twist"](vector(*velocity[k].tolist()), vector(0.0, 0.0, 0.0)),
            unknown,
        )
        yield types[ODOMETRY](header, frames.body, pose, twist), types[POSE](header, pose)
