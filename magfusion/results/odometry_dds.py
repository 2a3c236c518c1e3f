"""States as nav_msgs/Odometry by DDS, which nodes of ROS 2 receive; no ROS is installed here."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.files.odometry_bag import UNKNOWN_VARIANCE
from magfusion.results import ros_messages as ros
from magfusion.results.dds_domain import dds_name, join_domain
from magfusion.results.odometry import Odometry, odometry_of
from magfusion.results.ros_messages import OdometryMessage as Message
from magfusion.units import NS_PER_S

_DEPTH = 10  # messages that a reader may be late by, as the default of ROS


def odometry_message(odometry: Odometry, frame: str, child: str) -> Any:
    """Return a message; angular rates, which no state has, are zero with a huge variance.

    `frame`, `child`: names of world and body.
    """
    twist_cov = UNKNOWN_VARIANCE * np.eye(6)
    twist_cov[:3, :3] = odometry.velocity_cov_body
    w, x, y, z = odometry.quaternion.tolist()
    pose = ros.Pose(ros.Point(*odometry.position_world.tolist()), ros.Quaternion(x, y, z, w))
    twist = ros.Twist(ros.Vector3(*odometry.velocity_body.tolist()), ros.Vector3(0.0, 0.0, 0.0))
    return ros.OdometryMessage(
        ros.Header(ros.Time(*divmod(odometry.stamp_ns, NS_PER_S)), frame),
        child,
        ros.PoseWithCovariance(pose, odometry.pose_cov.ravel().tolist()),
        ros.TwistWithCovariance(twist, twist_cov.ravel().tolist()),
    )


class RosPublisher:
    """Publishes the odometry of states that are not lost, in the domain ``ROS_DOMAIN_ID``.

    Raises InputError where the topic or the domain is invalid, or cyclonedds is not installed.

    Parameters
    ----------
    topic : str
        As ROS writes it, ``/robot/odometry``.
    epoch_ns : int
        Zero of the states' time (ns since 1970).
    frame, child : str
        Names of the frames.
    """

    def __init__(self, topic: str, epoch_ns: int, frame: str, child: str) -> None:
        name = dds_name("--ros2", topic)
        self._participant = join_domain("--ros2")
        from cyclonedds.core import DDSException, Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        # Reliable, since ROS subscribers request that, but it never blocks.
        requested = Qos(
            Policy.Reliability.Reliable(max_blocking_time=duration(seconds=0)),
            Policy.History.KeepLast(_DEPTH),
            Policy.Durability.Volatile,
        )
        of_states = Topic(self._participant, name, Message)
        self._writer = DataWriter(self._participant, of_states, qos=requested)
        self._refusal, self._epoch_ns, self._frames = DDSException, epoch_ns, (frame, child)
        self._unsent, self._why = 0, ""

    def take(self, state: JudgedState | None, _reported: Mapping[str, Any]) -> None:
        """Publish a state that is not lost."""
        if state is None or state.is_lost:
            return
        try:
            self._writer.write(odometry_message(odometry_of(state, self._epoch_ns), *self._frames))
        except self._refusal as error:
            self._unsent, self._why = self._unsent + 1, str(error)

    def close(self) -> str | None:
        """Leave the domain; return an error."""
        del self._writer, self._participant
        if not self._unsent:
            return None
        return f"--ros2: {self._unsent} messages could not be sent ({self._why})"
