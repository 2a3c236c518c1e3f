"""Protection levels: bounds of the error that hold if a beacon, or two, are faulty unseen.

See `magfusion.estimation.posterior.separation`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from magfusion.estimation.posterior.separation import (
    MIN_COUNT,
    PARTS,
    POSE,
    SINGLE_FAULT_TAIL,
    Radius,
    Separation,
    radii,
)
from magfusion.model.trust import Risk
from magfusion.units import DEGREE, Array, BoolArray, IntArray

PRECISE, MAX_STEPS = 1e-7, 60  # of a level
MAX_DEG = 180.0  # an attitude level beyond it is not informative
PAIRS_MATTER = 0.5  # share of the risk, above which two faulty beacons are monitored
AT_ONCE = 256  # states whose pairs are computed together


def unmonitored(prior: Array, monitored: int = 1) -> Array:
    """Return the probability that more than one beacon, or two, are faulty, shape (n,).

    `prior` (n, beacons). `monitored`: number of faulty beacons that are monitored: 1 or 2.
    """
    none = np.prod(1.0 - prior, axis=1)
    odds = prior / np.maximum(1.0 - prior, np.finfo(np.float64).tiny)
    one = np.sum(odds, axis=1)
    two = 0.5 * (one**2 - np.sum(odds**2, axis=1)) if monitored > 1 else 0.0
    return np.maximum(1.0 - none * (1.0 + one + two), 0.0)


class FaultModes(NamedTuple):
    """Hypotheses of faulty beacons at each state."""

    sigma: Radius  # (n, modes, 2), of the estimates without their beacons
    threshold: Array  # (n, modes, 2), largest deviation from these estimates (rad, m)
    prior: Array  # (n, modes)

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
    beacon that may be faulty, or without two that are faulty too often. `slack`: as of
    `Separation.thresholds`. `prior` (n, beacons): probability that each beacon is faulty, where
    more is known than `Risk.fault`.
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
    return level[:, 1], np.where(degrees <= MAX_DEG, degrees, np.nan)


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
        for _ in range(MAX_STEPS):
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

    `level` (n,). `distance` (n, rivals): of each rival hypothesis from the best.
    `weight` (n, rivals): posterior share, falling. `share`: maximum total share of the rivals in
    the risk.
    """
    rest = np.cumsum(weight[:, ::-1], axis=1)[:, ::-1]
    reach = np.where(rest > share, distance + level[:, None], level[:, None])
    return np.max(np.concatenate([level[:, None], reach], axis=1), axis=1)
