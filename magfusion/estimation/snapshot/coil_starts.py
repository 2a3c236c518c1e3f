"""Measurements of a receiver of one axis, and a grid search for its coil's position.

The measurement of a beacon is one number, ``u . B_j(p)`` with u the coil's axis times its gain:
linear in u at a given position, and its square linear in ``u u^T`` if its sign is unknown.  A grid
of positions around the beacons is therefore evaluated in closed form.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.errors import EstimationError
from magfusion.model.one_axis import axis_of
from magfusion.model.parameters import Calibration, predict_channels
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, Magnetometer, MagnetometerSigma, Site
from magfusion.units import TINY, Array, BoolArray, ComplexArray, IntArray

DIRECTIONS, RADII = 400, 28  # of the grid around the beacons
NEAREST, FARTHEST = 0.15, 8.0  # of their extent
LIKELY, KEPT = 400, 40  # grid positions that are evaluated again, and that are refined
SOFT, FLOOR = 0.1, 0.01  # error at a grid position: of an amplitude, of the largest
FLAT = 1e-9  # of the largest singular value; smaller combinations of channels are unobservable
_PAIRS = np.triu_indices(3)


@dataclass(frozen=True, eq=False)
class CoilEpochs:
    """Measurements of a coil."""

    time: Array  # (n,) (s)
    measured: ComplexArray  # (n, channels), phasors, or amplitudes (T); NaN where missing
    sigma: Array  # (n, channels), of the real and of the imaginary part (T)
    signed: bool  # whether the phase determines the sign
    # (channels,), real values of each: two if its field rotates and phases are known, else one
    parts: IntArray | None = None
    # swing, shift: (n, channels), rotation of the coil since the measurement, or its limit (rad),
    # and one sigma of its displacement (m), if channels are measured in turn
    swing: Array | None = None
    shift: Array | None = None

    def __len__(self) -> int:
        return len(self.time)

    @staticmethod
    def of(fields: FieldSamples, site: Site) -> "CoilEpochs":
        """Return the measurements of the one axis; unsigned if a drive's phase is unknown."""
        k = "xyz".index(fields.axes)
        measured, sigma = fields.phasor_sensor[..., k], np.sqrt(fields.phasor_cov[..., k, k].real)
        signed = fields.signed and all(beacon.synchronised for beacon in site.beacons)
        if not signed:
            measured = np.where(np.isfinite(measured), np.abs(measured), np.nan)
        parts = np.concatenate([_turning(beacon) for beacon in site.beacons]) if signed else None
        own = fields.time, measured.astype(np.complex128), sigma, signed, parts
        shift = None
        if fields.ahead is not None:
            shift = np.abs(fields.ahead) * site.platform.motion.speed_sigma
        return CoilEpochs(*own, _swing(fields, site.platform.magnetometer), shift)

    def rows(self, kept: BoolArray | slice) -> "CoilEpochs":
        """Return a subset of the epochs."""
        own = self.time[kept], self.measured[kept], self.sigma[kept]
        motion = (None if part is None else part[kept] for part in (self.swing, self.shift))
        return CoilEpochs(*own, self.signed, self.parts, *motion)

    @property
    def number_count(self) -> IntArray:
        """Number of real values in each row, shape (n,)."""
        parts = 1 if self.parts is None else self.parts
        return np.asarray(np.sum(np.isfinite(self.measured) * parts, axis=1))


def _swing(fields: FieldSamples, sensor: Magnetometer) -> Array | None:
    """Return the rotation of the one axis until the time of the epoch."""
    if fields.channel_rotation is None:
        return None
    axis = axis_of(sensor)
    return np.asarray(np.linalg.norm(fields.channel_rotation @ axis - axis, axis=-1))


def _turning(beacon: Beacon) -> IntArray:
    """Return two for each tone with a rotating field, and one for each with a fixed direction."""
    drive = beacon.moments_beacon.T @ beacon.excitation  # (3, tones)
    square = np.abs(np.sum(drive**2, axis=0))
    return np.where(square < (1.0 - 1e-9) * np.sum(np.abs(drive) ** 2, axis=0), 2, 1)


def middle_of(beacons: tuple[Beacon, ...]) -> tuple[Array, float]:
    """Return the centre of some beacons, shape (3,) (m), and their extent about it (m)."""
    centres = np.array(
        [b.position_world + b.world_from_beacon @ b.centres_beacon.mean(axis=0) for b in beacons]
    )
    middle = np.mean(centres, axis=0)
    return middle, 2.0 * float(np.sqrt(np.mean(np.sum((centres - middle) ** 2, axis=1))))


def mirror(site: Site) -> tuple[Array, Array]:
    """Return a point of the plane that beacons are nearest to, and half a turn about its normal.

    Coils along the normal, or in the plane, have equal fields on both sides.
    """
    middle, _ = middle_of(site.beacons)
    centres = np.array([beacon.position_world for beacon in site.beacons])
    normal = np.linalg.svd(centres - middle)[2][-1]
    return middle, 2.0 * np.outer(normal, normal) - np.eye(3)


def at_point(calibration: Calibration) -> Calibration:
    """Return a calibration whose magnetometer is a point with the axes of the world."""
    platform, zero = calibration.site.platform, np.zeros(3)
    sigma = MagnetometerSigma(np.zeros((3, 3)), zero, zero, zero)
    response = platform.magnetometer.response
    plain = Magnetometer(zero, np.eye(3), 1.0, np.eye(3), zero, sigma, response=response)
    site = replace(calibration.site, platform=replace(platform, magnetometer=plain))
    return replace(calibration, site=site)


def grid_about(site: Site) -> Array:
    """Return positions to evaluate, shape (g, 3) (m): on spheres around the beacons.

    Those outside of the region are included, as some converge to the other side and are mirrored.
    Raises EstimationError where none is inside of the region.
    """
    middle, extent = middle_of(site.beacons)
    number = np.arange(DIRECTIONS) + 0.5
    height, turn = 1.0 - 2.0 * number / DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * number
    flat = np.sqrt(1.0 - height**2)
    sphere = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    radii = np.geomspace(NEAREST * extent, FARTHEST * extent, RADII) if extent > 0.0 else np.ones(1)
    places = np.asarray(middle + (radii[:, None, None] * sphere).reshape(-1, 3))
    inside = site.bounds is None or bool(np.any(np.all(site.bounds.margin(places) > 0.0, axis=1)))
    if not inside or not extent > 0.0:
        raise EstimationError(
            "no position within the declared region is near enough to separate beacons: a"
            " receiver of one axis needs several of them"
        )
    return places


class CoilGrid(NamedTuple):
    """Positions, and the response of a coil at each to every axis, or pair of axes."""

    places_world: Array  # (g, 3) (m)
    field: ComplexArray  # (g, channels, 3) (T), world axes
    design: Array  # (g, rows, unknowns), of the axis, or of its products
    scale: Array  # (g, rows), weights of the rows: relative to the field, equal everywhere

    @staticmethod
    def of(
        calibration: Calibration, time: float, places_world: Array, *, signed: bool
    ) -> "CoilGrid":
        """Return the grid of a receiver whose axes are the world's."""
        attitude = np.broadcast_to(np.eye(3), (len(places_world), 3, 3))
        at = np.full(len(places_world), time)
        field = predict_channels(calibration, at, attitude, places_world)
        size = np.linalg.norm(field, axis=2)
        scale = np.where(size > 0.0, 1.0 / np.maximum(size, TINY), 0.0)
        if signed:
            parts = np.concatenate([field.real, field.imag], axis=1)
            return CoilGrid(places_world, field, parts, np.concatenate([scale, scale], axis=1))
        square = np.einsum("gcx,gcy->gcxy", field, field.conj()).real
        twice = np.where(_PAIRS[0] == _PAIRS[1], 1.0, 2.0)
        return CoilGrid(places_world, field, square[:, :, *_PAIRS] * twice, scale**2)

    def starts(self, epochs: CoilEpochs) -> tuple[Array, Array]:
        """Return the most probable positions of each epoch, and axes, shapes (n, kept, 3)."""
        if epochs.signed:
            given = np.concatenate([epochs.measured.real, epochs.measured.imag], axis=1)
        else:
            given = epochs.measured.real**2
        there, count = np.isfinite(given), min(KEPT, len(self.places_world))
        soft = softened(epochs)
        place, axis = np.empty((2, len(given), count, 3))
        for pattern in np.unique(there, axis=0):
            scale = np.where(pattern, self.scale, 0.0)
            design = self.design * scale[..., None]
            residual, size, right = np.linalg.svd(design, full_matrices=False)
            affected = size > FLAT * size[:, :1]
            residual = np.where(affected[:, None], residual, 0.0)
            inverse = np.where(affected, 1.0 / np.where(affected, size, 1.0), 0.0)[..., None]
            for row in np.flatnonzero(np.all(there == pattern, axis=1)).tolist():
                target = np.where(pattern, given[row], 0.0) * scale
                along = (target[:, None] @ residual)[:, 0]
                total = np.sum(target**2, axis=1)
                cost = 1.0 - np.sum(along**2, axis=1) / np.maximum(total, TINY)
                best = np.argsort(cost, kind="stable")[:LIKELY]
                result = np.swapaxes(right[best], 1, 2) @ (inverse[best] * along[best, :, None])
                axes = result[..., 0] if epochs.signed else roots(result[..., 0])
                misfit, axes = self._misfit(best, axes, epochs, row, soft[row])
                again = np.argsort(misfit, kind="stable")[:count]
                place[row], axis[row] = self.places_world[best[again]], axes[again]
        return place, axis

    def _misfit(
        self, places: IntArray, axes: Array, epochs: CoilEpochs, row: int, sigma: Array
    ) -> tuple[Array, Array]:
        """Return the chi square of an epoch at positions and axes, these optimally scaled."""
        seen = np.einsum("gcx,gx->gc", self.field[places], axes)
        if not epochs.signed:
            seen = np.abs(seen).astype(np.complex128)
        there = np.isfinite(epochs.measured[row])
        seen = np.where(there, seen, 0.0) / sigma
        measured = np.where(there, epochs.measured[row], 0.0) / sigma
        size = np.sum(np.abs(seen) ** 2, axis=1)
        factor = np.sum(seen.conj() * measured, axis=1).real / np.maximum(size, TINY)
        residual = measured - factor[:, None] * seen
        return np.sum(np.abs(residual) ** 2, axis=1), axes * factor[:, None]


def softened(epochs: CoilEpochs) -> Array:
    """Return the errors of amplitudes including that of an approximate position (T)."""
    size = np.abs(np.nan_to_num(epochs.measured))
    largest = np.max(size, axis=1, keepdims=True)
    sigma = np.where(np.isfinite(epochs.measured), epochs.sigma, 1.0)
    return np.asarray(np.sqrt(sigma**2 + (SOFT * size) ** 2 + (FLOOR * largest) ** 2))


def roots(pairs: Array) -> Array:
    """Return the vectors whose outer products are nearest to symmetric matrices."""
    matrix = np.empty((len(pairs), 3, 3))
    matrix[:, *_PAIRS] = pairs
    matrix[:, _PAIRS[1], _PAIRS[0]] = pairs
    value, vector = np.linalg.eigh(matrix)
    least = 1e-6 * np.max(np.abs(value), axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.maximum(value[:, -1:], least + TINY)) * vector[:, :, -1])
