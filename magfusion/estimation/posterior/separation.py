"""Solution separation: the estimate without each beacon against the one with all.

Multiple-hypothesis solution separation of advanced RAIM (J. Blanch et al., IEEE Trans. Aerospace
and Electronic Systems 51(1), 2015).  Under the hypothesis that one beacon is faulty, by any amount,
the estimate without it is right.  If the estimate with all deviates from it by more than a
threshold, this is an alarm; below the threshold it bounds the undetected effect of the fault.
All is by epoch, and batched.

Position and attitude are each tested by the norm of a Gaussian vector, whose tail has two bounds:
that of a single number with all of the variance (G. J. Székely and N. K. Bakirov, Probability
Theory and Related Fields 126, 2003), and that of three equal ones with the largest.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import erfc, gammainccinv, ndtri

from magfusion.estimation.solve.batched import open_inverse
from magfusion.model.trust import Risk
from magfusion.units import Array, BoolArray, IntArray

ROOT_2, ROOT_2_PI = float(np.sqrt(2.0)), float(np.sqrt(2.0 / np.pi))
POSE = 6  # axes: rotation, then position
SINGLE_FAULT_TAIL = 0.215  # probability of a tail below which a single number bounds it
OPEN_POSITION = 10.0  # m; norm of the sigmas beyond which a position is not determined
OPEN_ROTATION = 0.3  # rad; beyond, linearisation fails and the sigma itself is not valid
SLACK = 3.0  # sigma; smaller steps are covered, and no alarm
MIN_COUNT = 1e-30  # rad, m; a deviation below it is zero
PARTS = (slice(0, 3), slice(3, 6))  # rotation, position
ROWS = np.arange(POSE).reshape(2, 3, 1)  # of the blocks of both, shape (2, 3, 3) with
COLUMNS = np.arange(POSE).reshape(2, 1, 3)
UNIT = np.eye(3)


class Radius(NamedTuple):
    """Norms of Gaussian vectors of three numbers, bounded from above."""

    whole: Array  # (...), root of the sum of the variances
    largest: Array  # (...), largest standard deviation of any direction

    def tail(self, radius: Array) -> Array:
        """Return an upper bound of the probability that a norm exceeds a radius."""
        single = erfc(radius / (ROOT_2 * np.maximum(self.whole, MIN_COUNT)))
        share = np.minimum(np.maximum(radius / np.maximum(self.largest, MIN_COUNT), 0.0), 1e3)
        three = erfc(share / ROOT_2) + ROOT_2_PI * share * np.exp(-0.5 * share**2)
        return np.minimum(three, np.where(single < SINGLE_FAULT_TAIL, single, 1.0))

    def beyond(self, probability: Array | float) -> Array:
        """Return a radius that a norm exceeds with at most a given probability."""
        single = -ndtri(0.5 * np.minimum(probability, 0.999 * SINGLE_FAULT_TAIL))
        with np.errstate(invalid="ignore"):  # where the value is exactly known
            bounds = (
                single * self.whole,
                np.sqrt(2.0 * gammainccinv(1.5, probability)) * self.largest,
            )
        return np.fmin(*bounds)


def radii(cov: Array) -> Radius:
    """Return the norms of rotation and position, shape (..., 2), of covariances (..., 6, 6)."""
    blocks = cov[..., ROWS, COLUMNS]
    # Exactly known values may round below zero.
    trace = np.maximum(np.einsum("...ii->...", blocks), 0.0)
    largest = np.minimum(np.maximum(_largest_eigenvalue(blocks), 0.0), trace)
    return Radius(np.sqrt(trace), np.sqrt(largest))


def _largest_eigenvalue(matrix: Array) -> Array:
    """Return the largest eigenvalue of symmetric matrices (..., 3, 3), by its closed form."""
    mean = np.einsum("...ii->...", matrix) / 3.0
    rest = matrix - mean[..., None, None] * UNIT
    size = np.sqrt(np.einsum("...ij,...ij->...", rest, rest) / 6.0)
    scaled = rest / np.where(size > 0.0, size, 1.0)[..., None, None]
    (a, b, c), (_, d, e), (_, _, f) = np.moveaxis(scaled, (-2, -1), (0, 1))
    half = 0.5 * (a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d))
    return mean + 2.0 * size * np.cos(np.arccos(np.minimum(np.maximum(half, -1.0), 1.0)) / 3.0)


@dataclass(frozen=True, eq=False)
class Separation:
    """Estimates without each beacon, relative to the one with all.

    Rotation, then position, in axes of any kind.
    """

    step: Array  # (n, beacons, 6), estimate without a beacon minus the one with all (rad, m)
    cov: Array  # (n, 6, 6), of the estimate with all
    # (n, beacons, 6, 6), without a beacon; not valid where the pose is not determined
    subset_cov: Array
    separation_cov: Array  # (n, beacons, 6, 6), of the step
    determined: BoolArray  # (n, beacons), whether there is an estimate without a beacon
    cost: Array  # (n, beacons), squared residual without a beacon
    # (n, beacons), number of residuals of each beacon; zero where it is missing, and cannot be
    # faulty
    rows: Array

    def __or__(self, other: "Separation") -> "Separation":
        """Return the estimates of both, relative to the same one with all."""
        pairs = {
            name: np.concatenate([getattr(self, name), getattr(other, name)], axis=1)
            for name in ("step", "subset_cov", "separation_cov", "determined", "cost", "rows")
        }
        return Separation(cov=self.cov, **pairs)

    @cached_property
    def _sigmas(self) -> Radius:
        """All sigmas, shape (n, 1 + 2 beacons, 2), from which the others are taken."""
        return radii(np.concatenate([self.cov[:, None], self.subset_cov, self.separation_cov], 1))

    def _part(self, rows: slice | int) -> Radius:
        return Radius(*(part[:, rows] for part in self._sigmas))

    @property
    def sigma(self) -> Radius:
        """Of the estimate with all, shape (n, 2): rotation and position."""
        return self._part(0)

    @property
    def subset_sigma(self) -> Radius:
        """Of the estimates without a beacon, shape (n, beacons, 2)."""
        return self._part(slice(1, 1 + self.step.shape[1]))

    @property
    def separation_sigma(self) -> Radius:
        """Of the steps, shape (n, beacons, 2)."""
        return self._part(slice(1 + self.step.shape[1], None))

    @cached_property
    def shift(self) -> Array:
        """Norm of the steps, shape (n, beacons, 2) (rad, m)."""
        return np.stack([np.linalg.norm(self.step[..., part], axis=-1) for part in PARTS], axis=-1)

    def prior(self, risk: Risk) -> Array:
        """Return the probability that each beacon is faulty, shape (n, beacons)."""
        return np.where(self.rows > 0, risk.fault, 0.0)

    def thresholds(self, risk: Risk, slack: float = 0.0) -> Array:
        """Return the largest step without an alarm, shape (n, beacons, 2) (rad, m).

        `slack`: a step below this number of sigmas of the estimate with all is no alarm: it is
        covered.
        """
        tests = len(PARTS) * self.step.shape[1]
        limit = self.separation_sigma.beyond(risk.false_alarm / tests)
        return np.maximum(limit, slack * self.sigma.whole[:, None])

    def excess(self, risk: Risk, slack: float = 0.0) -> Array:
        """Return each beacon's step relative to its threshold, shape (n, beacons); above 1: alarm.

        Of rotation or position, whichever is larger.
        """
        limit = self.thresholds(risk, slack)
        known = (self.determined & (self.rows > 0))[..., None]
        return np.max(np.where(known, self.shift / np.maximum(limit, MIN_COUNT), 0.0), axis=2)

    def likely(self, prior: Array) -> Array:
        """Return the probability of each beacon, given that one is faulty, shape (n, beacons).

        `prior` (n, beacons).
        """
        # Omitting more rows explains more; each number is worth two (Akaike).
        cost = np.where(self.determined & (prior > 0.0), self.cost + 2.0 * self.rows, np.inf)
        least = np.min(cost, axis=1, keepdims=True)
        weight = prior * np.exp(-0.5 * (cost - np.where(np.isfinite(least), least, 0.0)))
        total = np.sum(weight, axis=1, keepdims=True)
        return weight / np.where(total > 0.0, total, 1.0)


def linear_separation(
    jacobian: Array, error: Array, covariance: Array | None, owner: IntArray, beacons: int
) -> Separation:
    """Separate the estimates of linear least squares with whitened rows, independently by epoch.

    Parameters
    ----------
    jacobian : ndarray, shape (n, rows, 6 + nuisances)
        By the pose, then by the nuisances.  Missing rows are zero.
    error : ndarray, shape (n, rows)
        Predicted minus measured.
    covariance : ndarray, shape (n, rows, rows), optional
        The rows' true covariance, where their whitening is an approximation.
    owner : int ndarray, shape (rows,)
        Beacon of each row; negative for rows of no beacon.
    beacons : int
    """
    step, gain, _ = _estimate(jacobian, error)
    known = np.any(jacobian != 0.0, axis=2)
    parts = []
    for beacon in range(beacons):
        kept = np.where((owner == beacon)[:, None], 0.0, jacobian)
        other, other_gain, determined = _estimate(kept, error)
        residual = np.where(owner == beacon, 0.0, error)
        cost = np.sum((residual + (kept @ other[..., None])[..., 0]) ** 2, axis=1)
        moved, difference = other[:, :POSE] - step[:, :POSE], other_gain - gain
        count = np.sum(known & (owner == beacon), axis=1)
        covs = spread(other_gain, covariance), spread(difference, covariance)
        parts.append((moved, *covs, determined, cost, count))
    moved, *others = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
    return Separation(moved, spread(gain, covariance), *others)


def spread(gain: Array, covariance: Array | None) -> Array:
    """Return the covariance of a linear estimate, shape (n, k, k).

    `gain` (n, k, rows). `covariance` (n, rows, rows): the identity by default.
    """
    propagated = gain if covariance is None else gain @ covariance
    return propagated @ np.swapaxes(gain, -1, -2)


def _estimate(jacobian: Array, error: Array) -> tuple[Array, Array, BoolArray]:
    """Return step, gain of the pose, and whether the pose is determined."""
    transposed = np.swapaxes(jacobian, 1, 2)
    inverse, determined = open_inverse(transposed @ jacobian)
    gain = -inverse @ transposed
    return (gain @ error[..., None])[..., 0], gain[:, :POSE], determined
