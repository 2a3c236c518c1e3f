"""Topics of a bag as tables with the columns of a log's streams."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.bag_reader import open_bag, place_of, refuse_overlap
from magfusion.files.bag_rows import Messages, Wanted, read_parts, unstamped_text
from magfusion.files.foreign.bag_transforms import (
    TRANSFORM_TYPES,
    composed_transforms,
    frame_chain,
    frame_pairs,
)
from magfusion.files.foreign.columns import STREAMS, TIME, VELOCITY, ColumnMapping, Term
from magfusion.files.foreign.guess_by_values import likely_unit
from magfusion.files.foreign.plan import Findings, ImportPlan, Rate, Terms
from magfusion.files.foreign.source import ROWS, RowBlock, Source, SourceColumn
from magfusion.files.foreign.units import SourceUnit, accepted, parse_unit
from magfusion.files.messages import ODOMETRY, USUAL, components, stamp_ns
from magfusion.files.messages import ROWS as ROW_OF
from magfusion.units import Array, IntArray

_POSE = ("position_x", "position_y", "position_z", "qx", "qy", "qz", "qw")
_COLUMNS = {
    "imu": tuple(STREAMS["imu"])[1:],
    "magnetometer": tuple(STREAMS["magnetometer"])[1:],
    "truth": (*_POSE, *VELOCITY),
}
VECTOR = "geometry_msgs/msg/Vector3Stamped"  # of drivers that publish a field in their own unit
_ROWS = ROW_OF | {"magnetometer": ROW_OF["magnetometer"] | {VECTOR: components("vector.xyz")}}
_SI = {"imu": ("rad/s", "m/s^2"), "magnetometer": ("T",), "truth": ("m", "1", "m/s")}


@dataclass(frozen=True)
class Topic:
    """A topic that plays a role.

    `frames`: parent and child, of a topic of transforms. `unit`: of a magnetometer's field, where
    the publisher does not keep to tesla.
    """

    name: str
    msgtype: str
    frames: tuple[str, str] | None = None
    unit: str = ""


def first_stamp(paths: Sequence[Path], topic: str) -> int:
    """Return the stamp of the first message of a topic (ns); without one, its arrival.

    Raises InputError where the bag has no such topic.
    """
    with open_bag(paths) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for _, arrived, raw in reader.messages(connections) if connections else ():
            message: Any = reader.deserialize(raw, connections[0].msgtype)
            header = getattr(message, "header", None)
            return int(arrived) if header is None else stamp_ns(header) or int(arrived)
        names = ", ".join(sorted({c.topic for c in reader.connections}))
    raise InputError(f"{place_of(paths)}: has no message of {topic} for --epoch (found {names}).")


def plan_bag(
    paths: Sequence[Path],
    entries: Mapping[str, Sequence[ColumnMapping]],
    rates: Mapping[str, Rate],
    others: Collection[str],
    declared: Findings,
) -> list[ImportPlan]:
    """Return how the topics of a bag become streams; what is undecided is added to ``declared``.

    Raises InputError where the bag cannot be read.

    Parameters
    ----------
    paths : sequence of Path
        Bags of one recording.
    entries : mapping of sequence of ColumnMapping
        The user's choice for each stream: a topic, and frames or a unit behind it.
    rates : mapping of Rate
        Of streams whose messages are counted, whatever their stamps.
    others : collection of str
        Streams that come from elsewhere.
    """
    plans, place = [], place_of(paths)
    with open_bag(paths) as reader:
        declared.notes += reader.notes
        result = sorted({(c.topic, c.msgtype) for c in reader.connections})
        for role in _COLUMNS:
            if role in others:
                continue
            topic = _chosen(place, role, entries.get(role, ()), result, reader, declared)
            if topic is not None and topic.msgtype == VECTOR and not topic.unit:
                _propose_unit(paths, place, topic, declared)
            elif topic is not None:
                refuse_overlap(reader, topic.name)
                unit = parse_unit(topic.unit or "T", STREAMS["magnetometer"]["field_x"])
                if unit is None:
                    declared.problems.append(
                        f"{place}: --map '{role}={topic.name}[{topic.unit}]': write one of"
                        f" {accepted(STREAMS['magnetometer']['field_x'])}."
                    )
                else:
                    own = [c for c in reader.connections if c.topic == topic.name]
                    count = sum(connection.msgcount for connection in own)
                    rate = rates.get(role)
                    plans.append(_plan(paths, role, topic, unit, count, rate, declared.notes))
    return plans


def _chosen(
    place: str,
    role: str,
    entries: Sequence[ColumnMapping],
    result: Sequence[tuple[str, str]],
    reader: AnyReader,
    declared: Findings,
) -> Topic | None:
    for column in (entry for entry in entries if entry.column):
        declared.problems.append(
            f"{place}: --map '{column}': a bag's columns are known; name the topic, as"
            f" {role}=/topic."
        )
        return None
    if entries:
        return _selected_topic(place, role, entries[0], result, reader, declared)
    fitting = _fitting(result, role)
    if len(fitting) == 1:
        return Topic(*fitting[0])
    if fitting:
        names = ", ".join(name for name, _ in fitting)
        declared.problems.append(f"{place}: several topics may be {role}: {names}; name one.")
        declared.proposals.append(f"{role}={fitting[0][0]}")
    elif role == "magnetometer":
        names = ", ".join(f"{name} ({kind})" for name, kind in result) or "none"
        kinds = " or ".join(_ROWS[role])
        alone = any(_fitting(result, "imu"))
        (declared.notes if alone else declared.problems).append(
            f"{place}: no topic is of {kinds}, for {role} (found {names})."
        )
    return None


def _propose_unit(paths: Sequence[Path], place: str, topic: Topic, declared: Findings) -> None:
    """Request the unit of a field whose messages do not declare it."""
    parts = (np.linalg.norm(v, axis=1) for _, v in _rows(paths, place, "magnetometer", topic))
    size = next(parts, np.zeros(0))
    declared.problems.append(
        f"{place}: messages of {topic.msgtype} give no unit, for magnetometer={topic.name} (median"
        f" size {np.median(size) if len(size) else np.nan:.4g})."
    )
    unit = likely_unit(STREAMS["magnetometer"]["field_x"], size)
    declared.proposals.append(f"magnetometer={topic.name}[{unit}]")


def _fitting(result: Sequence[tuple[str, str]], role: str) -> list[tuple[str, str]]:
    """Return the topics of a type for a role: of the usual ones, if there are such."""
    fitting = [one for one in result if one[1] in _ROWS[role]]
    usual = [one for one in fitting if one[1] in USUAL] or fitting
    return [one for one in usual if one[1] != VECTOR or "mag" in one[0].casefold()]


def _selected_topic(
    place: str,
    role: str,
    entry: ColumnMapping,
    result: Sequence[tuple[str, str]],
    reader: AnyReader,
    declared: Findings,
) -> Topic | None:
    read = re.fullmatch(
        r"(?P<name>[^:\[\]]+?)(:(?P<parent>.+?)->(?P<child>.+?))?(\[(?P<unit>.*)\])?", entry.value
    )
    name = entry.value if read is None else read["name"]
    kind = dict(reversed(result)).get(name)  # of two of a name the first
    if read is None or kind is None:
        names = ", ".join(topic for topic, _ in result)
        declared.problems.append(f"{place}: has no topic {name} for {role} (found {names}).")
        return None
    unit = read["unit"] or ""
    if role == "truth" and kind in TRANSFORM_TYPES:
        frames = (read["parent"] or "", read["child"] or "")
        there = _has_transform(place, name, frames, reader, declared)
        return Topic(name, kind, frames) if there else None
    if kind not in _ROWS[role]:
        declared.problems.append(
            f"{place}: topic {name} is of {kind}, which is none of {', '.join(_ROWS[role])} for"
            f" {role}; name another."
        )
        return None
    if unit and role != "magnetometer":
        declared.problems.append(f"{place}: --map '{entry}': messages of {kind} are in SI units.")
        return None
    return Topic(name, kind, None, unit)


def _has_transform(
    place: str, name: str, frames: tuple[str, str], reader: AnyReader, declared: Findings
) -> bool:
    """Check that a topic leads from one frame to another; what it has instead is proposed."""
    pairs = frame_pairs(reader, name)
    if frame_chain(pairs, frames) is not None:
        return True
    shown = ", ".join(f"{a}->{b}" for a, b in pairs)
    declared.problems.append(
        f"{place}: topic {name} has no transform {'->'.join(frames)} (found {shown});"
        " write world and body as truth=TOPIC:PARENT->CHILD."
    )
    declared.proposals += [f"truth={name}:{a}->{b}" for a, b in pairs[:5]]
    return False


def _plan(
    paths: Sequence[Path],
    role: str,
    topic: Topic,
    field_unit: SourceUnit,
    count: int,
    rate: Rate | None,
    notes: list[str],
) -> ImportPlan:
    place = f"{place_of(paths)} topic {topic.name}"
    columns = _COLUMNS[role]

    def read(wanted: Sequence[int], _texts: Collection[int]) -> Iterator[RowBlock]:
        row = 0
        for stamps, values in _rows(paths, place, role, topic, notes):
            table = [stamps, *values.T]
            yield RowBlock([table[k] for k in wanted], row + np.arange(len(stamps)))
            row += len(stamps)

    usual: Terms = {TIME: (Term(0, _unit("ns", role, TIME)),)}
    for k, name in enumerate(columns, start=1):
        si = next(s for s in _SI[role] if parse_unit(s, STREAMS[role][name]) is not None)
        unit = field_unit if role == "magnetometer" else _unit(si, role, name)
        usual[name] = (Term(k, unit),)
    if role == "truth" and not _moves(paths, place, topic):
        usual = {name: terms for name, terms in usual.items() if name not in VELOCITY}
    known = (SourceColumn(TIME), *map(SourceColumn, columns))
    source = Source(place, known, read, form=topic.msgtype, count=count)
    if rate is not None:
        del usual[TIME]
        if rate.start_s is None:
            rate = replace(rate, start_s=_first_sample(_rows(paths, place, role, topic), rate.hz))
    return ImportPlan(role, source, usual, rate)


def _first_sample(rows: Iterator[tuple[IntArray, Array]], hz: Fraction) -> Fraction:
    """Return the time of the first sample (s); of a batch with one stamp the last keeps it."""
    stamps = next((stamps for stamps, _ in rows), np.zeros(1, dtype=np.int64))
    before = int(np.sum(stamps == stamps[0])) - 1
    return Fraction(int(stamps[0]), 10**9) - before / hz


def _unit(name: str, role: str, target: str) -> SourceUnit:
    return SourceUnit(name, STREAMS[role][target])


def _moves(paths: Sequence[Path], place: str, topic: Topic) -> bool:
    """Return whether an odometry has a twist: many publishers leave it unfilled."""
    if topic.msgtype != ODOMETRY:
        return False
    return any(values[:, len(_POSE) :].any() for _, values in _rows(paths, place, "truth", topic))


def _rows(
    paths: Sequence[Path], place: str, role: str, topic: Topic, notes: list[str] | None = None
) -> Iterator[tuple[IntArray, Array]]:
    """Yield stamps (ns) and values of the messages of a topic, `ROWS` at a time.

    Notes on a damaged file are added at the end.
    """
    row = _ROWS[role].get(topic.msgtype)
    with open_bag(paths) as reader:
        connections = [c for c in reader.connections if c.topic == topic.name]
        if row is None:
            parts = composed_transforms(reader, topic.name, topic.frames or ("", ""))
        else:
            parts = (p for _, p in read_parts(reader, {role: Wanted(place, connections, row)}))
        unstamped: bool | None = None
        for part in _joined(parts):
            if unstamped is None and (unstamped := part.unstamped) and notes is not None:
                notes.append(unstamped_text(role, int(part.stamps[0])))
            yield part.arrived if unstamped else part.stamps, _complete(role, part.values)
        if notes is not None:
            notes += [note for note in reader.damage if note not in notes]


def _joined(parts: Iterator[Messages]) -> Iterator[Messages]:
    """Yield parts of at least `ROWS`, but for the last."""
    waiting: list[Messages] = []
    count = 0
    for part in parts:
        waiting.append(part)
        count += len(part.stamps)
        if count >= ROWS:
            yield Messages(*map(np.concatenate, zip(*waiting, strict=True)))
            waiting, count = [], 0
    if waiting:
        yield Messages(*map(np.concatenate, zip(*waiting, strict=True)))


def _complete(role: str, values: Array) -> Array:
    """Return rows with a velocity in world axes behind a truth's pose."""
    if role != "truth":
        return values
    velocity = np.zeros((len(values), 3))
    if values.shape[1] > len(_POSE):
        turn = values[:, 3:7].copy()
        turn[~(np.linalg.norm(turn, axis=1) > 0.0)] = [0.0, 0.0, 0.0, 1.0]
        velocity = Rotation.from_quat(turn).apply(values[:, len(_POSE) :])
    return np.hstack([values[:, : len(_POSE)], velocity])
