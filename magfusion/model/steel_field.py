"""Field that one beacon adds by the steel of its room, as dipoles at known places.

Each voxel of steel is a uniformly magnetised sphere: a dipole outside, and of constant flux density
inside.  `magfusion.estimation.integrity.steel_map` estimates them from a log.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from magfusion.units import MU0_OVER_4PI, Array

AT_ONCE = 1 << 18  # pairs of points and voxels


@dataclass(frozen=True, eq=False)
class SteelField:
    """Voxels of steel and their moments.

    They neither move with the beacon nor grow with its moments, which change by little.
    """

    centre_world: Array  # (v, 3) (m)
    radius: Array  # (v,) (m)
    moment_world: Array  # (v, coils, 3), by each coil at its peak current (A m^2)

    @property
    def coils(self) -> int:
        """Number of coils."""
        return int(self.moment_world.shape[1])

    def joined(self, other: "SteelField") -> "SteelField":
        """Return the steel with that of another map."""
        return SteelField(
            np.concatenate([self.centre_world, other.centre_world]),
            np.concatenate([self.radius, other.radius]),
            np.concatenate([self.moment_world, other.moment_world]),
        )

    def fields(self, position_world: Array) -> Array:
        """Return the field, as `fields_and_gradients`."""
        parts = [some.field(self._centred) for some in self._near(position_world)]
        return np.concatenate(parts).reshape(*position_world.shape[:-1], self.coils, 3)

    def fields_and_gradients(self, position_world: Array) -> tuple[Array, Array]:
        """Return the field and its gradient.

        `position_world` (..., 3) (m). Returns `field` (..., coils, 3): world axes (T);
        `gradient` (..., coils, 3, 3): ``[i, j] = d field_i / d position_j`` (T/m).
        """
        near = list(self._near(position_world))
        shape = *position_world.shape[:-1], self.coils, 3
        field = np.concatenate([some.field(self._centred) for some in near])
        gradient = np.concatenate([some.gradient(self._centred) for some in near])
        return field.reshape(shape), gradient.reshape(*shape, 3)

    @cached_property
    def _origin_world(self) -> Array:
        return np.mean(self.centre_world, axis=0)

    @cached_property
    def _centred(self) -> "_Voxels":
        centre, moment = self.centre_world - self._origin_world, self.moment_world
        return _Voxels(
            centre,
            moment.reshape(len(moment), -1),
            np.ascontiguousarray(moment.transpose(2, 1, 0)).reshape(3, -1),
            np.einsum("vci,vi->cv", moment, centre),
            np.einsum("vi,vcj->vcij", centre, moment).reshape(len(moment), -1),
            np.einsum("vi,vj->vij", centre, centre).reshape(len(moment), -1),
        )

    def _near(self, position_world: Array) -> Iterator["_Points"]:
        """Yield points with what all voxels are to them, some points at a time."""
        flat = position_world.reshape(-1, 3) - self._origin_world
        voxels = self._centred
        for point in np.array_split(flat, max(1, len(flat) * len(self.radius) // AT_ONCE)):
            square = np.sum(point**2, axis=1)[:, None] + np.sum(voxels.centre**2, axis=1)
            square -= 2.0 * point @ voxels.centre.T
            inside = square < self.radius**2
            inverse = 1.0 / np.maximum(square, self.radius**2)
            cube = MU0_OVER_4PI * inverse * np.sqrt(inverse)
            direct, radial = -cube, 3.0 * cube * inverse
            direct[inside] *= -2.0
            radial[inside] = 0.0
            along = (point @ voxels.by_coil).reshape(len(point), *voxels.along.shape) - voxels.along
            yield _Points(point, inverse, direct, radial, along * radial[:, None])


class _Voxels(NamedTuple):
    """Voxels about their mean, so that products of places lose no digits."""

    centre: Array  # (v, 3)
    moment: Array  # (v, coils * 3)
    by_coil: Array  # (3, coils * v), the same
    along: Array  # (coils, v), of the centre times the moment
    outer: Array  # (v, coils * 9), their outer product
    radial: Array  # (v, 9), outer product of the centre


class _Points(NamedTuple):
    """Some points, and for each of them and each voxel the factors of its field.

    A sum over voxels of the offset's products is one of the centre's: matrix products alone.
    """

    point: Array  # (n, 3)
    inverse: Array  # (n, v), of the squared distance
    direct: Array  # (n, v), multiplies the moment
    radial: Array  # (n, v), multiplies moment and offset
    along: Array  # (n, coils, v), the same times the moment along the offset

    def field(self, voxels: _Voxels) -> Array:
        """Return the field of all voxels, shape (n, coils, 3)."""
        by_moment = (self.direct @ voxels.moment).reshape(*self.along.shape[:2], 3)
        total = np.sum(self.along, axis=2)[..., None]
        return total * self.point[:, None] - self.along @ voxels.centre + by_moment

    def gradient(self, voxels: _Voxels) -> Array:
        """Return its gradient, shape (n, coils, 3, 3)."""
        shape, place = self.along.shape[:2], self.point[:, None, :, None]
        moment = (self.radial @ voxels.moment).reshape(*shape, 1, 3)
        outer = place * moment - (self.radial @ voxels.outer).reshape(*shape, 3, 3)
        steeper = 5.0 * self.along * self.inverse[:, None]
        cross = place * (steeper @ voxels.centre)[:, :, None]
        total = np.sum(steeper, axis=2)[..., None, None]
        radial = total * place * self.point[:, None, None]
        radial += (steeper @ voxels.radial).reshape(radial.shape)
        radial -= cross + np.swapaxes(cross, 2, 3)
        isotropic = np.sum(self.along, axis=2)[..., None, None] * np.eye(3)
        return np.asarray(outer + np.swapaxes(outer, 2, 3) + isotropic - radial)
