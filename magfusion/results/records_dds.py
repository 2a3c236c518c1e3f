"""Samples of topics of ROS 2 as records of a pipe, by DDS; no ROS is installed here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

import numpy as np

from magfusion.errors import InputError
from magfusion.files.aiding_messages import NAV_SAT_FIX, SensorMessages, aiding_rows
from magfusion.files.bag_topics import Topics
from magfusion.files.messages import Row
from magfusion.files.records import Record
from magfusion.files.stream import NumberedRecord, checked_record
from magfusion.model.aiding import AidingSensor
from magfusion.results.dds_domain import dds_name, join_domain
from magfusion.units import NANOSECOND

if TYPE_CHECKING:
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader

    from magfusion.model.site import Site

SILENCE = 5.0  # s; a topic without messages for longer is reported
POLL_NS = 100_000_000  # within which the process answers a signal
DEPTH = 4096  # samples that may wait: a second of the fastest sensors


class Subscription(NamedTuple):
    """How messages of a topic become a part of a record."""

    topic: str  # name
    message: str  # its class in `magfusion.results.ros_messages`
    kind: str  # its type in ROS
    # returns the part's keys of stamps (s) and messages
    content: Callable[[list[float], Sequence[Any]], dict[str, list[Any]]]
    sensor: str | None = None  # aiding sensor of the site, which may have topics of several types


def _imu_content(stamps: list[float], messages: Sequence[Any]) -> dict[str, list[Any]]:
    return {
        "time": stamps,
        "gyro": [_xyz(one.angular_velocity) for one in messages],
        "accel": [_xyz(one.linear_acceleration) for one in messages],
    }


def _field_content(stamps: list[float], messages: Sequence[Any]) -> dict[str, list[Any]]:
    return {"time": stamps, "field": [_xyz(one.magnetic_field) for one in messages]}


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


SUBSCRIPTIONS = {  # by the part of a record
    "imu": Subscription("/imu/data", "ImuMessage", "sensor_msgs/msg/Imu", _imu_content),
    "magnetometer": Subscription(
        "/mag", "MagneticFieldMessage", "sensor_msgs/msg/MagneticField", _field_content
    ),
}
AIDING_MESSAGES = {  # class by type
    "nav_msgs/msg/Odometry": "OdometryMessage",
    "geometry_msgs/msg/TwistWithCovarianceStamped": "TwistWithCovarianceStampedMessage",
    "geometry_msgs/msg/PoseStamped": "PoseStampedMessage",
    "sensor_msgs/msg/Range": "RangeMessage",
    "sensor_msgs/msg/FluidPressure": "FluidPressureMessage",
    NAV_SAT_FIX: "NavSatFixMessage",
}


def _of_aiding(sensor: AidingSensor, messages: TextIO) -> Iterator[Subscription]:
    """Yield the subscriptions of a sensor: to the topic of its name, of every type it may have."""
    for kind, row in aiding_rows(sensor).items():
        if kind in AIDING_MESSAGES:
            topic = f"/{sensor.name.strip('/')}"
            content = partial(_aiding_content, row, SensorMessages(sensor), topic, messages)
            yield Subscription(topic, AIDING_MESSAGES[kind], kind, content, sensor.name)


def _aiding_content(
    row: Row,
    of_sensor: SensorMessages,
    topic: str,
    report_to: TextIO,
    stamps: list[float],
    messages: Sequence[Any],
) -> dict[str, list[Any]]:
    """Return samples; none where the messages have no stamp, or no value.

    The latter are counted, and reported at the first, the tenth, the hundredth, ...
    """
    if 0.0 in stamps:
        return {"time": stamps}
    count = of_sensor.without_value
    time, value = of_sensor.samples(np.array(stamps), np.array([row(one) for one in messages]))
    if any(count < 10**k <= of_sensor.without_value for k in range(9)):
        report_to.write(
            f"magfusion: {topic}: messages without a value (no fix) are left out, so far"
            f" {of_sensor.without_value}\n"
        )
        report_to.flush()
    value = value[:, 0] if value.shape[1:] == (1,) else value
    return {"time": time.tolist(), "value": value.tolist()}


def subscribe(topics: Topics | None, site: Site, messages: TextIO) -> Iterator[NumberedRecord]:
    """Return the samples of topics as they arrive, in the domain ``ROS_DOMAIN_ID``.

    Stamps are those of the headers, in seconds since 1970. Raises InputError where a topic or the
    domain is invalid, or cyclonedds is not installed. `topics`: other names than the defaults.
    `site`: of a platform without an IMU only the magnetometer is subscribed to. `messages`:
    receives a sentence on a topic without messages.
    """
    if topics is not None and topics.truth is not None:
        raise InputError("--topics: truth is of a log; omit it with ros2:")
    parts = [part for part in SUBSCRIPTIONS if part != "imu" or site.platform.inertial]
    wanted = {
        part: SUBSCRIPTIONS[part]._replace(
            topic=getattr(topics, part, None) or SUBSCRIPTIONS[part].topic
        )
        for part in parts
    }
    for part, one in wanted.items():
        dds_name(f"--topics {part}", one.topic)
    for sensor in site.aiding:
        wanted |= {f"{sensor.name} {one.kind}": one for one in _of_aiding(sensor, messages)}
    participant = join_domain("ros2:")
    return _received(participant, _readers(participant, wanted), wanted, messages)


def _readers(
    participant: DomainParticipant, wanted: dict[str, Subscription]
) -> dict[str, DataReader[Any]]:
    from cyclonedds.core import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from magfusion.results import ros_messages

    qos = Qos(
        Policy.Reliability.BestEffort, Policy.History.KeepLast(DEPTH), Policy.Durability.Volatile
    )
    readers = {}
    for part, one in wanted.items():
        message = getattr(ros_messages, one.message)
        topic = Topic(participant, dds_name("--topics", one.topic), message)
        readers[part] = DataReader(participant, topic, qos=qos)
    return readers


def _received(
    participant: DomainParticipant,
    readers: dict[str, DataReader[Any]],
    wanted: dict[str, Subscription],
    messages: TextIO,
) -> Iterator[NumberedRecord]:
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.internal import InvalidSample

    waiting = WaitSet(participant)
    new = ViewState.Any | InstanceState.Any | SampleState.NotRead
    for reader in readers.values():
        waiting.attach(ReadCondition(reader, new))
    labels = {part: one.sensor or part for part, one in wanted.items()}
    newest, silent, number = dict.fromkeys(labels.values(), time.monotonic()), set[str](), 0
    while True:
        waiting.wait(POLL_NS)
        content: dict[str, Any] = {}
        for part, reader in readers.items():
            arrived = [one for one in reader.take(DEPTH) if not isinstance(one, InvalidSample)]
            if arrived:
                number += len(arrived)
                newest[labels[part]] = time.monotonic()
                silent.discard(labels[part])
                _add(content, part, wanted[part], arrived)
        for part, label in labels.items():
            if label not in silent and time.monotonic() - newest[label] > SILENCE:
                silent.add(label)
                messages.write(_silence_text(part, wanted[part]))
                messages.flush()
        if content:
            yield _numbered(number, content, wanted)


def _add(
    content: dict[str, Any], part: str, subscription: Subscription, messages: Sequence[Any]
) -> None:
    """Add messages to the content of a record."""
    stamps = [one.header.stamp.sec + NANOSECOND * one.header.stamp.nanosec for one in messages]
    own = subscription.content(stamps, messages)
    if subscription.sensor is None:
        content[part] = own
    elif own["time"]:
        content.setdefault("aiding", {})[subscription.sensor] = own


def _numbered(
    number: int, content: dict[str, Any], wanted: dict[str, Subscription]
) -> NumberedRecord:
    aiding = content.get("aiding", {})
    streams = {k: v for k, v in content.items() if k != "aiding"} | aiding
    unstamped = [name for name, own in streams.items() if 0.0 in own["time"]]
    if unstamped:
        one = wanted.get(unstamped[0])
        topic = f"/{unstamped[0].strip('/')}" if one is None else one.topic
        reason = f"{topic} has messages without a stamp; set header.stamp in its driver"
        return NumberedRecord(number, None, reason, "ros2:", "message")
    record = checked_record(number, partial(Record.model_validate, content))
    return replace(record, source="ros2:", unit="message")


def _silence_text(part: str, subscription: Subscription) -> str:
    remedy = (
        f"its name (--topics {part}=NAME)"
        if subscription.sensor is None
        else f"the name of {subscription.sensor} in the site's aiding"
    )
    return (
        f"magfusion: {subscription.topic}: no message for {SILENCE:g} s; check {remedy}, its type"
        f" ({subscription.kind}) and ROS_DOMAIN_ID\n"
    )
