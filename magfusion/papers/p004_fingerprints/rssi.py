"""Position from field amplitudes alone: linear in the logarithms, then trilateration.

Paper 004, algorithm 1, and the initial ranges of two other algorithms.  A line means that the
amplitude depends on the distance alone (Eq 14), which is true of no amplitude of a dipole except
the minor semi-axis of a rotating one: see `ranges_from_minor_axis`.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.solve.batched import NormalEquations, minimise
from magfusion.papers.p004_fingerprints.equations import (
    distances,
    eq_15_log_amplitude,
    eq_17_misfit,
)
from magfusion.units import MU0_OVER_4PI, Array, IntArray

ITERATIONS = 200  # a bound; ten suffice unless no position fits the ranges
CONVERGED = 1e-10  # m; misfit by which the last step lowers it
MIN_POINTS = 4  # of a block's line
MIN_SPREAD = 0.1  # of the logarithms of their distances
FLAT = 1e-9  # thickness of a plane, relative to its extent
_TINY = 1e-12  # m


@dataclass(frozen=True, eq=False)
class RssiLines:
    """``ln(amplitude) = slope ln(distance) + intercept`` of each beacon (paper 004, Eq 16)."""

    slope: Array  # (..., beacons), -3 for an ideal dipole
    intercept: Array  # (..., beacons), natural logarithm of the amplitude (T) at one metre

    def log_amplitude(self, distance: Array) -> Array:
        """Return the natural logarithm of the amplitude (T) at distances (..., beacons) (m)."""
        return eq_15_log_amplitude(distance, self.slope, self.intercept)


@dataclass(frozen=True, eq=False)
class BlockLines:
    """Lines of square blocks of the plan (paper 004, section 2.3 and figure 4)."""

    size: float  # edge of a block (m); the paper uses 2 m
    overall: RssiLines  # where there is no block, slope and intercept of shape (beacons,)
    block: IntArray  # (blocks, 2), ``floor(position / size)`` in x and y
    lines: RssiLines  # of each block, shape (blocks, beacons)

    def at(self, position_world: Array) -> RssiLines:
        """Return the lines valid at positions (..., 3) (m), shape (..., beacons)."""
        own = _block(position_world, self.size)
        slope = np.broadcast_to(self.overall.slope, (*own.shape[:-1], len(self.overall.slope)))
        slope, intercept = slope.copy(), np.broadcast_to(self.overall.intercept, slope.shape).copy()
        for place, block_slope, block_intercept in zip(
            self.block, self.lines.slope, self.lines.intercept, strict=True
        ):
            here = np.all(own == place, axis=-1)
            slope[here], intercept[here] = block_slope, block_intercept
        return RssiLines(slope, intercept)


def fit_lines(distance: Array, amplitude: Array) -> RssiLines:
    """Fit a line to each beacon's amplitudes at known distances (points, beacons) (m).

    The amplitudes (points, beacons) (T) are NaN where they were not measured.
    """
    lines = []
    for log_distance, log_amplitude in zip(np.log(distance).T, np.log(amplitude).T, strict=True):
        measured = np.isfinite(log_amplitude)
        lines.append(np.polyfit(log_distance[measured], log_amplitude[measured], 1))
    slope, intercept = np.transpose(lines)
    return RssiLines(slope, intercept)


def fit_block_lines(
    position_world: Array, beacons_world: Array, amplitude: Array, size: float = 2.0
) -> BlockLines:
    """Fit lines in each block; a beacon with too few points in one keeps its overall line there.

    Points (n, 3), beacons (m, 3) and size of the blocks in metres, amplitudes as in `fit_lines`.
    """
    distance = distances(position_world, beacons_world)
    overall = fit_lines(distance, amplitude)
    blocks, own = np.unique(_block(position_world, size), axis=0, return_inverse=True)
    slope = np.tile(overall.slope, (len(blocks), 1))
    intercept = np.tile(overall.intercept, (len(blocks), 1))
    for b, i in np.ndindex(slope.shape):
        here = (own.ravel() == b) & np.isfinite(amplitude[:, i])
        log_distance = np.log(distance[here, i])
        if len(log_distance) >= MIN_POINTS and np.ptp(log_distance) >= MIN_SPREAD:
            line = np.polyfit(log_distance, np.log(amplitude[here, i]), 1)
            slope[b, i], intercept[b, i] = line
    return BlockLines(size, overall, blocks, RssiLines(slope, intercept))


def _block(position_world: Array, size: float) -> IntArray:
    # Rounding must not move a point on the edge, as of a regular survey, to either side.
    return np.floor(position_world[..., :2] / size + 1e-9)


def ranges_from_lines(lines: RssiLines, amplitude: Array) -> Array:
    """Return the range to each beacon (m) from its amplitude (T), shape (..., beacons)."""
    return np.exp((np.log(amplitude) - lines.intercept) / lines.slope)


def ranges_from_minor_axis(minor_axis: Array, moment: Array) -> Array:
    """Return the range to each rotating beacon (..., beacons) (m), exact in every direction.

    The minor semi-axis (..., beacons) (T) of the field of two equal peak moments (beacons,) (A m^2)
    in quadrature is ``K m / r^3``.
    """
    return np.cbrt(MU0_OVER_4PI * moment / minor_axis)


def trilaterate(ranges: Array, beacons_world: Array, start_world: Array) -> Array:
    """Return the positions (..., 3) (m) of minimum misfit (Eq 17) to ranges (..., beacons) (m).

    Beacons in one plane give two mirror positions that fit equally well; the side of the start,
    (3,) or (..., 3) (m), decides between them.  Newton's method on all epochs at once, with the
    curvature made positive: Gauss-Newton converges slowly where the ranges are too short to meet.
    Raises EstimationError where a range is not finite, or an iteration does not converge.
    """
    if not np.all(np.isfinite(ranges)):
        raise EstimationError("trilateration requires the range to every beacon")
    shape = (*ranges.shape[:-1], 3)
    start = np.broadcast_to(start_world, shape).reshape(-1, 3)
    position = _converged(start, beacons_world, ranges.reshape(-1, ranges.shape[-1]))
    centre, normal, flat = _plane(beacons_world)
    if flat:
        # A step may cross the plane, which is a plane of symmetry.
        crossed = ((position - centre) @ normal) * ((start - centre) @ normal) < 0.0
        position = np.where(crossed[:, None], _mirrored(position, centre, normal), position)
    return position.reshape(shape)


def trilaterate_from_both_sides(ranges: Array, beacons_world: Array, start_world: Array) -> Array:
    """Return the better of `trilaterate` from the start and from its mirror image.

    The mirror is the best-fit plane of the beacons.  Where both fit equally well, as they do when
    all beacons lie in that plane, the start's side is kept.
    """
    centre, normal, flat = _plane(beacons_world)
    here = trilaterate(ranges, beacons_world, start_world)
    if flat:
        return here
    there = trilaterate(ranges, beacons_world, _mirrored(start_world, centre, normal))
    ours, others = (eq_17_misfit(p, beacons_world, ranges) for p in (here, there))
    return np.where((others < ours)[..., None], there, here)


def _plane(beacons_world: Array) -> tuple[Array, Array, bool]:
    """Return centre and normal of the beacons' plane, and whether they lie in it."""
    centre = np.mean(beacons_world, axis=0)
    _, size, axes = np.linalg.svd(beacons_world - centre)
    return centre, axes[2], bool(len(size) < 3 or size[2] < FLAT * size[0])


def _mirrored(position: Array, centre: Array, normal: Array) -> Array:
    return position - 2.0 * ((position - centre) @ normal)[..., None] * normal


def _converged(start: Array, beacons: Array, ranges: Array) -> Array:
    def model(rows: IntArray, position: Array) -> NormalEquations:
        offset = position[:, None] - beacons
        length = np.maximum(np.linalg.norm(offset, axis=-1), _TINY)
        unit, excess = offset / length[..., None], length - ranges[rows]
        # Second derivative of (|p - m| - r)^2 / 2: one along the ray, the relative excess across.
        across = excess / length
        curvature = np.einsum("nb,nbi,nbj->nij", 1.0 - across, unit, unit)
        curvature += np.sum(across, axis=1)[:, None, None] * np.eye(3)
        size, axes = np.linalg.eigh(curvature)
        return NormalEquations(
            np.sum(excess**2, axis=-1),
            np.einsum("nb,nbi->ni", excess, unit),
            (axes * np.abs(size)[:, None]) @ np.swapaxes(axes, -1, -2),
        )

    result = minimise(
        model, start.astype(np.float64), max_iterations=ITERATIONS, absolute=CONVERGED**2
    )
    if not np.all(result.converged):
        first = start[np.argmin(result.converged)]
        raise EstimationError(f"trilateration does not converge from {first}")
    return result.state
