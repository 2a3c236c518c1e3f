"""Samples of topics of ROS 2 as records of a pipe, by DDS; no ROS is installed here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from magfusion.errors import InputError
from magfusion.files.stream import NumberedRecord, Record, checked_record
from magfusion.results.dds_domain import dds_name, join_domain

if TYPE_CHECKING:
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader

    from magfusion.files.bag_topics import Topics
    from magfusion.model.site import Site

SILENCE = 5.0  # s; a topic without messages for longer is reported
POLL_NS = 100_000_000  # within which the process answers a signal
DEPTH = 4096  # samples that may wait: a second of the fastest sensors
NS = 1e-9  # s


class Subscription(NamedTuple):
    """How messages of a topic become a part of a record.

    Parameters
    ----------
    topic : str
        Default name.
    message : str
        Its class in `magfusion.results.ros_messages`.
    kind : str
        Its type in ROS.
    content : callable
        Returns the part's keys, but for the time, of messages.
    """

    topic: str
    message: str
    kind: str
    content: Callable[[Sequence[Any]], dict[str, list[Any]]]


def _imu_content(messages: Sequence[Any]) -> dict[str, list[Any]]:
    return {
        "gyro": [_xyz(one.angular_velocity) for one in messages],
        "accel": [_xyz(one.linear_acceleration) for one in messages],
    }


def _field_content(messages: Sequence[Any]) -> dict[str, list[Any]]:
    return {"field": [_xyz(one.magnetic_field) for one in messages]}


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


SUBSCRIPTIONS = {  # by the part of a record
    "imu": Subscription("/imu/data", "ImuMessage", "sensor_msgs/msg/Imu", _imu_content),
    "magnetometer": Subscription(
        "/mag", "MagneticFieldMessage", "sensor_msgs/msg/MagneticField", _field_content
    ),
}


def subscribe(topics: Topics | None, site: Site, messages: TextIO) -> Iterator[NumberedRecord]:
    """Return the samples of topics as they arrive, in the domain ``ROS_DOMAIN_ID``.

    Stamps are those of the headers, in seconds since 1970.

    Parameters
    ----------
    topics : Topics, optional
        Other names than the defaults.
    site : Site
        Of a platform without an IMU only the magnetometer is subscribed to.
    messages : file
        Receives a sentence on a topic without messages.

    Raises
    ------
    InputError
        Where a topic or the domain is invalid, or cyclonedds is not installed.
    """
    if topics is not None and topics.truth is not None:
        raise InputError("--topics: truth is of a log; omit it with ros2:")
    parts = [part for part in SUBSCRIPTIONS if part != "imu" or site.platform.inertial]
    names = {part: getattr(topics, part, None) or SUBSCRIPTIONS[part].topic for part in parts}
    for part, name in names.items():
        dds_name(f"--topics {part}", name)
    participant = join_domain("ros2:")
    return _received(participant, _readers(participant, names), names, messages)


def _readers(participant: DomainParticipant, names: dict[str, str]) -> dict[str, DataReader[Any]]:
    from cyclonedds.core import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from magfusion.results import ros_messages

    qos = Qos(
        Policy.Reliability.BestEffort, Policy.History.KeepLast(DEPTH), Policy.Durability.Volatile
    )
    readers = {}
    for part, name in names.items():
        message = getattr(ros_messages, SUBSCRIPTIONS[part].message)
        topic = Topic(participant, dds_name("--topics", name), message)
        readers[part] = DataReader(participant, topic, qos=qos)
    return readers


def _received(
    participant: DomainParticipant,
    readers: dict[str, DataReader[Any]],
    names: dict[str, str],
    messages: TextIO,
) -> Iterator[NumberedRecord]:
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.internal import InvalidSample

    waiting = WaitSet(participant)
    new = ViewState.Any | InstanceState.Any | SampleState.NotRead
    for reader in readers.values():
        waiting.attach(ReadCondition(reader, new))
    newest, silent, number = dict.fromkeys(readers, time.monotonic()), set[str](), 0
    while True:
        waiting.wait(POLL_NS)
        content = {}
        for part, reader in readers.items():
            arrived = [one for one in reader.take(DEPTH) if not isinstance(one, InvalidSample)]
            if arrived:
                number += len(arrived)
                newest[part] = time.monotonic()
                silent.discard(part)
                stamps = [one.header.stamp.sec + NS * one.header.stamp.nanosec for one in arrived]
                content[part] = {"time": stamps, **SUBSCRIPTIONS[part].content(arrived)}
            elif part not in silent and time.monotonic() - newest[part] > SILENCE:
                silent.add(part)
                messages.write(_silence_text(part, names[part]))
                messages.flush()
        if content:
            yield _numbered(number, content, names)


def _numbered(number: int, content: dict[str, Any], names: dict[str, str]) -> NumberedRecord:
    unstamped = [names[part] for part, own in content.items() if 0.0 in own["time"]]
    if unstamped:
        reason = f"{unstamped[0]} has messages without a stamp; set header.stamp in its driver"
        return NumberedRecord(number, None, reason, "ros2:", "message")
    record = checked_record(number, partial(Record.model_validate, content))
    return replace(record, source="ros2:", unit="message")


def _silence_text(part: str, name: str) -> str:
    return (
        f"magfusion: {name}: no message for {SILENCE:g} s; check its name (--topics {part}=NAME),"
        f" its type ({SUBSCRIPTIONS[part].kind}) and ROS_DOMAIN_ID\n"
    )
