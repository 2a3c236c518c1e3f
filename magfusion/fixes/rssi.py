"""Position from field amplitudes alone: lines in the logarithms, then trilateration."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from magfusion.errors import EstimationError
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class RssiLines:
    """``ln(amplitude) = slope ln(distance) + intercept`` of each beacon (paper 004, Eq 16).

    Parameters
    ----------
    slope : ndarray, shape (beacons,)
        -3 for an ideal dipole.
    intercept : ndarray, shape (beacons,)
        Natural logarithm of the amplitude (T) at one metre.
    """

    slope: Array
    intercept: Array

    def log_amplitude(self, distance: Array) -> Array:
        """Return the natural logarithm of the amplitude (T) at distances (..., beacons) (m)."""
        return np.asarray(self.slope * np.log(distance) + self.intercept)


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


def ranges_from_lines(lines: RssiLines, amplitude: Array) -> Array:
    """Return the range to each beacon (m) from its amplitude (T), shape (..., beacons)."""
    return np.asarray(np.exp((np.log(amplitude) - lines.intercept) / lines.slope))


def trilaterate(ranges: Array, beacons_world: Array, start_world: Array) -> Array:
    """Return the position whose distances from the beacons fit the ranges best.

    Beacons in one plane leave two mirror positions that fit equally well; the start's side of the
    plane decides between them (paper 004, Eq 17).

    Parameters
    ----------
    ranges : ndarray, shape (beacons,)
        (m)
    beacons_world : ndarray, shape (beacons, 3)
        (m)
    start_world : ndarray, shape (3,)
        Where the iteration starts (m); not in the plane of the beacons.

    Returns
    -------
    ndarray, shape (3,)
        (m)

    Raises
    ------
    EstimationError
        Where the iteration does not converge.
    """

    def residual(position_world: Array) -> Array:
        return distances(position_world, beacons_world) - ranges

    def jacobian(position_world: Array) -> Array:
        offset = position_world - beacons_world
        return np.asarray(offset / np.linalg.norm(offset, axis=1)[:, None])

    solution = least_squares(residual, start_world, jacobian, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    if not solution.success:
        raise EstimationError(f"trilateration did not converge from {start_world}")
    return np.asarray(solution.x)
