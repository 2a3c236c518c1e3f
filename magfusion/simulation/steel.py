"""Steel of a room: spheres, bars, pipes and sheets, each with the field of all the others.

Bodies are cut into elements of one scalar moment.  A stick is magnetised along its length and has
two poles, which it shares with its neighbours, so that flux passes a joint; a point is a dipole: a
sphere, a pipe across its axis, or a current loop of a sheet.  With the field ``K m`` that moments m
need, without coupling, and the field ``T m`` that they cause in each other, ``(K - T) m = B``
is solved at each tone.  Contacts carry flux, but no current from one body to the next.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import block_diag

from magfusion.errors import InputError
from magfusion.model.physics.disturbance import sphere_polarizability
from magfusion.simulation.pipe import (
    STEEL_CONDUCTIVITY,
    STEEL_PERMEABILITY,
    Pipe,
    dipole_tensor,
    wall_transmission,
)
from magfusion.units import MU0, MU0_OVER_4PI, AnyArray, Array, ComplexArray, IntArray

SQUARE_POLE = 2.9732  # mean inverse distance of two points of a square, times its side
LATTICE = 9.0336  # sum of 1 / |k|^3 over a plane lattice: field in a wide sheet of dipoles is zero
THIN = 0.02  # m; a bar of smaller radius is magnetised along its axis only
SLOWEST_HZ = 1e-6
MAX_ELEMENTS = 4000


class Elements(NamedTuple):
    """Scalar moments of a body."""

    # centre_world, axis_world: (n, 3) (m), and the moment's direction, a unit vector
    centre_world: Array
    axis_world: Array
    length: Array  # (n,), between the poles of a stick, zero for a point (m)
    pole: Array  # (n,), radius over which a pole of a stick is spread (m)
    group: IntArray  # (n,), points of one group do not affect each other; negative for none


class Body(Protocol):
    """A piece of steel."""

    def elements(self) -> Elements:
        """Return its elements."""
        ...

    def stiffness(self, frequency_hz: float) -> ComplexArray:
        """Return the field that a unit of each moment needs, shape (n, n) (T / A m^2)."""
        ...


@dataclass(frozen=True, eq=False)
class Ball:
    """A sphere; see `magfusion.model.physics.disturbance.sphere_polarizability`."""

    centre_world: Array  # (3,) (m)
    radius: float  # (m)
    permeability: float = STEEL_PERMEABILITY  # relative
    conductivity: float = STEEL_CONDUCTIVITY  # (S/m)

    def elements(self) -> Elements:
        """Return three points."""
        return _points(self.centre_world[None], np.eye(3)[None])

    def stiffness(self, frequency_hz: float) -> ComplexArray:
        """Return the inverse polarisability, shape (3, 3) (T / A m^2)."""
        material = self.permeability, self.conductivity
        turning = 2.0 * np.pi * max(frequency_hz, SLOWEST_HZ)
        return np.asarray(np.eye(3) / sphere_polarizability(self.radius, *material, turning))


@dataclass(frozen=True, eq=False)
class Bar:
    """A rod or pipe: sticks along, and points across if it is thick."""

    pipe: Pipe

    def elements(self) -> Elements:
        """Return a stick for each segment, then two points for each."""
        centre, span, radius = self.pipe.centres_world(), self.pipe.span, self.pipe.radius
        axis = self.pipe.axis_world
        # Mean inverse distance of two points of a line charge as long as a segment.
        spread = span * np.arcsinh(span / radius) - np.hypot(span, radius) + radius
        along = _sticks(centre, np.tile(axis, (len(centre), 1)), span, span**2 / (2.0 * spread))
        if radius < THIN:
            return along
        across = np.linalg.svd(axis[None])[2][1:]
        return _joined([along, _points(centre, np.tile(across, (len(centre), 1, 1)))])

    def stiffness(self, frequency_hz: float) -> ComplexArray:
        """Return a diagonal matrix (T / A m^2)."""
        pipe, count = self.pipe, len(self.pipe.centres_world())
        through = wall_transmission(pipe, frequency_hz)
        along = pipe.area * pipe.span * (pipe.permeability * through.wall - 1.0)
        own = np.full(count, MU0 / along, dtype=np.complex128)
        if pipe.radius >= THIN:
            across = 2.0 * np.pi * pipe.radius**2 * pipe.span * through.dipole
            own = np.concatenate([own, np.full(2 * count, MU0 / across)])
        return np.diag(own)


@dataclass(frozen=True, eq=False)
class Sheet:
    """A flat rectangle: a net of sticks that carry flux and current, and the loops of that net.

    It is cut into tiles; a stick leads from the middle of one to the next.
    """

    # corner_world, first_world, second_world: (3,), a corner, and the sides from it, at right
    # angles (m)
    corner_world: Array
    first_world: Array
    second_world: Array
    thickness: float  # (m)
    permeability: float = STEEL_PERMEABILITY  # relative
    conductivity: float = STEEL_CONDUCTIVITY  # (S/m)
    tile: float = 0.25  # maximum side of a tile (m)

    @cached_property
    def _grid(self) -> tuple[tuple[int, int], Array, Array]:
        """Number of tiles along the sides, lengths of a tile (m), and unit vectors (3, 3)."""
        sides = np.stack([self.first_world, self.second_world])
        size = np.linalg.norm(sides, axis=1)
        count = np.maximum(np.ceil(size / self.tile - 1e-9).astype(int), 2)
        unit = sides / size[:, None]
        return (
            (int(count[0]), int(count[1])),
            size / count,
            np.concatenate([unit, [np.cross(*unit)]]),
        )

    def elements(self) -> Elements:
        """Return the sticks along the first side, those along the second, and the loops."""
        (n, m), step, unit = self._grid
        pole = np.sqrt(step[0] * step[1]) / SQUARE_POLE
        parts = []
        for k, shape in enumerate([(n - 1, m), (n, m - 1)]):
            centre = self._places(shape, 0.5 + 0.5 * np.eye(2)[k])
            parts.append(_sticks(centre, np.tile(unit[k], (len(centre), 1)), step[k], pole))
        centre = self._places((n - 1, m - 1), np.ones(2))
        loops = _points(centre, np.tile(unit[2], (len(centre), 1, 1)), group=-1)
        return _joined([*parts, loops])

    def _places(self, shape: tuple[int, int], offset: Array) -> Array:
        """Return a lattice of points (m), shape (n, 3)."""
        _, step, unit = self._grid
        at = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 2)
        return np.asarray(self.corner_world + ((at + offset) * step) @ unit[:2])

    def stiffness(self, frequency_hz: float) -> ComplexArray:
        """Return the sticks' diagonal, and the loops' matrix, which share their edges."""
        (n, m), step, _ = self._grid
        turning = 2.0 * np.pi * max(frequency_hz, SLOWEST_HZ)
        k = np.sqrt(1j * turning * MU0 * self.permeability * self.conductivity)
        half = 0.5 * k * self.thickness
        flux = self.thickness * (self.permeability * np.tanh(half) / half - 1.0) / MU0
        impedance = k / (2.0 * self.conductivity * np.tanh(half))  # of a square
        sticks, first = (n - 1) * m + n * (m - 1), (n - 1) * m
        loop, (i, j) = np.arange((n - 1) * (m - 1)), np.divmod(np.arange((n - 1) * (m - 1)), m - 1)
        edges = np.zeros((len(loop), sticks))
        a, b = i * m + j, first + loop
        for at, sign in ((a, 1.0), (a + 1, -1.0), (b, -1.0), (b + m - 1, 1.0)):
            edges[loop, at] = sign
        resistance = np.repeat([step[0] / step[1], step[1] / step[0]], [first, sticks - first])
        area = step[0] * step[1]
        loops = 1j * impedance / (turning * area**2) * (edges * resistance) @ edges.T
        return np.asarray(block_diag(np.eye(sticks) / (flux * area), loops))


@dataclass(frozen=True, eq=False)
class SteelStructure:
    """Steel bodies that affect each other.

    Raises InputError if they have more than `MAX_ELEMENTS` elements.
    """

    bodies: tuple[Body, ...]

    def __post_init__(self) -> None:
        if len(self.elements.length) > MAX_ELEMENTS:
            raise InputError(
                f"steel: {len(self.elements.length)} elements are too many (at most"
                f" {MAX_ELEMENTS}); use fewer or smaller bodies"
            )

    @cached_property
    def elements(self) -> Elements:
        """Of all bodies."""
        return _joined([body.elements() for body in self.bodies])

    @cached_property
    def coupling(self) -> Array:
        """Field of a unit of each moment along and at each other, symmetric (T / A m^2)."""
        return _coupling(self.elements)

    def points_world(self) -> Array:
        """Return the middle of all elements (m), shape (n, 3)."""
        return self.elements.centre_world

    def moments(self, field_world: AnyArray, frequency_hz: float) -> ComplexArray:
        """Return the moment of each element, shape (n, k, 3) (A m^2).

        `field_world` (n, k, 3): of k sources without steel at `points_world` (T).
        """
        axis = self.elements.axis_world
        stiffness = block_diag(*(body.stiffness(frequency_hz) for body in self.bodies))
        along = np.einsum("nkc,nc->nk", field_world, axis)
        moment = np.linalg.solve(stiffness - self.coupling, along)
        return np.asarray(moment[..., None] * axis[:, None])


def _sticks(centre: Array, axis: Array, length: float, pole: float) -> Elements:
    count = len(centre)
    every = np.full(count, length), np.full(count, pole), np.full(count, -1)
    return Elements(centre, axis, *every)


def _points(centre: Array, axes: Array, group: int = 0) -> Elements:
    """Return points of several axes (n, k, 3) at each centre (n, 3)."""
    number = axes.shape[0] * axes.shape[1]
    place = np.repeat(centre, axes.shape[1], axis=0)
    none = np.zeros(number)
    return Elements(place, axes.reshape(-1, 3), none, none, np.full(number, group))


def _joined(parts: Sequence[Elements]) -> Elements:
    """Return the elements of several bodies, with groups of their own."""
    group, start = [], 0
    for part in parts:
        group.append(np.where(part.group < 0, -1, part.group + start))
        start += int(np.max(part.group, initial=-1)) + 1
    centre, axis, length, pole = (
        np.concatenate([part[k] for part in parts]) for k in range(len(Elements._fields) - 1)
    )
    return Elements(centre, axis, length, pole, np.concatenate(group))


def _coupling(elements: Elements) -> Array:
    """Return the coupling of sticks (by their poles) and points (as dipoles)."""
    centre, axis, length, pole, group = elements
    stick = length > 0.0
    out = np.zeros((len(length), len(length)))
    half = (0.5 * length[:, None] * axis)[stick]
    ends = [centre[stick] + sign * half for sign in (1.0, -1.0)]
    size = pole[stick]
    between = np.zeros((len(half), len(half)))
    outward = np.zeros((np.count_nonzero(~stick), len(half)))
    for j, end in enumerate(ends):
        for i, other in enumerate(ends):
            square = np.sum((other[:, None] - end) ** 2, axis=2) + np.outer(size, size)
            between -= (-1.0) ** (i + j) / np.sqrt(square)
        offset = centre[~stick][:, None] - end
        square = np.sum(offset**2, axis=2) + size**2
        outward += (-1.0) ** j * np.einsum("nkc,nc->nk", offset, axis[~stick]) / square**1.5
    scale = MU0_OVER_4PI / length[stick]
    out[np.ix_(stick, stick)] = between * scale / length[stick][:, None]
    out[np.ix_(~stick, stick)] = outward * scale
    out[np.ix_(stick, ~stick)] = (outward * scale).T
    if not np.all(stick):
        out[np.ix_(~stick, ~stick)] = _of_points(centre[~stick], axis[~stick], group[~stick])
    return out


def _of_points(centre: Array, axis: Array, group: IntArray) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        tensor = dipole_tensor(centre[:, None] - centre)
        out = np.einsum("na,nkab,kb->nk", axis, tensor, axis)
    out[(group[:, None] == group) & (group >= 0)] = 0.0
    loop = np.flatnonzero(group < 0)
    if len(loop):
        # The nearest loop of the same sheet is a cell away.
        separation = np.linalg.norm(centre[loop][:, None] - centre[loop], axis=2)
        np.fill_diagonal(separation, np.inf)
        out[loop, loop] = LATTICE * MU0_OVER_4PI / np.min(separation, axis=1) ** 3
    return np.asarray(out)
