"""Position from field amplitudes alone: lines in the logarithms, then trilateration.

Paper 004, algorithm 1, and the ranges that two other algorithms start from.  A line says that the
amplitude depends on the distance alone (Eq 14), which no amplitude of a dipole does but the minor
semi-axis of a rotating one: see `ranges_from_minor_axis`.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.errors import EstimationError
from magfusion.units import MU0_OVER_4PI, Array, IntArray

ITERATIONS = 200  # a bound; ten suffice unless no position fits the ranges
CONVERGED = 1e-10  # m; length of the last step
LEAST_POINTS = 4  # of a block's line
LEAST_SPREAD = 0.1  # of the logarithms of their distances
FLAT = 1e-9  # thickness of a plane, relative to its extent
_TINY = 1e-12  # m


@dataclass(frozen=True, eq=False)
class RssiLines:
    """``ln(amplitude) = slope ln(distance) + intercept`` of each beacon (paper 004, Eq 16).

    Parameters
    ----------
    slope : ndarray, shape (..., beacons)
        -3 for an ideal dipole.
    intercept : ndarray, shape (..., beacons)
        Natural logarithm of the amplitude (T) at one metre.
    """

    slope: Array
    intercept: Array

    def log_amplitude(self, distance: Array) -> Array:
        """Return the natural logarithm of the amplitude (T) at distances (..., beacons) (m)."""
        return np.asarray(self.slope * np.log(distance) + self.intercept)


@dataclass(frozen=True, eq=False)
class BlockLines:
    """Lines of square blocks of the plan (paper 004, section 2.3 and figure 4).

    Parameters
    ----------
    size : float
        Of a block (m); the paper takes 2 m.
    overall : RssiLines
        Where there is no block, slope and intercept of shape (beacons,).
    block : ndarray of int, shape (blocks, 2)
        ``floor(position / size)`` in x and y.
    lines : RssiLines
        Of each block, shape (blocks, beacons).
    """

    size: float
    overall: RssiLines
    block: IntArray
    lines: RssiLines

    def at(self, position_world: Array) -> RssiLines:
        """Return the lines that hold at positions (..., 3) (m), shape (..., beacons)."""
        own = _block(position_world, self.size)
        slope = np.broadcast_to(self.overall.slope, (*own.shape[:-1], len(self.overall.slope)))
        slope, intercept = slope.copy(), np.broadcast_to(self.overall.intercept, slope.shape).copy()
        for place, block_slope, block_intercept in zip(
            self.block, self.lines.slope, self.lines.intercept, strict=True
        ):
            here = np.all(own == place, axis=-1)
            slope[here], intercept[here] = block_slope, block_intercept
        return RssiLines(slope, intercept)


def distances(position_world: Array, beacons_world: Array) -> Array:
    """Return the distance of each point from each beacon (m), shape (..., beacons)."""
    return np.asarray(np.linalg.norm(position_world[..., None, :] - beacons_world, axis=-1))


def fit_lines(distance: Array, amplitude: Array) -> RssiLines:
    """Fit a line to each beacon's amplitudes at known distances.

    Parameters
    ----------
    distance : ndarray, shape (points, beacons)
        (m)
    amplitude : ndarray, shape (points, beacons)
        (T); NaN where it was not measured.
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

    Parameters
    ----------
    position_world : ndarray, shape (points, 3)
        (m)
    beacons_world : ndarray, shape (beacons, 3)
        (m)
    amplitude : ndarray, shape (points, beacons)
        (T); NaN where it was not measured.
    size : float
        Of the blocks (m).
    """
    distance = distances(position_world, beacons_world)
    overall = fit_lines(distance, amplitude)
    blocks, own = np.unique(_block(position_world, size), axis=0, return_inverse=True)
    slope = np.tile(overall.slope, (len(blocks), 1))
    intercept = np.tile(overall.intercept, (len(blocks), 1))
    for b, i in np.ndindex(slope.shape):
        here = (own.ravel() == b) & np.isfinite(amplitude[:, i])
        log_distance = np.log(distance[here, i])
        if len(log_distance) >= LEAST_POINTS and np.ptp(log_distance) >= LEAST_SPREAD:
            line = np.polyfit(log_distance, np.log(amplitude[here, i]), 1)
            slope[b, i], intercept[b, i] = line
    return BlockLines(size, overall, blocks, RssiLines(slope, intercept))


def _block(position_world: Array, size: float) -> IntArray:
    # A point on the edge, as of a regular survey, must not fall to either side by rounding.
    return np.asarray(np.floor(position_world[..., :2] / size + 1e-9), dtype=np.int64)


def ranges_from_lines(lines: RssiLines, amplitude: Array) -> Array:
    """Return the range to each beacon (m) from its amplitude (T), shape (..., beacons)."""
    return np.asarray(np.exp((np.log(amplitude) - lines.intercept) / lines.slope))


def ranges_from_minor_axis(minor_axis: Array, moment: Array) -> Array:
    """Return the range to each rotating beacon (m), exact in every direction.

    Parameters
    ----------
    minor_axis : ndarray, shape (..., beacons)
        Minor semi-axis of the field's ellipse (T): ``K m / r^3`` for two equal moments in
        quadrature, whatever the direction.
    moment : ndarray, shape (beacons,)
        Peak moment of either coil (A m^2).
    """
    return np.asarray(np.cbrt(MU0_OVER_4PI * moment / minor_axis))


def trilaterate(ranges: Array, beacons_world: Array, start_world: Array) -> Array:
    """Return the positions whose distances from the beacons fit the ranges best.

    Beacons in one plane leave two mirror positions that fit equally well; the start's side of the
    plane decides between them (paper 004, Eq 17).  Newton's method on all epochs at once, with the
    curvature made positive: where the ranges are too short to meet, Gauss-Newton creeps.

    Parameters
    ----------
    ranges : ndarray, shape (..., beacons)
        (m)
    beacons_world : ndarray, shape (beacons, 3)
        (m)
    start_world : ndarray, shape (3,), or (..., 3)
        Where the iteration starts (m); not in the plane of the beacons.

    Returns
    -------
    ndarray, shape (..., 3)
        (m)

    Raises
    ------
    EstimationError
        Where a range is not finite, or an iteration does not converge.
    """
    if not np.all(np.isfinite(ranges)):
        raise EstimationError("trilateration needs the range to every beacon")
    shape = (*ranges.shape[:-1], 3)
    start = np.broadcast_to(start_world, shape).reshape(-1, 3)
    position = _converged(start, beacons_world, ranges.reshape(-1, ranges.shape[-1]))
    centre, normal, flat = _plane(beacons_world)
    if flat:
        # A step may cross the plane, behind which everything is the same.
        crossed = ((position - centre) @ normal) * ((start - centre) @ normal) < 0.0
        position = np.where(crossed[:, None], _mirrored(position, centre, normal), position)
    return position.reshape(shape)


def trilaterate_from_both_sides(ranges: Array, beacons_world: Array, start_world: Array) -> Array:
    """Return the better of the positions found from the start and from its mirror image.

    The mirror is the plane that fits the beacons best.  Where both fit alike, as they do when all
    beacons lie in that plane, the start's side is kept.

    Parameters
    ----------
    ranges, beacons_world, start_world
        As `trilaterate`.

    Returns
    -------
    ndarray, shape (..., 3)
        (m)

    Raises
    ------
    EstimationError
        Where an iteration does not converge.
    """
    centre, normal, flat = _plane(beacons_world)
    here = trilaterate(ranges, beacons_world, start_world)
    if flat:
        return here
    there = trilaterate(ranges, beacons_world, _mirrored(start_world, centre, normal))
    ours, theirs = (_misfit(p, beacons_world, ranges) for p in (here, there))
    return np.where((theirs < ours)[..., None], there, here)


def _plane(beacons_world: Array) -> tuple[Array, Array, bool]:
    """Return centre and normal of the beacons' plane, and whether they lie in it."""
    centre = np.mean(beacons_world, axis=0)
    _, size, axes = np.linalg.svd(beacons_world - centre)
    return centre, axes[2], bool(len(size) < 3 or size[2] < FLAT * size[0])


def _mirrored(position: Array, centre: Array, normal: Array) -> Array:
    return np.asarray(position - 2.0 * ((position - centre) @ normal)[..., None] * normal)


def _converged(start: Array, beacons: Array, ranges: Array) -> Array:
    position = start.astype(np.float64)
    damping = np.full(len(position), 1e-6)
    moving = np.arange(len(position))
    for _ in range(ITERATIONS):
        if len(moving) == 0:
            return position
        here, wanted = position[moving], ranges[moving]
        step = _newton_step(here, beacons, wanted, damping[moving])
        better = _misfit(here + step, beacons, wanted) <= _misfit(here, beacons, wanted)
        position[moving[better]] += step[better]
        damping[moving] *= np.where(better, 0.1, 10.0)
        moving = moving[np.linalg.norm(step, axis=1) > CONVERGED]
    raise EstimationError(f"trilateration did not converge from {start[moving[0]]}")


def _misfit(position: Array, beacons: Array, ranges: Array) -> Array:
    return np.asarray(np.sum((distances(position, beacons) - ranges) ** 2, axis=-1))


def _newton_step(position: Array, beacons: Array, ranges: Array, damping: Array) -> Array:
    offset = position[:, None] - beacons
    length = np.maximum(np.linalg.norm(offset, axis=-1), _TINY)
    unit = offset / length[..., None]
    # Second derivative of (|p - m| - r)^2 / 2: one along the ray, across it the relative excess.
    across = (length - ranges) / length
    curvature = np.einsum("nb,nbi,nbj->nij", 1.0 - across, unit, unit)
    curvature += np.sum(across, axis=1)[:, None, None] * np.eye(3)
    gradient = np.einsum("nb,nbi->ni", length - ranges, unit)
    size, axes = np.linalg.eigh(curvature)
    firm = np.abs(size) + damping[:, None]
    return np.asarray(-np.einsum("nij,nj,nkj,nk->ni", axes, 1.0 / firm, axes, gradient))
