"""Navigation from topics of ROS 2 by DDS: what a driver publishes in another process."""

import io
import json
import os
import select
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aiding_site import aided_site
from conftest import Refuse
from rosbags.typesys import Stores, get_typestore

from magfusion.files.log import read_log, write_log
from magfusion.files.site import save_site
from magfusion.jobs.replay import run_replay
from magfusion.jobs.stream import StreamSettings, run_stream
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log

pytest.importorskip("cyclonedds")

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from test_live_ros import LOOPBACK, ROS_DEFAULT

from magfusion.estimation.online.navigator import NavigatorSettings
from magfusion.files.bag_topics import Topics
from magfusion.model.aiding import AidingSensor
from magfusion.results import records_dds
from magfusion.results import ros_messages as ros

STORE = get_typestore(Stores.ROS2_HUMBLE)
MAX_WAIT = 90.0  # s
HEADER = ros.Header(ros.Time(12, 500_000_000), "imu")
UNKNOWN = [0.0] * 9
POSE = ros.Pose(ros.Point(1.0, 2.0, 3.0), ros.Quaternion(0.0, 0.0, 0.0, 1.0))
TWIST = ros.TwistWithCovariance(
    ros.Twist(ros.Vector3(0.5, 0.25, -0.125), ros.Vector3(0.0, 0.0, 0.1)), [0.0] * 36
)


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """Return a domain that only this process uses, of this machine alone."""
    number = 1 + os.getpid() % 99
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    return number


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=8.0)
    path = tmp_path_factory.mktemp("walk") / "log"
    write_log(simulate_log(demo_site(), config, np.random.default_rng(5)).log, path)
    save_site(demo_site(), path / "site.yaml")
    return path


def _imu(header: ros.Header) -> ros.ImuMessage:
    turn, force = ros.Vector3(0.1, -0.2, 0.3), ros.Vector3(0.5, 0.25, 9.81)
    rotation = ros.Quaternion(0.0, 0.0, 0.0, 1.0)
    return ros.ImuMessage(header, rotation, UNKNOWN, turn, UNKNOWN, force, UNKNOWN)


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        (_imu(HEADER), "sensor_msgs/msg/Imu"),
        (
            ros.MagneticFieldMessage(HEADER, ros.Vector3(2e-5, 0.0, -4e-5), UNKNOWN),
            "sensor_msgs/msg/MagneticField",
        ),
        (ros.PoseStampedMessage(HEADER, POSE), "geometry_msgs/msg/PoseStamped"),
        (
            ros.TwistWithCovarianceStampedMessage(HEADER, TWIST),
            "geometry_msgs/msg/TwistWithCovarianceStamped",
        ),
        (ros.RangeMessage(HEADER, 0, 0.5, 0.25, 50.0, 4.125), "sensor_msgs/msg/Range"),
        (ros.FluidPressureMessage(HEADER, 101325.0, 4.0), "sensor_msgs/msg/FluidPressure"),
        (
            ros.NavSatFixMessage(HEADER, ros.NavSatStatus(0, 1), 60.5, 25.25, 12.5, UNKNOWN, 2),
            "sensor_msgs/msg/NavSatFix",
        ),
    ],
)
def test_the_bytes_are_those_of_ros(message: Any, kind: str) -> None:
    """By another library: it reads the message, and writes the same bytes."""
    raw = message.serialize()
    read: Any = STORE.deserialize_cdr(raw, kind)
    assert bytes(STORE.serialize_cdr(read, kind)) == raw
    assert read.header.stamp.nanosec == HEADER.stamp.nanosec


@pytest.mark.slow
def test_a_walk_of_a_driver_is_navigated_as_in_the_pipe(log: Path, domain: int) -> None:
    topic = f"/robot_{uuid.uuid4().hex}/odometry"
    participant = DomainParticipant(domain)
    reader = DataReader(
        participant, Topic(participant, f"rt{topic}", ros.OdometryMessage), qos=ROS_DEFAULT
    )
    command = ("navigate", "ros2:", "--site", log / "site.yaml", "--estimator", "ekf")
    navigating = subprocess.Popen(
        [sys.executable, "-m", "magfusion", *map(str, command), "--ros2", topic],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    driver = Path(__file__).with_name("dds_publisher.py")
    publisher = subprocess.run(
        [sys.executable, str(driver), str(domain), str(log), "1.0"], timeout=MAX_WAIT, check=False
    )
    navigating.send_signal(signal.SIGTERM)
    out, err = navigating.communicate(timeout=MAX_WAIT)
    assert publisher.returncode == 0
    assert navigating.returncode == 143  # a background job ignores SIGINT
    assert b"Traceback" not in err

    states = {s["time"]: s for s in map(json.loads, out.splitlines()) if s["started"]}
    expected = _piped(log)
    assert len(states) >= len(expected) - 2  # the end of a pipe shows the last
    epoch = read_log(log).epoch_ns * 1e-9
    for stamp, state in states.items():
        nearest = min(expected, key=lambda one: abs(one["time"] + epoch - stamp))
        assert nearest["time"] + epoch == pytest.approx(stamp, abs=1e-3)
        away = np.subtract(state["position"], nearest["position"])
        assert np.all(np.abs(away) < 0.5 * np.array(state["sigma"]["position"]))
    published = reader.take(10)
    assert published
    stamp = published[-1].header.stamp
    assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(max(states), abs=1e-6)


def _piped(log: Path) -> list[dict[str, Any]]:
    records, sink, messages = io.BytesIO(), io.BytesIO(), io.StringIO()
    run_replay(read_log(log), records, "json", realtime=False)
    records.seek(0)
    settings = StreamSettings(NavigatorSettings("ekf"))
    run_stream(log / "site.yaml", settings, records, sink, messages)
    states = map(json.loads, sink.getvalue().splitlines())
    return [state for state in states if state["started"]]


@pytest.mark.slow
@pytest.mark.usefixtures("domain")
def test_topics_without_messages_are_reported_once(log: Path) -> None:
    command = ("navigate", "ros2:", "--site", log / "site.yaml", "--topics", "imu=/other/imu")
    with subprocess.Popen(
        [sys.executable, "-m", "magfusion", *map(str, command)], stderr=subprocess.PIPE, bufsize=0
    ) as running:
        assert running.stderr is not None
        lines = []
        for _ in range(2):
            assert select.select([running.stderr], [], [], MAX_WAIT)[0]
            lines.append(running.stderr.readline().decode())
        assert not select.select([running.stderr], [], [], records_dds.SILENCE + 2.0)[0]
        running.send_signal(signal.SIGTERM)
        running.communicate(timeout=MAX_WAIT)
    assert "/other/imu: no message for 5 s; check its name (--topics imu=NAME)" in lines[0]
    assert "/mag: no message for 5 s" in lines[1]


def test_messages_without_a_stamp_are_refused() -> None:
    content = {"imu": records_dds.SUBSCRIPTIONS["imu"].content([0.0], [_imu(HEADER)])}
    numbered = records_dds._numbered(3, content, records_dds.SUBSCRIPTIONS)
    assert numbered.record is None
    sentence = numbered.located(numbered.refusal)
    assert sentence.startswith("ros2:, message 3: /imu/data has messages without a stamp; set")


def test_aiding_sensors_are_subscribed_to_by_their_names(domain: int) -> None:
    """A sensor's topic may have any type of what it measures; the writer decides."""
    site = aided_site(
        AidingSensor("wheels/odom", "velocity", 0.02),
        AidingSensor("visual", "velocity", 0.02),
        AidingSensor("uwb", "range", 0.1, point_world=np.zeros(3)),
        AidingSensor("gnss", "position", 1.0, origin=(60.5, 25.25, 10.0)),
    )
    said = io.StringIO()
    received = records_dds.subscribe(None, site, said)
    participant = DomainParticipant(domain)
    sent: dict[str, Any] = {
        "/wheels/odom": ros.OdometryMessage(
            HEADER, "base", ros.PoseWithCovariance(POSE, [0.0] * 36), TWIST
        ),
        "/visual": ros.TwistWithCovarianceStampedMessage(HEADER, TWIST),
        "/uwb": ros.RangeMessage(HEADER, 0, 0.5, 0.25, 50.0, 4.125),
        "/gnss": ros.NavSatFixMessage(
            HEADER, ros.NavSatStatus(0, 1), 60.5, 25.25, 12.5, UNKNOWN, 2
        ),
    }
    no_fix = ros.NavSatFixMessage(HEADER, ros.NavSatStatus(-1, 1), 0.0, 0.0, 0.0, UNKNOWN, 0)
    writers = [
        (DataWriter(participant, Topic(participant, f"rt{name}", type(one))), one)
        for name, one in [("/gnss", no_fix), *sent.items()]
    ]
    values: dict[str, Any] = {}
    begin = time.monotonic()
    while len(values) < len(sent) and time.monotonic() < begin + MAX_WAIT:
        for writer, message in writers:
            writer.write(message)
        record = next(received).record
        assert record is not None
        values |= {name: own.value[0].tolist() for name, own in (record.aiding or {}).items()}
    assert values.pop("gnss") == pytest.approx([0.0, 0.0, 2.5], abs=1e-6)  # m
    assert values == {
        "wheels/odom": [0.5, 0.25, -0.125],
        "visual": [0.5, 0.25, -0.125],
        "uwb": [4.125],
    }
    assert "/gnss: messages without a value (no fix) are left out, so far" in said.getvalue()


def test_every_subscription_is_a_part_of_a_record_and_a_role() -> None:
    roles = set(Topics.__dataclass_fields__)
    for part, own in records_dds.SUBSCRIPTIONS.items():
        assert part in records_dds.Record.model_fields
        assert part in roles
        assert hasattr(ros, own.message)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ((), "navigate ros2: requires the site's file; give it with --site SITE.yaml"),
        (("--site", "SITE", "--format", "json"), "omit them with ros2:"),
        (("--site", "SITE", "--start", "1"), "omit them with ros2:"),
        (("--site", "SITE", "--topics", "imu=data"), "--topics imu 'data': is not a topic"),
        (("--site", "SITE", "--topics", "truth=/odom"), "--topics: truth is of a log"),
    ],
)
def test_wrong_options_are_refused(
    log: Path, refuse: Refuse, options: tuple[str, ...], sentence: str
) -> None:
    given = [str(log / "site.yaml") if one == "SITE" else one for one in options]
    assert sentence in refuse("navigate", "ros2:", *given)
