"""Hall geometry: its walls, the mounting places for beacons, and the volume to navigate in."""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array, BoolArray

ON_THE_LINE = 1e-6  # m; distance from an edge


@dataclass(frozen=True, eq=False)
class Prism:
    """Volume over a polygon, between two heights."""

    polygon: Array  # (k, 2), corners in order, world x and y (m)
    heights: Array  # (2,), lowest and highest (m)

    @property
    def box_world(self) -> Array:
        """Lower and upper corner of the bounding box, shape (2, 3) (m)."""
        low, high = self.polygon.min(axis=0), self.polygon.max(axis=0)
        return np.array([[*low, self.heights[0]], [*high, self.heights[1]]])

    @property
    def edges(self) -> Array:
        """Both ends of each edge, shape (k, 2, 2) (m); the first begins at the first corner."""
        return np.stack([self.polygon, np.roll(self.polygon, -1, axis=0)], axis=1)

    def contains(self, points: Array) -> BoolArray:
        """Return whether points (n, 3) are inside or on the surface."""
        low, high = self.heights[0] - ON_THE_LINE, self.heights[1] + ON_THE_LINE
        between = (points[:, 2] >= low) & (points[:, 2] <= high)
        return between & self.over(points[:, :2])

    def over(self, plan: Array) -> BoolArray:
        """Return whether points (n, 2) are in the polygon or on one of its edges."""
        x, y = plan.T
        inside = np.zeros(len(plan), dtype=bool)
        for (ax, ay), (bx, by) in self.edges:
            if ay == by:
                continue
            crossing = (ay > y) != (by > y)
            inside ^= crossing & (x < ax + (y - ay) * (bx - ax) / (by - ay))
        return np.asarray(inside | (self.from_edges(plan) < ON_THE_LINE))

    def from_edges(self, plan: Array) -> Array:
        """Return the distance of points (n, 2) from the nearest edge (m)."""
        least = np.full(len(plan), np.inf)
        for start, end in self.edges:
            way = end - start
            share = np.clip((plan - start) @ way / (way @ way), 0.0, 1.0)
            foot = start + share[:, None] * way
            least = np.minimum(least, np.linalg.norm(plan - foot, axis=1))
        return least


def prism_of(box_world: Array) -> Prism:
    """Return a box (lower and upper corner, shape (2, 3)) as a prism of four edges."""
    (x, y, low), (right, back, high) = box_world
    corners = [[x, y], [right, y], [right, back], [x, back]]
    return Prism(np.array(corners), np.array([low, high]))


@dataclass(frozen=True, eq=False)
class Mounts:
    """Mounting places for beacons in a hall."""

    walls: tuple[int, ...]  # edges of the hall's polygon, counted from 0
    heights: Array  # (2,), heights of mounting on walls (m)
    ceiling: bool = False
    floor: bool = False
    forbidden: tuple[Prism, ...] = ()  # volumes without mounting places


@dataclass(frozen=True, eq=False)
class Hall:
    """A hall and the volume to navigate in."""

    room: Prism
    mounts: Mounts
    use: Prism  # volume to navigate in
    margin: float = 0.0  # distance from the walls that is not used (m)


def points_of_use(hall: Hall, spacing: float) -> Array:
    """Return grid points in the volume to navigate in, shape (n, 3) (m).

    `spacing`: largest distance of neighbours along an axis (m).
    """
    low, high = hall.use.box_world
    inside = np.array([hall.margin, hall.margin, 0.0])
    low = np.maximum(low, hall.room.box_world[0] + inside)  # includes the margin itself
    high = np.maximum(np.minimum(high, hall.room.box_world[1] - inside), low)
    x, y, z = (_steps(low[i], high[i], spacing) for i in range(3))
    mesh = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    wanted = hall.use.over(mesh[:, :2]) & hall.room.over(mesh[:, :2])
    if hall.margin > 0.0:
        wanted &= hall.room.from_edges(mesh[:, :2]) >= hall.margin - ON_THE_LINE
    return np.asarray(mesh[wanted])


def mounting_places(hall: Hall, spacing: float) -> Array:
    """Return mounting places for beacons, on a grid of each surface, shape (n, 3) (m)."""
    mounts, room = hall.mounts, hall.room
    heights = _steps(mounts.heights[0], mounts.heights[1], spacing)
    result = []
    for wall in mounts.walls:
        start, end = room.edges[wall]
        share = _steps(0.0, 1.0, spacing / float(np.linalg.norm(end - start)))[:, None]
        along = start + share * (end - start)
        plan = np.repeat(along, len(heights), axis=0)
        result.append(np.column_stack([plan, np.tile(heights, len(along))]))
    low, high = room.box_world
    flat = np.meshgrid(*(_steps(low[i], high[i], spacing) for i in (0, 1)), indexing="ij")
    plan = np.stack(flat, axis=-1).reshape(-1, 2)
    plan = plan[room.over(plan)]
    for wanted, height in ((mounts.floor, low[2]), (mounts.ceiling, high[2])):
        if wanted:
            result.append(np.column_stack([plan, np.full(len(plan), height)]))
    places = np.concatenate(result) if result else np.zeros((0, 3))
    places = np.unique(np.round(places, 6), axis=0)  # corners belong to two walls
    for prism in mounts.forbidden:
        places = places[~prism.contains(places)]
    return np.asarray(places)


def _steps(low: float, high: float, spacing: float) -> Array:
    """Return evenly spaced numbers over an interval, both ends included."""
    return np.linspace(low, high, int(np.ceil((high - low) / spacing * (1.0 - 1e-9))) + 1)
