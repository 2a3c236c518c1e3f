"""Messages of a bag as columns of numbers, thousands at a time.

Making an object of each message takes most of the time of reading a bag.  The messages of sensors
end with nothing but doubles, with their stamps at the same offset in all of them: both are cut
out of the bytes.  One message of every part is read by the library, too; where the numbers are not
the same to the last bit, or messages differ in size, the library reads them all.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from magfusion.files.lost_rows import MAX_DUPLICATED
from magfusion.files.messages import (
    FIELD,
    IMU,
    ODOMETRY,
    POSE,
    POSE_WITH_COVARIANCE,
    TRANSFORM,
    Row,
    refuse_absent,
    stamp_ns,
)
from magfusion.model.progress import Report, quiet
from magfusion.units import Array, IntArray

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

PART = 1 << 14  # messages whose bytes are kept
_DOUBLE = 8  # bytes
_STAMP = slice(4, 12)  # of a message, behind the encapsulation of CDR or the counter of ROS 1
_LITTLE_ENDIAN = 1


class Tail(NamedTuple):
    """The doubles that a message ends with."""

    numbers: int  # how many there are
    read_rows: tuple[int, ...]  # which make a row
    absent: tuple[int, ...] = ()  # in which -1 marks a missing measurement


_POSE = tuple(range(7))
TAILS: dict[str, Tail] = {
    # Orientation, rate and force, each with its covariance.
    IMU: Tail(37, (13, 14, 15, 25, 26, 27), (16, 28)),
    FIELD: Tail(12, (0, 1, 2)),
    POSE: Tail(7, _POSE),
    POSE_WITH_COVARIANCE: Tail(43, _POSE),
    TRANSFORM: Tail(7, _POSE),
    # Pose and twist, each with its covariance.
    ODOMETRY: Tail(85, (*_POSE, 43, 44, 45)),
}


class Wanted(NamedTuple):
    """Messages to read."""

    place: str  # what a refusal calls them
    connections: Sequence[Connection]  # of one topic and type
    row: Row  # from a message to its numbers


class Messages(NamedTuple):
    """Messages of a topic: stamps of headers and of arrival (ns), and a row of numbers each."""

    stamps: IntArray
    values: Array
    arrived: IntArray

    @property
    def unstamped(self) -> bool:
        """Whether all headers have one stamp, and times of arrival distinguish the messages."""
        same = len(self.stamps) > 1 and bool(np.all(self.stamps == self.stamps[0]))
        return same and bool(np.mean(np.diff(self.arrived) <= 0) <= MAX_DUPLICATED)


def unstamped_text(name: str, stamp_ns: int) -> str:
    """Return that times of arrival are used for the messages of a stream, and why."""
    return (
        f"{name}: all messages have the stamp {stamp_ns} ns. Their times of arrival are used; stamp"
        " each in its driver."
    )


def read_parts(
    reader: AnyReader, wanted: Mapping[str, Wanted], report: Report = quiet
) -> Iterator[tuple[str, Messages]]:
    """Yield the messages of topics in the order of their arrival, `PART` of one at a time.

    `wanted`: by the name that goes with their parts. Raises InputError where a message is marked as
    not measured; or whatever the library raises of a bag that is damaged.
    """
    name_of = {c.topic: name for name, one in wanted.items() for c in one.connections}
    every = [c for one in wanted.values() for c in one.connections]
    waiting: dict[str, list[bytes]] = {name: [] for name in wanted}
    times: dict[str, list[int]] = {name: [] for name in wanted}
    total, done = sum(c.msgcount for c in every), 0
    for connection, arrived, raw in reader.messages(every) if every else ():
        name = name_of[connection.topic]  # numbers repeat from file to file
        waiting[name].append(raw)
        times[name].append(arrived)
        if len(waiting[name]) == PART:
            report("reading", done, total)
            done += PART
            yield name, _part(reader, wanted[name], waiting[name], times[name])
            waiting[name], times[name] = [], []
    for name, raws in waiting.items():
        if raws:
            yield name, _part(reader, wanted[name], raws, times[name])


def _part(reader: AnyReader, wanted: Wanted, raws: list[bytes], times: list[int]) -> Messages:
    msgtype, arrived = wanted.connections[0].msgtype, np.array(times, dtype=np.int64)
    first = _decoded(reader, wanted, msgtype, raws[:1], arrived)
    cut = _cut(reader.is2, TAILS.get(msgtype), raws)
    if cut is None:
        return _decoded(reader, wanted, msgtype, raws, arrived)
    stamps, doubles, tail = cut
    values = np.take(doubles, tail.read_rows, axis=1)
    shared = stamps[0] == first.stamps[0]
    if not (shared and np.array_equal(values[:1], first.values, equal_nan=True)):
        return _decoded(reader, wanted, msgtype, raws, arrived)
    absent = np.flatnonzero((doubles[:, tail.absent] == -1.0).any(axis=1))
    if len(absent):
        _decoded(reader, wanted, msgtype, [raws[absent[0]]], arrived)  # which refuses it
    return Messages(stamps, values, arrived)


def _cut(is2: bool, tail: Tail | None, raws: list[bytes]) -> tuple[IntArray, Array, Tail] | None:
    """Return stamps and doubles of messages; None of such as cannot be cut."""
    if tail is None:
        return None
    size = _DOUBLE * tail.numbers
    if min(map(len, raws)) < _STAMP.stop + size:
        return None
    if is2 and {raw[1] for raw in raws} != {_LITTLE_ENDIAN}:
        return None
    second, fraction = (
        np.frombuffer(b"".join([raw[_STAMP] for raw in raws]), "<u4").reshape(-1, 2).T
    )
    seconds = second.astype(np.int32) if is2 else second
    stamps = seconds.astype(np.int64) * 1_000_000_000 + fraction
    doubles = np.frombuffer(b"".join([raw[-size:] for raw in raws]), "<f8")
    return stamps, doubles.reshape(-1, tail.numbers), tail


def _decoded(
    reader: AnyReader, wanted: Wanted, msgtype: str, raws: list[bytes], arrived: IntArray
) -> Messages:
    """Return messages as the library reads them."""
    stamps, values = [], []
    for raw in raws:
        message: Any = reader.deserialize(raw, msgtype)
        refuse_absent(message, wanted.place)
        stamps.append(stamp_ns(message.header))
        values.append(wanted.row(message))
    numbers = np.array(values, dtype=np.float64)
    return Messages(np.array(stamps, dtype=np.int64), numbers, arrived)
