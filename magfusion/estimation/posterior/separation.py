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

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import erfc, gammainccinv, ndtri

from magfusion.estimation.solve.batched import open_inverse
from magfusion.model.trust import Risk
from magfusion.units import DEGREE, Array, BoolArray, IntArray

ROOT_2, ROOT_2_PI = float(np.sqrt(2.0)), float(np.sqrt(2.0 / np.pi))
POSE = 6  # axes: rotation, then position
PRECISE, MOST_STEPS = 1e-7, 60  # of a level
MOST_DEG = 180.0  # an attitude level beyond it is not informative
SINGLE_FAULT_TAIL = 0.215  # probability of a tail below which a single number bounds it
PAIRS_MATTER = 0.5  # share of the risk, above which two faulty beacons are monitored
AT_ONCE = 256  # states whose pairs are computed together
MIN_COUNT = 1e-30  # rad, m; a deviation below it is zero
PARTS = (slice(0, 3), slice(3, 6))  # rotation, position
ROWS = np.arange(POSE).reshape(2, 3, 1)  # of the blocks of both, shape (2, 3, 3) with
COLUMNS = np.arange(POSE).reshape(2, 1, 3)
UNIT = np.eye(3)


class Radius(NamedTuple):
    """Norms of Gaussian vectors of three numbers, bounded from above.

    Parameters
    ----------
    whole : ndarray, shape (...)
        Root of the sum of the variances.
    largest : ndarray, shape (...)
        Largest standard deviation of any direction.
    """

    whole: Array
    largest: Array

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

    Parameters
    ----------
    step : ndarray, shape (n, beacons, 6)
        Estimate without a beacon minus the one with all (rad, m).
    cov : ndarray, shape (n, 6, 6)
        Of the estimate with all.
    subset_cov : ndarray, shape (n, beacons, 6, 6)
        Without a beacon; not valid where the pose is not determined.
    separation_cov : ndarray, shape (n, beacons, 6, 6)
        Of the step.
    determined : bool ndarray, shape (n, beacons)
        Whether there is an estimate without a beacon.
    cost : ndarray, shape (n, beacons)
        Squared residual without a beacon.
    rows : ndarray, shape (n, beacons)
        Number of residuals of each beacon; zero where it is missing, and cannot be faulty.
    """

    step: Array
    cov: Array
    subset_cov: Array
    separation_cov: Array
    determined: BoolArray
    cost: Array
    rows: Array

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

        Parameters
        ----------
        slack : float
            A step below this number of sigmas of the estimate with all is no alarm: it is covered.
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

        Parameters
        ----------
        prior : ndarray, shape (n, beacons)
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

    Parameters
    ----------
    gain : ndarray, shape (n, k, rows)
    covariance : ndarray, shape (n, rows, rows), optional
        The identity by default.
    """
    propagated = gain if covariance is None else gain @ covariance
    return propagated @ np.swapaxes(gain, -1, -2)


def _estimate(jacobian: Array, error: Array) -> tuple[Array, Array, BoolArray]:
    """Return step, gain of the pose, and whether the pose is determined."""
    transposed = np.swapaxes(jacobian, 1, 2)
    inverse, determined = open_inverse(transposed @ jacobian)
    gain = -inverse @ transposed
    return (gain @ error[..., None])[..., 0], gain[:, :POSE], determined


def unmonitored(prior: Array, monitored: int = 1) -> Array:
    """Return the probability that more than one beacon, or two, are faulty, shape (n,).

    Parameters
    ----------
    prior : ndarray, shape (n, beacons)
    monitored : int
        Number of faulty beacons that are monitored: 1 or 2.
    """
    none = np.prod(1.0 - prior, axis=1)
    odds = prior / np.maximum(1.0 - prior, np.finfo(np.float64).tiny)
    one = np.sum(odds, axis=1)
    two = 0.5 * (one**2 - np.sum(odds**2, axis=1)) if monitored > 1 else 0.0
    return np.maximum(1.0 - none * (1.0 + one + two), 0.0)


class FaultModes(NamedTuple):
    """Hypotheses of faulty beacons at each state.

    Parameters
    ----------
    sigma : Radius, shape (n, modes, 2)
        Of the estimates without their beacons.
    threshold : ndarray, shape (n, modes, 2)
        Largest deviation from these estimates (rad, m).
    prior : ndarray, shape (n, modes)
    """

    sigma: Radius
    threshold: Array
    prior: Array

    def __or__(self, other: "FaultModes") -> "FaultModes":
        sigma = zip(self.sigma, other.sigma, strict=True)
        return FaultModes(
            Radius(*(np.concatenate(pair, axis=1) for pair in sigma)),
            np.concatenate([self.threshold, other.threshold], axis=1),
            np.concatenate([self.prior, other.prior], axis=1),
        )


def pair_modes(
    separation: Separation, prior: Array, false_alarm: float
) -> tuple[FaultModes, BoolArray]:
    """Return the modes of two faulty beacons, and whether the pose is determined without both.

    The information of the beacons is taken to be additive, as it is in least squares.  There is
    no alarm for a pair: its deviation bounds the error, the observed one or, if that is larger,
    the one that is exceeded with the probability of a false alarm.
    """
    count, beacons = separation.step.shape[:2]
    first, second = np.triu_indices(beacons, 1)
    chance = false_alarm / (len(PARTS) * max(len(first), 1))
    parts = [
        _pairs_of(separation, first, second, slice(begin, begin + AT_ONCE), chance)
        for begin in range(0, count, AT_ONCE)
    ]
    shift, whole, largest, determined = (np.concatenate(p) for p in zip(*parts, strict=True))
    both = prior[:, first] * prior[:, second]
    return FaultModes(Radius(whole, largest), shift, np.where(determined, both, 0.0)), determined


def _pairs_of(
    separation: Separation, first: IntArray, second: IntArray, rows: slice, chance: float
) -> tuple[Array, Array, Array, BoolArray]:
    """Return deviation, sigmas and observability of the estimates without two beacons."""
    eye = np.eye(POSE)
    alone = separation.determined[rows]
    without = np.linalg.inv(np.where(alone[..., None, None], separation.subset_cov[rows], eye))
    each = np.where(alone[..., None], separation.step[rows], 0.0)
    pulled = (without @ each[..., None])[..., 0]
    joint = without[:, first] + without[:, second]
    joint = joint - np.linalg.inv(separation.cov[rows])[:, None]
    determined = alone[:, first] & alone[:, second]
    determined &= np.linalg.eigvalsh(np.where(determined[..., None, None], joint, eye))[..., 0] > 0
    cov = np.linalg.inv(np.where(determined[..., None, None], joint, eye))
    step = (cov @ (pulled[:, first] + pulled[:, second])[..., None])[..., 0]
    sigma = radii(cov)
    shift = np.stack([np.linalg.norm(step[..., part], axis=-1) for part in PARTS], axis=-1)
    usual = radii(cov - separation.cov[rows][:, None]).beyond(chance)
    return np.fmax(shift, usual), sigma.whole, sigma.largest, determined


def protection_levels(
    separation: Separation, risk: Risk, slack: float = 0.0, prior: Array | None = None
) -> tuple[Array, Array]:
    """Return the protection levels of position (m) and attitude (deg), each of shape (n,).

    Each has half of the risk.  NaN where there is none: the pose is not determined without some
    beacon that may be faulty, or without two that are faulty too often.

    Parameters
    ----------
    slack : float
        As of `Separation.thresholds`.
    prior : ndarray, shape (n, beacons), optional
        Probability that each beacon is faulty, where more is known than `Risk.fault`.
    """
    prior = separation.prior(risk) if prior is None else prior
    modes = FaultModes(separation.subset_sigma, separation.thresholds(risk, slack), prior)
    whole, bounded = (1.0 - risk.mirrors) * risk.total, np.minimum(prior, risk.fault)
    several = unmonitored(bounded)
    if np.any(several > PAIRS_MATTER * whole):
        pairs, determined = pair_modes(separation, bounded, risk.false_alarm)
        first, second = np.triu_indices(prior.shape[1], 1)
        undetermined = np.where(determined, 0.0, bounded[:, first] * bounded[:, second])
        modes, several = modes | pairs, unmonitored(bounded, 2) + np.sum(undetermined, axis=1)
    share = whole - several
    covered = np.all(separation.determined | (prior == 0.0), axis=1) & (share > 0.0)
    level = _levels(
        separation.sigma,
        modes.sigma,
        modes.threshold,
        modes.prior[..., None],
        np.where(covered, share, 1.0)[:, None] / len(PARTS),
    )
    level = np.where(covered[:, None], level, np.nan)
    degrees = level[:, 0] / DEGREE
    return level[:, 1], np.where(degrees <= MOST_DEG, degrees, np.nan)


def _levels(sigma: Radius, without: Radius, threshold: Array, prior: Array, risk: Array) -> Array:
    """Return the levels exceeded without an alarm with at most a given risk, shape (n, 2).

    They solve ``P(error > L) + sum_j p_j P(error_j > L - T_j) = risk``, shapes (n, beacons, 2) of
    the faults j.
    the faults j.
    """
    # The estimate with all is one more, with threshold zero and share one.
    each = Radius(
        *(np.concatenate([a[:, None], b], axis=1) for a, b in zip(sigma, without, strict=True))
    )
    threshold = np.concatenate([np.zeros_like(threshold[:, :1]), threshold], axis=1)
    prior = np.concatenate([np.ones_like(prior[:, :1]), prior], axis=1)
    goal, own = np.log(risk), risk[:, None] / np.where(prior > 0.0, prior, 1.0)

    def more(level: Array) -> Array:
        total = (prior * each.tail(level[:, None] - threshold)).sum(axis=1)
        return np.asarray(np.log(np.maximum(total, MIN_COUNT)) - goal)

    # A single one has all of the risk at the lower end, and at most its part at the upper.
    reach, part = threshold + each.beyond(np.minimum(own, 1.0)), own / prior.shape[1]
    low = np.max(np.where((prior > 0.0) & (own < SINGLE_FAULT_TAIL), reach, 0.0), axis=1)
    reach = threshold + each.beyond(np.minimum(part, 1.0))
    high = np.max(np.where(prior > 0.0, reach, 0.0), axis=1)
    return _crossing(more, np.maximum(low - PRECISE * high, 0.0), high)


def _crossing(falling: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Return where functions fall below zero between two ends, from above.

    By chords between the ends; the value of an end that does not move is halved from step to step,
    so that the other moves, too (the Illinois algorithm).  A converged one is kept, however long
    the others take.
    """
    at_low, at_high, width = falling(low), np.minimum(falling(high), 0.0), PRECISE * high
    rose = np.full(high.shape, 2)
    with np.errstate(invalid="ignore"):  # for infinite ends
        for _ in range(MOST_STEPS):
            wide = high - low > width
            if not wide.any():
                break
            middle = low + (high - low) * (at_low / np.maximum(at_low - at_high, MIN_COUNT))
            # Not nearer to an end than requested: a step beyond the crossing closes in on it.
            middle = np.maximum(low + 0.4 * width, np.minimum(middle, high - 0.4 * width))
            result = falling(middle)
            rises = result > 0.0
            half = np.where(rises == rose, 0.5, 1.0)
            low = np.where(rises & wide, middle, low)
            high = np.where(rises | ~wide, high, middle)
            at_low, at_high = (
                np.where(rises, result, half * at_low),
                np.where(rises, half * at_high, result),
            )
            rose = rises
    return high


def with_rivals(level: Array, distance: Array, weight: Array, share: float) -> Array:
    """Return levels extended to every rival pose that is too probable to be ignored.

    Parameters
    ----------
    level : ndarray, shape (n,)
    distance : ndarray, shape (n, rivals)
        Of each rival hypothesis from the best.
    weight : ndarray, shape (n, rivals)
        Posterior share, falling.
    share : float
        Maximum total share of the rivals in the risk.
    """
    rest = np.cumsum(weight[:, ::-1], axis=1)[:, ::-1]
    reach = np.where(rest > share, distance + level[:, None], level[:, None])
    return np.max(np.concatenate([level[:, None], reach], axis=1), axis=1)
