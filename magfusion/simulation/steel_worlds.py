"""Rooms with steel, drawn at random: compact bodies, a mesh, racks, pipes, cabinets."""

from collections.abc import Callable
from itertools import product

import numpy as np

from magfusion.errors import InputError
from magfusion.files.steel_file import SteelEntry
from magfusion.simulation.disturbance import CLEARANCE, draw_spheres
from magfusion.simulation.pipe import Pipe
from magfusion.simulation.steel import Ball, Bar, Body, Sheet, SteelStructure
from magfusion.units import Array

BEACON_CLEARANCE = 0.4  # m
BODY_CLEARANCE = 0.1  # m from one piece to the next
AROUND = 1.0  # m beyond the beacons and the body's range: where steel is placed
ATTEMPTS = 500  # to place one piece
NEAREST = 0.3  # m; about the length of an element
UP = 2


class _Room:
    """Boxes that pieces occupy in a room, and where the next piece may be."""

    def __init__(self, rng: np.random.Generator, box_world: Array, beacons_world: Array) -> None:
        self.rng, self._box, self._beacons = rng, box_world, beacons_world
        every = np.concatenate([box_world, beacons_world])
        self.low, self.high = every.min(axis=0) - 0.2, every.max(axis=0) + 0.2
        self._occupied: list[Array] = []

    def place(self, size: Array, standing: bool) -> Array:
        """Return the lower corner (m) of a free box of a size (3,) (m)."""
        low, high = self.low - AROUND, self.high + AROUND - size
        if standing:
            low[UP] = high[UP] = self.low[UP]
        for corner in self.rng.uniform(low, np.maximum(low, high), (ATTEMPTS, 3)):
            own = np.stack([corner, corner + size])
            if self._is_free(own):
                self._occupied.append(own)
                return np.asarray(corner)
        raise InputError(
            f"--steel: no room for a piece of {np.round(size, 1).tolist()} m around the range of"
            " the body; give another seed, or a smaller --box"
        )

    def _is_free(self, own: Array) -> bool:
        beacons = [np.stack([one, one]) for one in self._beacons]
        limits = [(self._box, CLEARANCE), *((one, BEACON_CLEARANCE) for one in beacons)]
        limits += [(one, BODY_CLEARANCE) for one in self._occupied]
        return all(_gap(own, other) > least for other, least in limits)


def _gap(first: Array, second: Array) -> float:
    """Return the distance between boxes of corners (2, 3) (m), zero where they overlap."""
    return float(
        np.linalg.norm(np.maximum(0.0, np.maximum(first[0] - second[1], second[0] - first[1])))
    )


def draw_steel(
    kind: str, rng: np.random.Generator, box_world: Array, beacons_world: Array
) -> SteelStructure:
    """Return the steel of a random room.

    `kind`: one of `KINDS`. `box_world` (2, 3): lower and upper corner of the body's range (m),
    which no piece enters. `beacons_world` (beacons, 3) (m). Raises InputError if the pieces do not
    fit.
    """
    if kind == "spheres":
        return _spheres(rng, box_world, beacons_world)
    return SteelStructure(tuple(_DRAWN[kind](_Room(rng, box_world, beacons_world))))


def structure_of(entry: SteelEntry) -> SteelStructure:
    """Return the steel that a file describes."""
    out: list[Body] = [
        Ball(one.centre_m, one.radius_m, one.permeability, one.conductivity_s_m)
        for one in entry.spheres
    ]
    for bar in entry.bars:
        wall, material = bar.wall_m or bar.radius_m, (bar.permeability, bar.conductivity_s_m)
        out.append(Bar(Pipe(bar.start_m, bar.end_m, bar.radius_m, wall, *material)))
    for sheet in entry.sheets:
        sides, material = (
            (sheet.first_side_m, sheet.second_side_m),
            (sheet.permeability, sheet.conductivity_s_m),
        )
        out.append(Sheet(sheet.corner_m, *sides, sheet.thickness_m, *material))
    return SteelStructure(tuple(out))


def check_clear(steel: SteelStructure, box_world: Array, beacons_world: Array, source: str) -> None:
    """Refuse elements of steel too close for their moments to be dipoles.

    Raises InputError if the middle of one is nearer than `NEAREST` to the body's range or to a
    beacon.
    """
    points = steel.points_world()
    to_box = np.linalg.norm(points - np.clip(points, *box_world), axis=1)
    to_beacon = np.linalg.norm(points[:, None] - beacons_world, axis=2).min(axis=1, initial=np.inf)
    near = float(np.min(np.minimum(to_box, to_beacon), initial=np.inf))
    if near < NEAREST:
        raise InputError(
            f"{source}: steel comes within {near:.2g} m of the platform's range (--box) or of a"
            f" beacon; keep a distance of {NEAREST:g} m from the middle of its elements"
        )


def _spheres(rng: np.random.Generator, box_world: Array, beacons_world: Array) -> SteelStructure:
    drawn = draw_spheres(rng, int(rng.integers(6, 13)), box_world, beacons_world, (0.1, 0.3))
    pairs = zip(drawn.position_world, drawn.radius, strict=True)
    return SteelStructure(tuple(Ball(centre, float(radius)) for centre, radius in pairs))


def _mesh(room: _Room) -> list[Body]:
    """Return crossing bars in floor and wall, each for a bundle of those closer in reality."""
    rng, out = room.rng, list[Body]()
    below = rng.uniform(0.1, 0.4)
    low, high = room.low - 0.5, room.high + 0.5
    low[UP] = room.low[UP] - below
    wall, upper = int(rng.integers(2)), bool(rng.integers(2))
    spacing, radius = rng.uniform(0.35, 0.5), rng.uniform(6e-3, 1e-2)
    for normal in (UP, wall):
        at = high[normal] if normal == wall and upper else low[normal]
        at += 0.5 * spacing * (normal == wall) * (1.0 if upper else -1.0)
        for along, across in ((a, b) for a in range(3) for b in range(3)):
            if len({normal, along, across}) == 3:
                for place in np.arange(low[across], high[across], spacing):
                    start, end = low.copy(), high.copy()
                    start[across] = end[across] = place
                    start[normal] = end[normal] = at
                    end[along] -= (end[along] - start[along]) % spacing
                    # Bars cross where their segments meet.
                    start[normal] += 2.0 * radius * (along > across)
                    end[normal] = start[normal]
                    bar = Pipe(start, end, radius, radius, segment=spacing * (1.0 + 1e-6))
                    out.append(Bar(bar))
    return out


def _tube(start: Array, end: Array, radius: float, wall: float, segment: float = 0.25) -> Bar:
    return Bar(Pipe(np.asarray(start), np.asarray(end), radius, wall, segment=segment))


def _racks(room: _Room) -> list[Body]:
    """Return racks of four posts, with a frame of four beams at each shelf."""
    rng, out = room.rng, list[Body]()
    for _ in range(int(rng.integers(2, 5))):
        size = np.array([rng.uniform(1.0, 2.4), rng.uniform(0.4, 0.7), rng.uniform(1.6, 2.4)])
        if rng.integers(2):
            size[:2] = size[1::-1]
        corner, shelves = room.place(size, standing=True), int(rng.integers(3, 6))
        post, beam = rng.uniform(0.015, 0.03, 2)
        thick = rng.uniform(1e-3, 2.5e-3)
        level = size[UP] / shelves
        for x, y in product((0.0, 1.0), repeat=2):
            foot = corner + size * np.array([x, y, 0.0])
            top = foot + np.array([0.0, 0.0, size[UP]])
            out.append(_tube(foot, top, post, thick, level * (1.0 + 1e-6)))
        for k, axis, side in product(range(1, shelves + 1), (0, 1), (0.0, 1.0)):
            start = corner.copy()
            start[UP] += k * level
            start[1 - axis] += side * size[1 - axis]
            end = start.copy()
            end[axis] += size[axis]
            out.append(_tube(start, end, beam, thick, 0.4))
    return out


def _pipes(room: _Room) -> list[Body]:
    rng, out = room.rng, list[Body]()
    for _ in range(int(rng.integers(3, 8))):
        radius, axis = rng.uniform(0.03, 0.12), int(rng.choice(3, p=[0.4, 0.4, 0.2]))
        size = np.full(3, 2.0 * radius)
        size[axis] = rng.uniform(2.0, 6.0) if axis != UP else rng.uniform(2.0, 3.0)
        corner = room.place(size, standing=axis == UP)
        start, end = corner + radius, corner + size - radius
        start[axis], end[axis] = corner[axis], corner[axis] + size[axis]
        out.append(_tube(start, end, radius, rng.uniform(3e-3, 6e-3)))
    return out


def _cabinets(room: _Room) -> list[Body]:
    """Return closed cabinets of five sheets, without a bottom, and a lying or standing plate."""
    rng, out = room.rng, list[Body]()
    for _ in range(int(rng.integers(2, 5))):
        size = np.array([rng.uniform(0.5, 1.0), rng.uniform(0.4, 0.6), rng.uniform(0.8, 2.0)])
        if rng.integers(2):
            size[:2] = size[1::-1]
        corner, thick = room.place(size, standing=True), rng.uniform(0.7e-3, 1.5e-3)
        side = np.diag(size)
        for normal, far in ((0, 0), (0, 1), (1, 0), (1, 1), (UP, 1)):
            first, second = side[(normal + 1) % 3], side[(normal + 2) % 3]
            out.append(Sheet(corner + far * side[normal], first, second, thick))
    size = rng.uniform(0.6, 1.5, 3)
    normal, thick = int(rng.integers(3)), rng.uniform(1e-3, 4e-3)
    size[normal] = 0.02
    corner, side = room.place(size, standing=False), np.diag(size)
    out.append(Sheet(corner, side[(normal + 1) % 3], side[(normal + 2) % 3], thick))
    return out


_DRAWN: dict[str, Callable[[_Room], list[Body]]] = {
    "mesh": _mesh,
    "racks": _racks,
    "pipes": _pipes,
    "cabinets": _cabinets,
}
KINDS = ("spheres", *_DRAWN)
