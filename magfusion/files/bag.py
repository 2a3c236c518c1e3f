"""Import of bags of ROS 2, SQLite or MCAP, and of ROS 1, without ROS."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.aiding_messages import SensorMessages, aiding_rows
from magfusion.files.bag_reader import open_bag, refuse_overlap
from magfusion.files.bag_rows import Messages, Wanted, read_parts, unstamped_text
from magfusion.files.bag_topics import Topics
from magfusion.files.clock_steps import ClockSetBack, clock_set_back
from magfusion.files.lost_rows import LostRows
from magfusion.files.messages import FIELD, IMU, ROWS, USUAL
from magfusion.files.plausible import check_field, check_imu
from magfusion.files.pose_rows import PoseRows
from magfusion.files.row_stamps import batches_finding, separate_stamps
from magfusion.files.stray_stamps import MAX_GAP, all_strays, counted_back, stray_finding
from magfusion.files.table import MAX_NUMBER, Span
from magfusion.model.aiding import AidingSamples, AidingSensor
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict
from magfusion.units import NANOSECOND, Array, IntArray

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection


_NAMES = {"imu": "IMU", "magnetometer": "magnetometer", "truth": "truth"}  # of the roles


@dataclass(frozen=True, eq=False)
class _Stream:
    """Messages of one topic as numbers, sorted by the stamps of their headers.

    `name`: of its role in reports. `left_out`: stray samples before the first. `set_back`: where
    its clock was set back.
    """

    name: str
    place: str
    time_ns: IntArray
    values: Array
    findings: tuple[Finding, ...] = ()
    left_out: int = 0
    set_back: ClockSetBack | None = None

    def within(self, span: Span) -> _Stream:
        begin, end = np.searchsorted(self.time_ns, span.bounds_ns)
        return replace(self, time_ns=self.time_ns[begin:end], values=self.values[begin:end])


def read_bag(
    path: Path,
    start: float | None = None,
    end: float | None = None,
    topics: Topics | None = None,
    report: Report = quiet,
    aiding: tuple[AidingSensor, ...] = (),
) -> Log:
    """Read inertial samples, magnetometer and truth of a bag.

    Times are those of the messages' headers, and that of the first inertial sample is the log's
    epoch, also where its stamp is stray, or that of the magnetometer's first where there is no
    inertial sensor. Poses are taken for those of the
    IMU's axes in the world; the twist of an odometry is in body axes. Raises InputError where the
    bag cannot be read, has no topic of a sensor or several of one kind of which none was named, or
    holds messages that no instrument gives.

    Parameters
    ----------
    path : Path
        Directory of a bag, with its metadata or without, or its file (``.mcap``, ``.db3``,
        ``.bag`` of ROS 1).
    start, end : float, optional
        Seconds since the first inertial sample.
    report : callable
        Called with the number of messages read.
    aiding : tuple of AidingSensor
        Their names are those of their topics, with or without the namespace.

    Returns
    -------
    Log
        Without the streams for which the bag has no topic, and without messages that hold NaN or
        the stamp of another; ``findings`` has their number.
    """
    with open_bag([path]) as reader:
        result = _read(reader, path, topics or Topics(), report, aiding)
        notes, damage = reader.notes, reader.damage
    imu, field, truth = (result.get(role) for role in ("imu", "magnetometer", "truth"))
    first = field if imu is None else imu
    if first is None:
        raise InputError(
            f"{path}: has no messages of {IMU} or {FIELD}; record the magnetometer, and the"
            " inertial sensor with it."
        )
    span = Span(counted_back(first.time_ns, first.left_out), start, end)
    _refuse_steps(result.values(), span)
    declared = [Finding("bag_unfinished", note, Verdict.TRUSTWORTHY) for note in notes]
    declared += [Finding("bag_damaged", note, Verdict.TRUSTWORTHY) for note in damage]
    imu, field, truth = (
        None if one is None else _measured(one.within(span), declared)
        for one in (imu, field, truth)
    )
    others = {
        one.name: _aiding(_measured(result[one.name].within(span), declared), one, span)
        for one in aiding
        if one.name in result
    }
    return Log(
        name=path.resolve().stem,
        epoch_ns=span.epoch_ns,
        source="bag: " + ", ".join(s.place for s in (imu, field, truth) if s is not None),
        imu=ImuSamples.empty() if imu is None else _imu(imu, span),
        waveform=None if field is None else _waveform(field, span),
        truth=None if truth is None else _trajectory(truth, span, declared),
        findings=tuple(declared),
        aiding=others,
    )


def _read(
    reader: AnyReader, path: Path, topics: Topics, report: Report, aiding: tuple[AidingSensor, ...]
) -> dict[str, _Stream]:
    """Return the streams by their roles or sensors, of one pass over the bag."""
    wanted = {
        sensor.name: one
        for sensor in aiding
        if (one := _of_sensor(reader, path, sensor)) is not None
    }
    used = {one.connections[0].topic for one in wanted.values()}
    for role, rows in ROWS.items():
        connections = role_connections(reader, path, getattr(topics, role), role, tuple(rows), used)
        if connections:
            refuse_overlap(reader, connections[0].topic)
            row, place = rows[connections[0].msgtype], f"{path} topic {connections[0].topic}"
            wanted[role] = Wanted(place, connections, row)
    parts: dict[str, list[Messages]] = {role: [] for role in wanted}
    for role, part in read_parts(reader, wanted, report):
        parts[role].append(part)
    result = {}
    for role, one in wanted.items():
        if not parts[role]:
            raise InputError(f"{one.place}: holds no messages; record it, or leave it out.")
        messages = Messages(*map(np.concatenate, zip(*parts.pop(role), strict=True)))
        stream = _Stream(_NAMES.get(role, role), one.place, messages.stamps, messages.values)
        if messages.unstamped:
            text = unstamped_text(stream.name, int(messages.stamps[0]))
            findings = (Finding("repeated_stamps", text, Verdict.TRUSTWORTHY),)
            stream = replace(stream, time_ns=messages.arrived, findings=findings)
        # A receiver of GNSS has no fix for long: what is absent there is no mistake of recording.
        result[role] = _in_order(stream if role in ROWS else _with_values(stream))
    return result


def _with_values(stream: _Stream) -> _Stream:
    """Leave out the messages of an aiding sensor that have no value, and count them."""
    absent = np.asarray(np.isnan(stream.values).all(axis=1))
    if absent.all():
        raise InputError(
            f"{stream.place}: none of its {len(absent)} messages has a value (no fix?); leave"
            f" {stream.name} out of the site's aiding."
        )
    text = f"{stream.name}: {np.sum(absent)} of {len(absent)} messages have no value (no fix)."
    left_out = Finding("missing_samples", f"{text} They are left out.", Verdict.TRUSTWORTHY)
    there = stream.time_ns[~absent], stream.values[~absent]
    findings = (*stream.findings, *[left_out] * bool(absent.any()))
    return _Stream(stream.name, stream.place, *there, findings)


def _of_sensor(reader: AnyReader, path: Path, sensor: AidingSensor) -> Wanted | None:
    """Return the messages of an aiding sensor; None if the bag has no topic of its name."""
    name = sensor.name.strip("/")
    topics = sorted({c.topic for c in reader.connections})
    named = [topic for topic in topics if topic.strip("/") == name]
    named = named or [topic for topic in topics if topic.rsplit("/", 1)[-1] == name]
    if not named:
        return None
    rows = aiding_rows(sensor)
    connections = [c for c in reader.connections if c.topic == named[0] and c.msgtype in rows]
    if len(named) > 1 or not connections:
        types = ", ".join(sorted({c.msgtype for c in reader.connections if c.topic in named}))
        raise InputError(
            f"{path}: the site's aiding sensor {name} measures {sensor.quantity}, of which"
            f" {' and '.join(named)} of {types} is no single topic of"
            f" {' or '.join(rows) or 'any type'}; give it the whole name of another topic."
        )
    _refuse_several_types(connections, path)
    row = rows[connections[0].msgtype]
    return Wanted(f"{path} topic {named[0]}", connections, row)


def _aiding(stream: _Stream, sensor: AidingSensor, span: Span) -> AidingSamples:
    time = span.seconds(stream.time_ns)
    return AidingSamples(sensor.quantity, *SensorMessages(sensor).samples(time, stream.values))


def role_connections(
    reader: AnyReader,
    path: Path,
    topic: str | None,
    role: str,
    msgtypes: tuple[str, ...],
    used: Collection[str] = (),
) -> list[Connection]:
    """Return the connections of the one topic that plays a role, and is not used as another."""
    connections = [c for c in reader.connections if c.msgtype in msgtypes and c.topic not in used]
    if topic is None:
        connections = [c for c in connections if c.msgtype in USUAL] or connections
    names = sorted({c.topic for c in connections})
    if topic is not None:
        if topic not in names:
            result = ", ".join(names) or "none"
            raise InputError(
                f"{path}: has no topic {topic} of {' or '.join(msgtypes)} for {role} (found"
                f" {result}); name another."
            )
        connections = [c for c in connections if c.topic == topic]
    elif len(names) > 1:
        raise InputError(
            f"{path}: has several topics for {role}: {', '.join(names)};"
            f" name one by --topics {role}=... (in Python, by Topics), or keep one in the bag."
        )
    _refuse_several_types(connections, path)
    return connections


def _refuse_several_types(connections: list[Connection], path: Path) -> None:
    if len({c.msgtype for c in connections}) > 1:
        topic = connections[0].topic
        raise InputError(f"{path}: topic {topic} has several types; record it with one.")


def _in_order(stream: _Stream) -> _Stream:
    """Return a stream sorted by the times of its samples, where the stamps are others, too."""
    # What is infinite is no measurement either.
    values = np.where(np.abs(stream.values) < MAX_NUMBER, stream.values, np.nan)
    stray = all_strays(stream.time_ns)
    findings = stream.findings + stray_finding(stream.name, stream.time_ns[stray])
    time_ns, values = stream.time_ns[~stray], values[~stray]
    step = clock_set_back(time_ns, values)
    if step is not None:
        step = step._replace(row=int(np.flatnonzero(~stray)[step.row]))
    # A bag keeps the order of arrival, which the network may have changed.
    order = np.argsort(time_ns, kind="stable")
    time_ns, values = time_ns[order], values[order]
    separate = separate_stamps(time_ns, values)
    if separate is not None:
        findings += (batches_finding(stream.name, time_ns),)
        time_ns = separate
    return _Stream(
        stream.name, stream.place, time_ns, values, findings, int(np.argmin(stray)), step
    )


def _refuse_steps(streams: Collection[_Stream], span: Span) -> None:
    """Refuse a span in which stamps are of two times, as the clock was set back."""
    begin, end = span.bounds_ns
    steps = [(one.place, step) for one in streams if (step := one.set_back) is not None]
    steps = [one for one in steps if begin <= one[1].before_ns and end > one[1].stamp_ns]
    if not steps:
        return
    place, step = steps[0]
    # The clock is one: its other streams may have stepped a sample earlier or later.
    near = [s for _, s in steps if s.stamp_ns <= step.before_ns and s.before_ns >= step.stamp_ns]
    bounds = [min(s.stamp_ns for s in near), max(s.before_ns for s in near)]
    first, last = 1e3 * span.seconds(np.array(bounds))  # ms
    raise InputError(
        f"{place}: the clock was set back by {step.size_s:.4g} s at message {step.row} (counted"
        f" from 0), stamped {step.stamp_ns} ns; use one side by --end {np.floor(first) / 1e3:g} or"
        f" --start {np.ceil(last + 1.0) / 1e3:g}."
    )


def _measured(stream: _Stream, declared: list[Finding]) -> _Stream:
    """Return the messages that have a sample, and report the others."""
    declared += stream.findings
    jumps = np.diff(stream.time_ns) > MAX_GAP / NANOSECOND
    if jumps.any():
        raise InputError(
            f"{stream.place}: the message stamped {stream.time_ns[1:][np.argmax(jumps)]} ns is more"
            " than an hour after the one before: the clock jumped; use one side by --start and"
            " --end."
        )
    lost_epochs = LostRows.of(stream.time_ns, stream.values)
    for too_many, rows, remedy in zip(
        lost_epochs.too_many,
        (lost_epochs.twice, lost_epochs.absent),
        (
            "have the stamp of another; stamp each with its own time, or import the bag with"
            " --rate-hz TABLE=HZ",
            "hold NaN; record the topic again",
        ),
        strict=True,
    ):
        if too_many:
            raise InputError(
                f"{stream.place}: {np.sum(rows)} of {len(rows)} messages {remedy} (the first is"
                f" stamped {stream.time_ns[np.argmax(rows)]} ns)."
            )
    declared += lost_epochs.findings(stream.name)
    kept = lost_epochs.kept
    return replace(stream, time_ns=stream.time_ns[kept], values=stream.values[kept])


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


def _trajectory(stream: _Stream, span: Span, declared: list[Finding]) -> Trajectory | None:
    poses = PoseRows.of(stream.values, stream.values[:, 3:7])
    if poses.refused.any():
        k = int(np.argmax(poses.refused))
        raise InputError(
            f"{stream.place}: the message stamped {stream.time_ns[k]} ns has a quaternion of"
            f" length {poses.length[k]:.6g}; write one of length 1."
        )
    declared += poses.findings(stream.name)
    values = stream.values[poses.kept]
    if not len(values) or poses.quaternion is None:
        return None
    rotation = Rotation.from_quat(poses.quaternion[poses.kept])
    velocity = values[:, 7:]
    return Trajectory(
        time=span.seconds(stream.time_ns[poses.kept]),
        world_from_body=rotation.as_matrix(),
        position_world=values[:, :3].copy(),
        # Many publishers of odometry leave the twist unfilled.
        velocity_world=rotation.apply(velocity) if velocity.any() else None,
    )
