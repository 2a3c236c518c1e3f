"""Region of the magnetometer: a room, one side of a plane, or the front of a beacon.

The field of a dipole is even in the offset, so that a single beacon has a second solution on its
opposite side; a region excludes it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """One side of a plane."""

    normal_world: Array  # (3,), normal of any length, towards the magnetometer
    through_world: Array  # (3,), a point of the plane (m)


@dataclass(frozen=True, eq=False)
class Region:
    """Region that contains the magnetometer, independent of the fields."""

    # (2, 3), lower and upper corner (m); infinite where there is no limit
    box_world: Array | None = None
    half_space: HalfSpace | None = None


class _Source(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def position_world(self) -> Array: ...
    @property
    def world_from_beacon(self) -> Array: ...
    @property
    def hemisphere_beacon(self) -> Array | None: ...


class Bounds(NamedTuple):
    """Planes that bound the magnetometer's position."""

    normal_world: Array  # (k, 3), unit vectors inwards
    offset: Array  # (k,), inside, ``normal_world @ position`` is larger (m)
    names: tuple[str, ...]  # of the planes, for messages

    def margin(self, position_world: Array) -> Array:
        """Return the distance inside each plane, shape (..., k) (m); negative outside."""
        return np.asarray(position_world @ self.normal_world.T - self.offset)


def bounds_of(region: Region | None, sources: Sequence[_Source]) -> Bounds | None:
    """Return the planes of a region and of the hemispheres of beacons; None if there are none.

    `sources`: a beacon of unknown position adds no plane.
    """
    result: list[tuple[Array, float, str]] = []
    box = None if region is None else region.box_world
    if box is not None:
        for axis, letter in enumerate("xyz"):
            for corner, sign, side in ((0, 1.0, "lower"), (1, -1.0, "upper")):
                if np.isfinite(box[corner, axis]):
                    limit = float(sign * box[corner, axis])
                    result.append((sign * np.eye(3)[axis], limit, f"the {side} limit of {letter}"))
    half = None if region is None else region.half_space
    if half is not None:
        normal = half.normal_world / np.linalg.norm(half.normal_world)
        result.append((normal, float(normal @ half.through_world), "the plane of the region"))
    for source in sources:
        if source.hemisphere_beacon is not None:
            normal = source.world_from_beacon @ source.hemisphere_beacon
            normal = normal / np.linalg.norm(normal)
            offset = float(normal @ source.position_world)
            if np.isfinite(offset) and np.all(np.isfinite(normal)):
                result.append((normal, offset, f"the plane through beacon {source.name}"))
    if not result:
        return None
    normals, offsets, names = zip(*result, strict=True)
    return Bounds(np.array(normals), np.array(offsets), tuple(names))
