"""Variance components of a beacon's residuals: noise, and errors of its field model.

An error that is constant in place multiplies a beacon's field by a matrix, which changes with
place.  Its smoothness is not declared; so a rough and a smooth kind are separated by how residuals
change from epoch to epoch, and both together have the declared size as their prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np

from magfusion.estimation.posterior.residual_redundancy import ChannelErrors
from magfusion.estimation.solve.bounded import minimise_curved
from magfusion.units import Array, IntArray

PRIOR = float(np.log(2.0))  # of the logarithm of a declared sigma
MIN_FACTOR, MAX_FACTOR = 0.1, 1e3  # of a factor; no log can determine a smaller noise
COMPONENTS = 6  # of a residual
DRAWN_BLOCKS = 16  # drawn errors of a stretch with one share
STUDENT = 4.0  # degrees of freedom: faults have little weight
# Gain, by components, with which that distribution finds the variance of normal residuals.
NORMAL = {3: 1.322946, 6: 1.224631}
SCALES = 8  # successive epochs that are compared, so far apart that they share no sample
WEIGHINGS = 5  # iterations of the epochs' weights, at first as if all were noise
NONE = 1e-4  # of a part that was not declared: negligible
# Parts with one declared sigma: noise, and a model error that is rough or smooth.
KINDS = (slice(0, 1), slice(1, 3))


class BeaconParts(NamedTuple):
    """Most probable components of one beacon's residuals."""

    sizes: tuple[float, float]  # noise factor and model error as declared
    white: float  # factor of the declared noise, by all white parts
    # factor of the declared model error; None where it was not estimated
    model: float | None = None
    smooth: float = 0.0  # share of its variance that is smooth
    # ratio of the factor estimated from errors drawn with the estimated sizes to the true one
    accepted_factor: float = 1.0


@dataclass(frozen=True, eq=False)
class BeaconErrors:
    """Errors of all channels of one beacon."""

    channels: list[ChannelErrors]
    sizes: tuple[float, float]  # noise factor and model error as declared
    bent: bool  # whether a model error is estimated


def parts_of(
    beacons: Sequence[BeaconErrors], shared_by: Array, lag: int
) -> list[BeaconParts | None]:
    """Return the components of each beacon's residuals; None where there are too few.

    `shared_by` (n,): number of epochs with the same model error. `lag`: number of epochs that share
    samples.
    """
    fitted = _fitted(beacons, shared_by, lag)
    bent = [k for k, (log, _) in enumerate(fitted) if len(log) and beacons[k].bent]
    drawn = [_drawn(beacons[k], *fitted[k]) for k in bent]
    again = dict(zip(bent, _fitted(drawn, shared_by, lag), strict=True))
    result: list[BeaconParts | None] = []
    for k, (log, white) in enumerate(fitted):
        if k in again:
            model, smooth = _total(log), float(np.exp(2.0 * (log[2] - _logarithm(log[1:3]))))
            selected = _total(again[k][0]) / model
            result.append(BeaconParts(beacons[k].sizes, white, model, smooth, selected))
        else:
            result.append(BeaconParts(beacons[k].sizes, white) if len(log) else None)
    return result


def _total(log: Array) -> float:
    return float(np.exp(_logarithm(log[1:3])))


def _logarithm(log: Array) -> float:
    """Return the logarithm of a standard deviation of several parts."""
    return float(0.5 * np.logaddexp.reduce(2.0 * log))


def _drawn(beacon: BeaconErrors, log: Array, white: float) -> BeaconErrors:
    """Return the first drawn errors, of these sizes, in place of the residuals."""
    of_noise, usual = white * beacon.sizes[0], beacon.sizes[1]
    of_rough, of_smooth = np.exp(log[1:3]) * usual
    drawn = []
    for own in beacon.channels:
        noise, rough, smooth, inertial = (part[:, :COMPONENTS] for part in own.residuals)
        size, model = own.size
        bent = (of_rough * rough + of_smooth * smooth) / model
        drawn.append(replace(own, seen=of_noise / size * noise + bent + inertial))
    return replace(beacon, channels=drawn)


def _fitted(
    beacons: Sequence[BeaconErrors], shared_by: Array, lag: int
) -> list[tuple[Array, float]]:
    """Return logarithms of the factors of all parts, and the factor of all white parts."""
    scaled = [by_scale(beacon.channels, shared_by, lag) for beacon in beacons]
    result = [(np.zeros(0), 1.0)] * len(beacons)
    for bent in (False, True):
        chosen = [k for k, b in enumerate(beacons) if b.bent == bent and len(scaled[k][0])]
        if chosen:
            sizes = np.array([beacons[k].sizes for k in chosen])
            several = _fitted_same_parts([scaled[k] for k in chosen], sizes, lag, bent)
            for k, one in zip(chosen, several, strict=True):
                result[k] = one
    return result


def _fitted_same_parts(
    scaled: list[tuple[Array, Array, Array]], sizes: Array, lag: int, bent: bool
) -> list[tuple[Array, float]]:
    """Return the result of `_fitted` for beacons that have the same parts.

    `scaled`: from `by_scale`, one per beacon. `sizes` (k, 2).
    """
    maximum = max(len(square) for square, _, _ in scaled)
    square, near = np.zeros((len(scaled), maximum)), np.ones((len(scaled), maximum))
    expected, weighed = np.zeros((len(scaled), 5, maximum)), np.zeros((len(scaled), maximum))
    expected[:, 4] = 1.0  # of missing rows, with zero weight
    for k, (seen, parts, close) in enumerate(scaled):
        rows = slice(0, len(seen))
        square[k, rows], expected[k, :, rows], near[k, rows] = seen, parts, close
        weighed[k, rows] = 1.0 / lag
    known, fixed, weight = (
        sizes[:, [0, 1, 1, 1], None] ** 2 * expected[:, :4],
        expected[:, 4],
        weighed,
    )
    if not bent:
        known, fixed = known[:, :1], fixed + known[:, 1]
    log: Array | None = None
    for _ in range(WEIGHINGS):
        log = maximize_likelihood(
            square, known, fixed, weight, 6, KINDS if bent else KINDS[:1], log
        )
        parts = np.exp(2.0 * log)[:, :, None] * known
        of_model = np.sum(parts[:, 1:3], axis=1) if bent else fixed
        of_model = of_model / (np.sum(parts, axis=1) + fixed)
        weight = (1.0 - of_model + of_model * near) * weighed
    # White errors proportional to the field, as of a jitter among gradients, count as noise.
    usual = np.sum(known[:, 0], axis=1)
    white = np.sum(parts[:, ::3], axis=(1, 2)) / usual
    # For a strong beacon less noise than declared cannot be distinguished from a small model error.
    unsure = MIN_FACTOR**2 * np.sum(known[:, 3:], axis=(1, 2)) / usual
    assert log is not None
    white = np.sqrt(np.maximum(white, np.minimum(white + unsure, 1.0)))
    return list(zip(log, white.tolist(), strict=True))


def by_scale(
    channels: list[ChannelErrors], shared_by: Array, lag: int
) -> tuple[Array, Array, Array]:
    """Return squares of a beacon's residuals on several scales of time, and their expectation.

    Noise is equal on all scales; an error that is constant in place is mostly in the longest.  Its
    share in the shorter ones depends on its smoothness, which is not declared: they measure its
    size only if the smoothness is estimated, too. Returns `square` (m,); `expected` (5, m): of a
    component, by noise, by a rough and by a smooth model error of size one, by a relative error of
    size one that is white, and by inertial noise; `near` (m,): share that is independent, where
    model error prevails.
    """
    every, seen, parts, near = _haar(SCALES), [], [], []
    for own in channels:
        used = len(own.seen) // (SCALES * lag) * SCALES * lag
        shape, draws = (-1, SCALES, lag), own.residuals[0].shape[1] // COMPONENTS
        squares = []
        for v in (own.seen, *own.residuals):
            rows = np.einsum("hs,bslk->hblk", every, v[:used].reshape(*shape, v.shape[1]))
            squares.append(np.sum(rows**2, axis=3).reshape(SCALES, -1))
        seen.append(squares[0])
        given = [np.mean(v[:used].reshape(shape), axis=1).ravel() for v in own.variance]
        parts.append(_expected(np.stack(squares[1:]) / draws, np.array(given), own.size, draws))
        close = np.mean(shared_by[own.epoch][:used].reshape(shape), axis=1).ravel()
        near.append(np.minimum(SCALES * lag / close, 1.0))
    expected = np.concatenate(parts, axis=2).reshape(5, -1)
    return np.concatenate(seen, axis=1).ravel(), expected, np.tile(np.concatenate(near), SCALES)


def _expected(residual: Array, given: Array, size: tuple[float, float], draws: int) -> Array:
    """Return the expected square of a component by each kind of error, (5, scales, blocks).

    The share of an error in a scale depends on the motion: it is determined for each stretch of as
    few blocks as the number of draws allows. `residual` (4, scales, blocks): squares of the
    remainders of drawn errors, mean of the draws. `given` (2, blocks): variance by noise and by a
    model error of size one. `size`: of the drawn noise and model error.
    """
    if residual.shape[2] == 0:
        return np.zeros((5, SCALES, 0))
    # The effect of a wrong motion increases with the field, too.
    drawn = np.stack([*given, given[1], given[1]])
    begin, stretch = _stretches(drawn.shape[1], draws)
    total = np.array([size[0], size[1], size[1], 1.0]) ** 2
    total = total[:, None, None] * np.add.reduceat(drawn, begin, axis=1)[:, None]
    kept = np.add.reduceat(residual, begin, axis=2)
    share = np.divide(kept, total, out=np.ones_like(kept), where=total > 0.0)[..., stretch]
    parts = share * drawn[:, None] / COMPONENTS
    white = share[0] * drawn[1] / COMPONENTS
    return np.stack([*parts[:3], white, parts[3]])


def _stretches(blocks: int, draws: int) -> tuple[IntArray, IntArray]:
    """Return the first block of each stretch, and the stretch of each block."""
    count = int(np.clip(blocks * draws // DRAWN_BLOCKS, 1, blocks))
    stretch = np.arange(blocks) * count // blocks
    return np.searchsorted(stretch, np.arange(count)), stretch


@cache
def _haar(size: int) -> Array:
    """Return the orthonormal Haar transform, shape (size, size): the mean first."""
    if size == 1:
        return np.ones((1, 1))
    means = np.kron(_haar(size // 2), [1.0, 1.0])
    steps = np.kron(np.eye(size // 2), [1.0, -1.0])
    return np.concatenate([means, steps]) / np.sqrt(2.0)


def maximize_likelihood(
    square: Array,
    parts: Array,
    fixed: Array,
    weight: Array,
    components: int,
    kinds: Sequence[slice] = (slice(0, 1),),
    near: Array | None = None,
) -> Array:
    """Return the logarithm of the factor of each part's standard deviation.

    For each of k beacons, or other sources of separate residuals.

    Parameters
    ----------
    square : ndarray, shape (k, m)
        Squared norms of residuals.
    parts : ndarray, shape (k, kinds, m)
        Expected square of a component by each kind of noise, as declared.
    fixed : ndarray, shape (k, m)
        Expected square of a component by all other noise.
    weight : ndarray, shape (k, m)
        Share of each that is independent.
    components : int
        Of each residual.
    kinds : sequence of slice
        Parts with one declared sigma in total.  The others have no declared sigma and may vanish.
    near : ndarray, shape (k, kinds), optional
        Estimate with other weights, where the search begins.  A negligible part, where the cost has
        no slope, begins as a small one, unless that were less probable.

    Returns
    -------
    ndarray, shape (k, kinds)
    """
    count = parts.shape[1]
    first, least, of_kind = _of_kinds(count, kinds)
    # Which parts belong together; of all kinds in one operation.
    together = of_kind @ of_kind.T
    gain, width = NORMAL[components], STUDENT + components

    scaled = gain * square
    reach, constant = scaled / STUDENT, width * scaled
    doubled = 2.0 * weight

    def cost(log: Array) -> Array:
        squares = np.exp(2.0 * log)
        variance = (squares[:, None] @ parts)[:, 0] + fixed
        bounded = width * np.log1p(reach / variance) + components * np.log(variance)
        prior = np.log(squares @ of_kind) / PRIOR
        return 0.5 * (weight * bounded).sum(axis=1) + 0.125 * (prior**2).sum(axis=1)

    def curved(log: Array) -> tuple[Array, Array]:
        squares = np.exp(2.0 * log)
        by = squares[:, :, None] * parts
        variance = by.sum(axis=1) + fixed
        heavy = STUDENT * variance + scaled
        residual = (components - constant / heavy) / variance
        bend = (STUDENT * constant / heavy**2 - residual) / variance
        curvature = (by * (doubled * bend)[:, None]) @ by.transpose(0, 2, 1)
        total = squares @ of_kind
        share = squares * ((1.0 / total) @ of_kind.T)
        off = (0.5 / PRIOR**2 * np.log(total)) @ of_kind.T
        slope = (by @ (weight * residual)[:, :, None])[:, :, 0] + off * share
        outer = ((1.0 / PRIOR**2 - 2.0 * off) * share)[:, :, None] * share[:, None]
        curvature += together * outer
        curvature.reshape(len(log), -1)[:, :: count + 1] += 2.0 * slope
        return slope, curvature

    start = np.tile(first, (len(parts), 1))
    if near is not None:
        little = np.log(MIN_FACTOR)
        stays = (near < little) & (curved(near)[0] > 0.0)
        start = np.where(stays, near, np.maximum(near, little))
    limits = np.log(np.stack([least, np.full(count, MAX_FACTOR)], axis=1))
    return minimise_curved(cost, curved, start, limits)


def _of_kinds(count: int, kinds: Sequence[slice]) -> tuple[Array, Array, Array]:
    """Return start and lower bound of each part, and which parts are of each kind."""
    first, least = np.full(count, np.log(MIN_FACTOR)), np.full(count, NONE)
    of_kind = np.zeros((count, len(kinds)))
    for k, kind in enumerate(kinds):
        first[kind] = -0.5 * np.log(kind.stop - kind.start)
        least[kind.start] = MIN_FACTOR
        of_kind[kind, k] = 1.0
    return first, least, of_kind
