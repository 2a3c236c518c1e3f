"""Steel around a sensor: casing of wells, and rails.

A pipe's wall concentrates the field along it and is magnetised along and across.  Cut into
segments, each is a dipole in the field of the source and of all other segments, for which a linear
system is solved; its demagnetisation is that of a segment of its own size.  A sensor inside a tube
receives the field through the wall: the exact solution in Bessel functions of a long tube of any
wall in a uniform field, across and along.  The estimators' thin-wall formula (Kaden) is not used
here.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import ive, kve

from magfusion.units import MU0, MU0_OVER_4PI, AnyArray, Array, ComplexArray

FINE, MIN_CURVE = 0.5, 4  # of the radius, between poles; segments of a curve
STEEL_PERMEABILITY, STEEL_CONDUCTIVITY = 100.0, 5e6  # relative, S/m


@dataclass(frozen=True, eq=False)
class Pipe:
    """A straight tube, or a bar or rail where its wall is as thick as its radius."""

    # start_world, end_world: (3,), ends of its axis (m)
    start_world: Array
    end_world: Array
    # radius, wall: outside, and of the wall (m)
    radius: float
    wall: float
    permeability: float = STEEL_PERMEABILITY  # relative
    conductivity: float = STEEL_CONDUCTIVITY  # (S/m)
    segment: float = 0.25  # maximum length of a segment (m)

    @property
    def axis_world(self) -> Array:
        """Unit vector along the axis."""
        along = self.end_world - self.start_world
        return np.asarray(along / np.linalg.norm(along))

    @property
    def length(self) -> float:
        """Length (m)."""
        return float(np.linalg.norm(self.end_world - self.start_world))

    @property
    def span(self) -> float:
        """Length of a segment (m)."""
        return self.length / len(self.centres_world())

    @property
    def area(self) -> float:
        """Cross section of its steel (m^2)."""
        inside = self.radius - self.wall
        return float(np.pi * (self.radius**2 - inside**2))

    def centres_world(self) -> Array:
        """Return the middle of each segment (m), shape (n, 3)."""
        count = max(int(np.ceil(self.length / self.segment)), 1)
        share = (np.arange(count) + 0.5) / count
        return self.start_world + share[:, None] * (self.end_world - self.start_world)

    def through(self, frequency_hz: float) -> "Through":
        """Return the response of the wall."""
        return wall_transmission(self, frequency_hz)


class Through(NamedTuple):
    """Field inside over field outside, as phasors of exp(+j w t), and the wall's response.

    ``dipole`` is the transverse moment of a metre of the tube, over the field outside times 2 pi
    radius^2 / mu0; ``wall`` the mean field along the wall's steel, over that of its surface.
    """

    across: complex
    along: complex
    dipole: complex
    wall: complex


def wall_transmission(pipe: Pipe, frequency_hz: float) -> Through:
    """Return the exact response of a long tube in a uniform alternating field."""
    outer, inner = pipe.radius, pipe.radius - pipe.wall
    mu = pipe.permeability
    k = np.sqrt(2j * np.pi * max(frequency_hz, 1e-6) * MU0 * mu * pipe.conductivity)
    far, near = k * outer, k * max(inner, 1e-9 * outer)
    # I scaled by exp(-real part of far), K by exp(near): neither overflows in a thick wall.
    down = np.exp(near.real - far.real)
    i0 = {far: complex(ive(0, far)), near: complex(ive(0, near)) * down}
    i1 = {far: complex(ive(1, far)), near: complex(ive(1, near)) * down}
    k0 = {far: complex(kve(0, far)) * np.exp(near - far), near: complex(kve(0, near))}
    k1 = {far: complex(kve(1, far)) * np.exp(near - far), near: complex(kve(1, near))}
    # Along: H = a I0 + b K0, one outside; in the bore E = -k (a I1 - b K1) / sigma induces it.
    ratio = inner / (2.0 * mu) * k  # mu0 r / 2 j w = ratio k / sigma
    matrix = np.array(
        [[i0[far], k0[far]], [i1[near] - ratio * i0[near], -k1[near] - ratio * k0[near]]]
    )
    a, b = np.linalg.solve(matrix, np.array([1.0, 0.0]))
    along = a * i0[near] + b * k0[near]
    total = a * (outer * i1[far] - inner * i1[near]) - b * (outer * k1[far] - inner * k1[near])
    wall = 2.0 * total / (k * (outer**2 - inner**2))
    # Across: vector potential sin(phi) times c r | a I1 + b K1 | r + d / r, outside field of one.
    di = {x: i0[x] - i1[x] / x for x in (far, near)}
    dk = {x: -k0[x] - k1[x] / x for x in (far, near)}
    rows = np.array(
        [
            [inner, -i1[near], -k1[near], 0.0],
            [1.0, -k * di[near] / mu, -k * dk[near] / mu, 0.0],
            [0.0, i1[far], k1[far], -1.0 / outer],
            [0.0, k * di[far] / mu, k * dk[far] / mu, 1.0 / outer**2],
        ]
    )
    across, _, _, d = np.linalg.solve(rows, np.array([0.0, 0.0, outer, 1.0]))
    return Through(complex(across), complex(along), complex(d / outer**2), complex(wall))


@dataclass(frozen=True, eq=False)
class Steel:
    """Interacting pipes."""

    pipes: tuple[Pipe, ...]
    about: int | None = None  # index of the pipe around the sensor, which is on its axis

    def points_world(self) -> Array:
        """Return the middle of all segments (m), shape (n, 3)."""
        return np.concatenate([pipe.centres_world() for pipe in self.pipes])

    def seen_world(
        self,
        at_segments_world: AnyArray,
        at_point_world: AnyArray,
        point_world: Array,
        frequency_hz: float,
    ) -> ComplexArray:
        """Return the field of sources at a sensor, steel included, shape (k, 3) (T).

        `at_segments_world` (n, k, 3): field of k sources without steel at `points_world` (T).
        `at_point_world` (k, 3): at the sensor. `point_world` (3,): of the sensor (m).
        """
        moment = self.moments(at_segments_world, frequency_hz)
        field_world = at_point_world.astype(np.complex128)
        for k, (pipe, rows) in enumerate(zip(self.pipes, self._rows(), strict=True)):
            if k == self.about:
                axis = pipe.axis_world
                ring = _ring_field(pipe, float((point_world - pipe.start_world) @ axis))
                field_world += (ring @ (moment[rows] @ axis))[:, None] * axis
            else:
                tensor = dipole_tensor(point_world - pipe.centres_world())
                field_world += np.einsum("nab,nkb->ka", tensor, moment[rows])
        if self.about is None:
            return field_world
        return inside_world(self.pipes[self.about], field_world, frequency_hz)

    def _rows(self) -> list[slice]:
        ends = np.cumsum([0, *(len(pipe.centres_world()) for pipe in self.pipes)]).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]

    def moments(self, field_world: AnyArray, frequency_hz: float) -> ComplexArray:
        """Return the moment of each segment, shape (n, k, 3) (A m^2).

        `field_world` (n, k, 3): of k sources without steel at `points_world` (T).
        """
        points, rows = self.points_world(), self._rows()
        n = len(points)
        with np.errstate(divide="ignore", invalid="ignore"):
            tensor = dipole_tensor(points[:, None] - points)
        answer = np.zeros((n, 3, 3), dtype=np.complex128)
        for pipe, own in zip(self.pipes, rows, strict=True):
            through, axis, span = pipe.through(frequency_hz), pipe.axis_world, pipe.span
            along = np.outer(axis, axis)
            steel = pipe.area * span * (pipe.permeability * through.wall - 1.0)
            across = 2.0 * np.pi * pipe.radius**2 * span * through.dipole
            answer[own] = (steel * along + across * (np.eye(3) - along)) / MU0
            # A pipe's effect on itself: across it is in its response, along it in its poles.
            middle = (pipe.centres_world() - pipe.start_world) @ axis
            rings = np.stack([_ring_field(pipe, float(x)) for x in middle])
            tensor[own, own] = rings[..., None, None] * along
        coupled = np.einsum("iab,ijbc->iajc", answer, tensor).reshape(3 * n, 3 * n)
        driven = np.einsum("iab,ikb->iak", answer, field_world).reshape(3 * n, -1)
        result = np.linalg.solve(np.eye(3 * n) - coupled, driven)
        return np.asarray(np.swapaxes(result.reshape(n, 3, -1), 1, 2))


def dipole_tensor(offset: Array) -> Array:
    """Return the field of a dipole over its moment, shape (..., 3, 3) (T / A m^2)."""
    distance = np.linalg.norm(offset, axis=-1)[..., None, None]
    outer = offset[..., :, None] * offset[..., None, :]
    return np.asarray(MU0_OVER_4PI * (3.0 * outer / distance**2 - np.eye(3)) / distance**3)


def _ring_field(pipe: Pipe, place: float) -> Array:
    """Return the field along the axis of each segment's poles, over its moment, shape (n,).

    At positions on the axis (m from the start); the poles lie in the middle of the wall.  Between
    segments the moment is a smooth curve through theirs, because the nearest poles are as close to
    a point on the axis as the radius.
    """
    count = len(pipe.centres_world())
    finer = max(int(np.ceil(pipe.span / (FINE * pipe.radius))), 1) if count > MIN_CURVE else 1
    edges = np.linspace(0.0, pipe.length, count * finer + 1)
    span = float(edges[1])
    offset = place - edges
    wall = pipe.radius - 0.5 * pipe.wall
    near, far = (np.hypot(offset + side * span, wall) for side in (-0.5, 0.5))
    pole = (1.0 / near - 1.0 / far) / span
    ring = MU0_OVER_4PI * (pole[1:] - pole[:-1]) / pipe.span
    if finer == 1:
        return np.asarray(ring)
    middle = 0.5 * (edges[1:] + edges[:-1])
    return np.asarray(ring @ _curve(count, pipe.span, tuple(middle.tolist())))


@cache
def _curve(count: int, span: float, place: tuple[float, ...]) -> Array:
    """Return the interpolating curve at positions, per value of each segment (places, n)."""
    centres = span * (np.arange(count) + 0.5)
    inside = np.clip(place, centres[0], centres[-1])
    return np.asarray(CubicSpline(centres, np.eye(count))(inside))


def inside_world(pipe: Pipe, outside_world: AnyArray, frequency_hz: float) -> ComplexArray:
    """Return the field at a sensor inside a tube, from the field outside, shape (..., 3) (T)."""
    through, axis = pipe.through(frequency_hz), pipe.axis_world
    along = np.outer(axis, axis)
    tensor = through.along * along + through.across * (np.eye(3) - along)
    return np.asarray(outside_world @ tensor)
