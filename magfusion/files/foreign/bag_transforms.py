"""Transforms of a bag between two frames, composed along the tree of frames (ROS's tf2)."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation, Slerp

from magfusion.files.bag_rows import Messages
from magfusion.files.messages import FORMER_TRANSFORMS, TRANSFORMS, stamp_ns, transform_row
from magfusion.units import Array, IntArray

TRANSFORM_TYPES = (TRANSFORMS, FORMER_TRANSFORMS)
STATIC = "_static"  # behind the name of the topic with the transforms that hold at all times
MAX_MESSAGES = 1 << 17  # of a topic, in which its frames are looked for

Frames = tuple[str, str]  # parent and child


def frame_pairs(reader: AnyReader, topic: str) -> list[Frames]:
    """Return the frames of the transforms of a topic, and of the static ones that belong to it."""
    result: dict[Frames, None] = {}
    for name in _topics(reader, topic):
        for count, (_, message) in enumerate(_messages(reader, name)):
            result |= dict.fromkeys(map(_frames, message.transforms))
            if count > MAX_MESSAGES:
                break
    return list(result)


def frame_chain(pairs: Sequence[Frames], frames: Frames) -> list[tuple[Frames, bool]] | None:
    """Return the shortest chain of transforms between two frames; None where there is none.

    Each transform is given by parent and child, and whether it is inverted.
    """
    steps: dict[str, list[tuple[str, tuple[Frames, bool]]]] = defaultdict(list)
    for parent, child in pairs:
        steps[parent].append((child, ((parent, child), False)))
        steps[child].append((parent, ((parent, child), True)))
    first, last = frames
    chains: dict[str, list[tuple[Frames, bool]]] = {first: []}
    waiting = [first]
    for frame in waiting:
        for following, step in steps[frame]:
            if following not in chains:
                chains[following] = [*chains[frame], step]
                waiting.append(following)
    return chains.get(last) or None


def composed_transforms(reader: AnyReader, topic: str, frames: Frames) -> Iterator[Messages]:
    """Yield the pose of a frame in another, at the stamps of the most frequent transform.

    Between two stamps the other transforms are interpolated, as by tf2; beyond, the pose is NaN.
    """
    chain = frame_chain(frame_pairs(reader, topic), frames)
    if chain is None:
        return
    series = _series(reader, topic, {pair for pair, _ in chain})
    if len(series) < len({pair for pair, _ in chain}):
        return
    stamps = max((stamps for stamps, _ in series.values()), key=len)
    position, turn = np.zeros((len(stamps), 3)), Rotation.identity(len(stamps))
    for pair, inverted in chain:
        own_position, own_turn = _at(stamps, *series[pair])
        if inverted:
            own_turn = own_turn.inv()
            own_position = -own_turn.apply(own_position)
        position, turn = position + turn.apply(own_position), turn * own_turn
    yield Messages(stamps, np.hstack([position, turn.as_quat()]), stamps)


def _topics(reader: AnyReader, topic: str) -> list[str]:
    """Return a topic of transforms, and the topics of static ones that belong to it."""
    kinds = {c.topic: c.msgtype for c in reader.connections}
    names = dict.fromkeys((topic, f"{topic}{STATIC}", f"/tf{STATIC}"))
    return [name for name in names if kinds.get(name) in TRANSFORM_TYPES]


def _messages(reader: AnyReader, topic: str) -> Iterator[tuple[int, Any]]:
    connections = [c for c in reader.connections if c.topic == topic]
    for connection, arrived, raw in reader.messages(connections):
        yield arrived, reader.deserialize(raw, connection.msgtype)


def _frames(transform: Any) -> Frames:
    parent, child = transform.header.frame_id, transform.child_frame_id
    return parent.lstrip("/"), child.lstrip("/")


def _series(
    reader: AnyReader, topic: str, pairs: set[Frames]
) -> dict[Frames, tuple[IntArray, Array]]:
    """Return stamps (ns) and rows of some transforms, sorted; of a static one the last alone.

    The position is NaN where the rotation is none.
    """
    stamps: dict[Frames, list[int]] = defaultdict(list)
    rows: dict[Frames, list[Sequence[float]]] = defaultdict(list)
    for name in _topics(reader, topic):
        for _, message in _messages(reader, name):
            for one in message.transforms:
                pair = _frames(one)
                if pair not in pairs:
                    continue
                if name.endswith(STATIC):
                    stamps[pair], rows[pair] = [], []
                stamps[pair].append(stamp_ns(one.header))
                rows[pair].append(transform_row(one))
    result = {}
    for pair, own in stamps.items():
        times, first = np.unique(np.array(own, dtype=np.int64), return_index=True)
        values = np.array(rows[pair])[first]
        none = ~(np.linalg.norm(values[:, 3:], axis=1) > 0.0)  # also where a number is missing
        values[none] = [*[np.nan] * 3, 0.0, 0.0, 0.0, 1.0]
        result[pair] = times, values
    return result


def _at(stamps: IntArray, own: IntArray, rows: Array) -> tuple[Array, Rotation]:
    """Return position and rotation of a transform at stamps; of a single one at all of them."""
    if len(own) == 1:
        rows = np.repeat(rows, len(stamps), axis=0)
        return rows[:, :3], Rotation.from_quat(rows[:, 3:])
    # Differences of stamps first: doubles do not hold them since 1970.
    known, wanted = ((time - own[0]).astype(np.float64) for time in (own, stamps))
    position = np.stack(
        [np.interp(wanted, known, axis, np.nan, np.nan) for axis in rows[:, :3].T], axis=1
    )
    within = np.clip(wanted, known[0], known[-1])
    return position, Slerp(known, Rotation.from_quat(rows[:, 3:]))(within)
