"""Odometry for ROS 2 by DDS: its bytes are those of ROS, and a subscriber receives it."""

import dataclasses
import json
import os
import select
import subprocess
import sys
import uuid
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Refuse
from live_states import (
    EPOCH_NS,
    MAX_FINAL_STEP_SIGMAS,
    example_state,
    piped,
    release_gain,
    write_walk,
)
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import as_trajectory
from magfusion.files.odometry_bag import Frames, write_bag
from magfusion.files.result_states import ResultStates
from magfusion.jobs.live import LiveSettings
from magfusion.results.odometry import odometry_of

pytest.importorskip("cyclonedds")

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from magfusion.results.odometry_dds import RosPublisher, odometry_message
from magfusion.results.ros_messages import OdometryMessage

# Only this machine, without multicast, which not every network has.
LOOPBACK = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
STORE = get_typestore(Stores.ROS2_HUMBLE)
# As rclcpp and rclpy ask by default.
ROS_DEFAULT = Qos(
    Policy.Reliability.Reliable(duration(seconds=1)),
    Policy.History.KeepLast(10),
    Policy.Durability.Volatile,
)


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """Return a domain that only this process uses."""
    number = 100 + os.getpid() % 100
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    return number


@pytest.fixture
def topic() -> str:
    """Return a topic that no other test has, whichever processes they share the domain with."""
    return f"/robot_{uuid.uuid4().hex}/odometry"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "log")


def written_in(message: Any) -> list[Any]:
    """Return texts and numbers of a message in order, but for the variances of its twist."""
    if dataclasses.is_dataclass(message):
        parts = [(f.name, getattr(message, f.name)) for f in dataclasses.fields(message)]
        whole = "TwistWithCovariance" not in type(message).__name__
        return [v for name, part in parts if whole or name == "twist" for v in written_in(part)]
    return message.tolist() if isinstance(message, np.ndarray) else [message]


def test_the_bytes_are_those_that_ros_reads(tmp_path: Path) -> None:
    """By another library: what it reads, it writes as the same bytes, and is what a bag holds."""
    state = example_state(2)
    odometry = odometry_of(state)
    raw = odometry_message(odometry, "map", "base_link").serialize()
    read: Any = STORE.deserialize_cdr(raw, "nav_msgs/msg/Odometry")
    assert bytes(STORE.serialize_cdr(read, "nav_msgs/msg/Odometry")) == raw

    trajectory = as_trajectory([state])
    states = ResultStates(np.array([odometry.stamp_ns]), trajectory, None, 0)
    write_bag(states, tmp_path / "one.mcap", "mcap", Frames("map", "base_link"), lambda _: None)
    with AnyReader([tmp_path / "one.mcap"], default_typestore=STORE) as bag:
        ((connection, _, message),) = (m for m in bag.messages() if "Odometry" in m[0].msgtype)
        kept: Any = bag.deserialize(message, connection.msgtype)
    for mine, other in zip(written_in(read), written_in(kept), strict=True):
        exact = isinstance(mine, str)
        assert mine == other if exact else mine == pytest.approx(other, rel=1e-12, abs=1e-15)


def test_a_subscriber_that_knows_only_the_topic_receives_it(domain: int, topic: str) -> None:
    """Another process, which asks the publisher for the type of its messages."""
    publisher, state = (
        RosPublisher(topic, EPOCH_NS, "map", "base_link"),
        example_state(3),
    )
    command = [sys.executable, str(Path(__file__).with_name("dds_subscriber.py")), str(domain)]
    with subprocess.Popen([*command, f"rt{topic}"], stdout=subprocess.PIPE) as running:
        assert running.stdout is not None
        while not select.select([running.stdout], [], [], 0.02)[0]:
            publisher.take(state, release_gain(state))
        line = running.stdout.readline()
    assert publisher.close() is None
    reported = json.loads(line)
    assert reported["type"] == "nav_msgs::msg::dds_::Odometry_"
    message, odometry = reported["message"], odometry_of(state, EPOCH_NS)
    stamp = message["header"]["stamp"]
    assert stamp["sec"] * 1_000_000_000 + stamp["nanosec"] == odometry.stamp_ns
    assert (message["header"]["frame_id"], message["child_frame_id"]) == ("map", "base_link")
    place = message["pose"]["pose"]["position"]
    assert [place[axis] for axis in "xyz"] == state.position_world.tolist()
    assert message["pose"]["covariance"] == odometry.pose_cov.ravel().tolist()


def test_every_state_of_a_pipe_that_is_not_lost_is_published(
    log: Path, domain: int, topic: str
) -> None:
    participant = DomainParticipant(domain)
    reader = DataReader(
        participant, Topic(participant, f"rt{topic}", OdometryMessage), qos=ROS_DEFAULT
    )
    states, findings = piped(log, LiveSettings(ros2=topic))
    assert findings == ""
    received = reader.take(100)
    started = [state for state in states if state["started"]]
    assert len(started) >= 3
    for message, state in zip(received, started, strict=True):
        x, y, z, w = (getattr(message.pose.pose.orientation, name) for name in "xyzw")
        assert np.allclose([w, x, y, z], state["quaternion"], rtol=0.0, atol=1e-12)
        speed = message.twist.twist.linear
        rotated = Rotation.from_quat([x, y, z, w]).apply([speed.x, speed.y, speed.z])
        assert np.allclose(rotated, state["velocity"], rtol=0.0, atol=1e-12)
        sigma = np.sqrt(np.diag(np.reshape(message.pose.covariance, (6, 6)))[:3])
        assert np.allclose(sigma, state["sigma"]["position"], rtol=1e-9, atol=0.0)


def test_a_lost_state_is_not_published(domain: int, topic: str) -> None:
    participant = DomainParticipant(domain)
    reader = DataReader(
        participant, Topic(participant, f"rt{topic}", OdometryMessage), qos=ROS_DEFAULT
    )
    publisher, good = RosPublisher(topic, 0, "world", "body"), example_state(5)
    lost_epochs = replace(good, judgement=MAX_FINAL_STEP_SIGMAS)
    for state in (None, lost_epochs, good, lost_epochs):
        publisher.take(state, release_gain(good))
    publisher.close()
    assert len(reader.take(10)) == 1


@pytest.mark.parametrize("name", ["odometry", "/", "/robot/", "/my topic", "/1st"])
def test_a_name_that_is_no_topic_is_refused(log: Path, refuse: Refuse, name: str) -> None:
    findings = refuse("navigate", "-", "--site", log / "site.yaml", "--ros2", name)
    assert f"--ros2 {name!r}: is not a topic; write one like /robot/odometry" in findings


def test_frames_are_named_for_somebody(log: Path, refuse: Refuse) -> None:
    findings = refuse("navigate", "-", "--site", log / "site.yaml", "--frame", "map")
    assert "--frame and --child require --foxglove or --ros2; give one of them" in findings
    for names in (("--frame", "body"), ("--child", "world"), ("--child", " ")):
        findings = refuse(
            "navigate", "-", "--site", log / "site.yaml", "--ros2", "/odometry", *names
        )
        assert "must differ" in findings or "must not be empty" in findings


@pytest.mark.parametrize("number", ["233", "-1", "home"])
def test_a_domain_that_is_none_is_refused(
    log: Path, refuse: Refuse, monkeypatch: pytest.MonkeyPatch, number: str
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", number)
    findings = refuse("navigate", "-", "--site", log / "site.yaml", "--ros2", "/odometry")
    assert f"ROS_DOMAIN_ID: found {number!r}; it should be from 0 to 232" in findings


def test_what_is_not_installed_is_named(
    log: Path, refuse: Refuse, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cyclonedds.domain", None)
    findings = refuse("navigate", "-", "--site", log / "site.yaml", "--ros2", "/odometry")
    assert "pip install 'magfusion[ros2]'" in findings
