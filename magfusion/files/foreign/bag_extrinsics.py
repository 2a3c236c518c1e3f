"""Mounting of the magnetometer against the IMU, along the static transforms of a bag."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.bag import role_connections
from magfusion.files.bag_reader import open_bag
from magfusion.files.bag_topics import Topics
from magfusion.files.foreign.bag_transforms import (
    Frames,
    composed_transforms,
    frame_chain,
    frame_pairs,
)
from magfusion.files.messages import ROWS
from magfusion.units import Array

STATIC_TOPIC = "/tf_static"


class Extrinsics(NamedTuple):
    """Pose of the magnetometer in the IMU's axes, and the chain of frames that gives it.

    `position_body` (3,) (m). `chain`: ``imu_link -> base_link -> mag_link``.
    """

    position_body: Array
    body_from_sensor: Rotation
    chain: str


def read_extrinsics(path: Path, topics: Topics | None = None) -> Extrinsics:
    """Return the mounting of a bag's magnetometer against its IMU.

    The frames are those of the messages' headers. `topics`: of a bag with several IMUs or
    magnetometers. Raises InputError where the bag lacks a sensor or has several, or its static
    transforms give no chain between their frames, or more than one.
    """
    with open_bag([path]) as reader:
        frames = tuple(_frame(reader, path, role, topics) for role in ("imu", "magnetometer"))
        first, last = frames
        if first == last:
            chain = f"{first} is the frame of both"
            return Extrinsics(np.zeros(3), Rotation.identity(), chain)
        pairs = frame_pairs(reader, STATIC_TOPIC)
        _refuse_two_parents(path, pairs)
        steps = frame_chain(pairs, (first, last))
        poses = list(composed_transforms(reader, STATIC_TOPIC, (first, last)))
    if steps is None or not poses:
        known = ", ".join(f"{parent}->{child}" for parent, child in pairs) or "none"
        raise InputError(
            f"{path}: {STATIC_TOPIC} has no chain of transforms from {first} (IMU) to {last}"
            f" (magnetometer; found {known}); give --lever and --mounting instead"
        )
    row = poses[0].values[0]
    if not np.isfinite(row).all():
        raise InputError(
            f"{path}: {STATIC_TOPIC} has a transform without a rotation between {first} and {last};"
            " give --lever and --mounting instead"
        )
    names = [first, *(pair[0] if inverted else pair[1] for pair, inverted in steps)]
    return Extrinsics(row[:3], Rotation.from_quat(row[3:]), " -> ".join(names))


def _frame(reader: AnyReader, path: Path, role: str, topics: Topics | None) -> str:
    """Return the frame of the messages of a sensor."""
    named = None if topics is None else getattr(topics, role)
    connections = role_connections(reader, path, named, role, tuple(ROWS[role]))
    if not connections:
        raise InputError(
            f"{path}: has no messages of the {role}, whose frame is needed; give --lever and"
            " --mounting instead"
        )
    for connection, _, raw in reader.messages(connections):
        message: Any = reader.deserialize(raw, connection.msgtype)
        frame = str(message.header.frame_id).lstrip("/")
        if frame:
            return frame
        break
    raise InputError(
        f"{path}: the messages of {connections[0].topic} name no frame (header.frame_id); give"
        " --lever and --mounting instead"
    )


def _refuse_two_parents(path: Path, pairs: Sequence[Frames]) -> None:
    parents: dict[str, list[str]] = defaultdict(list)
    for parent, child in pairs:
        parents[child].append(parent)
    for child, own in parents.items():
        if len(own) > 1:
            raise InputError(
                f"{path}: {STATIC_TOPIC} gives {child} several parents ({', '.join(own)}), so that"
                " its place is ambiguous; keep one, or give --lever and --mounting instead"
            )
