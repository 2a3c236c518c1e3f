"""A hall as a YAML file: walls, places for beacons, places without, and where to navigate."""

import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, PlainValidator

from magfusion.errors import InputError
from magfusion.files.site_values import MAX_DISTANCE, refusal
from magfusion.files.yaml_files import StrictModel, read_yaml
from magfusion.model.hall import Hall, Mounts, Prism
from magfusion.units import Array

MIN_SIZE = 0.1  # m; nothing smaller is a hall
MAX_CORNERS = 200


def _number(value: object) -> bool:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and math.isfinite(value)
        and abs(value) <= MAX_DISTANCE
    )


def _pair(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(_number(v) for v in value)


def _polygon(value: object) -> Array:
    """Read the corners of a polygon whose edges do not cross."""
    if (
        isinstance(value, list)
        and 3 <= len(value) <= MAX_CORNERS
        and all(_pair(corner) for corner in value)
    ):
        corners = np.array(value, dtype=float)
        edges = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        long = np.all(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) >= MIN_SIZE)
        if long and not _crossed(edges):
            return corners
    raise refusal(
        "give the corners in their order, three or more lists [x, y] in m, such that no edges cross"
        f" and none is shorter than {MIN_SIZE:g} m"
    )


def _crossed(edges: Array) -> bool:
    """Return whether edges that are no neighbours meet."""
    count = len(edges)
    for i in range(count):
        for j in range(i + 2, count):
            neighbours = i == 0 and j == count - 1
            if not neighbours and _meet(edges[i], edges[j]):
                return True
    return False


def _meet(one: Array, other: Array) -> bool:
    def side(edge: Array, point: Array) -> float:
        way, to = edge[1] - edge[0], point - edge[0]
        return float(way[0] * to[1] - way[1] * to[0])

    separate = side(one, other[0]) * side(one, other[1]), side(other, one[0]) * side(other, one[1])
    if separate[0] > 0.0 or separate[1] > 0.0:
        return False
    low, high = (
        np.maximum(one.min(axis=0), other.min(axis=0)),
        np.minimum(one.max(axis=0), other.max(axis=0)),
    )
    return bool(np.all(low <= high))


def _heights(value: object) -> Array:
    """Read a lowest and a highest height."""
    if _pair(value):
        low, high = np.array(value, dtype=float)
        if low <= high:
            return np.array([low, high])
    raise refusal("give two heights in m, the lower one first")


def _has_size(prism: Array) -> Array:
    if prism[1] - prism[0] < MIN_SIZE:
        raise refusal(f"give two heights at least {MIN_SIZE:g} m apart")
    return prism


_Polygon = Annotated[Array, PlainValidator(_polygon)]
_Heights = Annotated[Array, PlainValidator(_heights)]


Surface = Literal["walls", "ceiling", "floor"]


def _walls() -> list[Surface]:
    return ["walls"]


class RoomEntry(StrictModel):
    """The hall itself."""

    polygon_m: _Polygon
    height_m: Annotated[Array, PlainValidator(_heights), AfterValidator(_has_size)]


class ForbiddenEntry(StrictModel):
    """A place without beacons; of any height where none is given."""

    polygon_m: _Polygon
    height_m: _Heights | None = None


class MountEntry(StrictModel):
    """Where beacons may be mounted."""

    surfaces: Annotated[list[Surface], Field(min_length=1)] = Field(default_factory=_walls)
    walls: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)] | None = None
    height_m: _Heights | None = None


class UseEntry(StrictModel):
    """Where it is to be navigated; all of the hall by default."""

    polygon_m: _Polygon | None = None
    height_m: _Heights | None = None
    margin_m: Annotated[float, Field(ge=0.0, le=MAX_DISTANCE)] = 0.0


def _first_version(value: int) -> int:
    if value != 1:
        raise refusal("write 1, the version of the format")
    return value


class HallEntry(StrictModel):
    """The whole file."""

    magfusion_hall: Annotated[int, AfterValidator(_first_version)]
    hall: RoomEntry
    mount: MountEntry = MountEntry()
    forbidden: list[ForbiddenEntry] = Field(default_factory=list)
    use: UseEntry = UseEntry()


def load_hall(path: Path) -> Hall:
    """Read a hall from its YAML file.

    Raises InputError where a key is unknown, missing or out of range, or where what is used or
    mounted on is not in the hall; the sentence names the file, the key, what was found and the
    remedy.
    """
    entry = read_yaml(path, HallEntry)
    room = Prism(entry.hall.polygon_m, entry.hall.height_m)
    use, mount = entry.use, entry.mount.height_m
    walls = tuple(range(len(room.polygon)) if entry.mount.walls is None else entry.mount.walls)
    _check_inside(entry, room, walls, path)
    forbidden = tuple(
        Prism(one.polygon_m, np.array([-math.inf, math.inf]) if h is None else h)
        for one in entry.forbidden
        for h in [one.height_m]
    )
    return Hall(
        room=room,
        mounts=Mounts(
            walls=walls if "walls" in entry.mount.surfaces else (),
            heights=room.heights if mount is None else mount,
            ceiling="ceiling" in entry.mount.surfaces,
            floor="floor" in entry.mount.surfaces,
            forbidden=forbidden,
        ),
        use=Prism(
            room.polygon if use.polygon_m is None else use.polygon_m,
            room.heights if use.height_m is None else use.height_m,
        ),
        margin=use.margin_m,
    )


def _check_inside(entry: HallEntry, room: Prism, walls: tuple[int, ...], path: Path) -> None:
    """Refuse walls that the hall has not, and heights beyond its own."""
    corners = len(room.polygon)
    for i, wall in enumerate(walls):
        if wall >= corners:
            raise InputError(
                f"{path}: mount.walls[{i}]: found {wall}; the hall has walls 0 to {corners - 1},"
                " wall 0 from its first corner to its second."
            )
    for key, given in (
        ("mount.height_m", entry.mount.height_m),
        ("use.height_m", entry.use.height_m),
    ):
        if given is not None and (given[0] < room.heights[0] or given[1] > room.heights[1]):
            raise InputError(
                f"{path}: {key}: found {given.tolist()}; give heights between those of the hall,"
                f" {room.heights[0]:g} m and {room.heights[1]:g} m."
            )
