"""Variance components of a beacon's residuals: noise, and what the model of its field lacks.

An error that is constant in place goes with a beacon's field by a matrix, which changes with place.
How smoothly it does nobody declares; so a rough and a smooth kind are told apart by how residuals
change from epoch to epoch, and both together have the declared size as their prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from magfusion.estimation.residual_shares import ChannelErrors
from magfusion.estimation.solve.bounded import minimise_curved
from magfusion.units import Array

PRIOR = float(np.log(2.0))  # of the logarithm of a declared sigma
LEAST, MOST = 0.1, 1e3  # of a factor; that a noise is smaller yet, no log tells for sure
STUDENT = 4.0  # degrees of freedom: what is false says little
# Gain, by components, with which that distribution finds the variance of normal residuals.
NORMAL = {3: 1.322946, 6: 1.224631}
SCALES = 8  # epochs in a row that are compared, so far apart that they share no sample
WEIGHINGS = 5  # times that the epochs are weighed by what is found, at first as if noise were all
NONE = 1e-4  # of a part that was not declared: as good as none
# Parts of which one sigma was declared: noise, and a model error that is rough or smooth.
KINDS = (slice(0, 1), slice(1, 3))


@dataclass(frozen=True)
class BeaconParts:
    """What the residuals of one beacon are likeliest made of.

    Parameters
    ----------
    sizes : tuple of float
        Noise factor and model error as declared.
    white : float
        Factor of the declared noise, by all that is white.
    model : float, optional
        Factor of the declared model error; None where none was looked for.
    smooth : float
        Share of its variance that is smooth.
    taken : float
        Factor found in errors that were drawn with those that were found, over theirs.
    """

    sizes: tuple[float, float]
    white: float
    model: float | None = None
    smooth: float = 0.0
    taken: float = 1.0


def parts_of(
    channels: list[ChannelErrors],
    alike: Array,
    lag: int,
    sizes: tuple[float, float],
    *,
    bent: bool,
) -> BeaconParts | None:
    """Return what a beacon's residuals are made of; None where there are too few.

    Parameters
    ----------
    channels : list of ChannelErrors
        Of the beacon.
    alike : ndarray, shape (n,)
        How many epochs have the same model error.
    lag : int
        Epochs that share samples.
    sizes : tuple of float
        Noise factor and model error as declared.
    bent : bool
        Whether a model error is looked for.
    """
    log, white = _fitted(channels, alike, lag, sizes, bent)
    if not len(log) or not bent:
        return BeaconParts(sizes, white) if len(log) else None
    model, smooth = _total(log), float(np.exp(2.0 * (log[2] - _logarithm(log[1:3]))))
    factors = [white * sizes[0], *(np.exp(log[1:3]) * sizes[1])]
    drawn = [_drawn(own, factors) for own in channels]
    again, _ = _fitted(drawn, alike, lag, sizes, bent)
    return BeaconParts(sizes, white, model, smooth, _total(again) / model)


def _total(log: Array) -> float:
    return float(np.exp(_logarithm(log[1:3])))


def _logarithm(log: Array) -> float:
    """Return the logarithm of a standard deviation of several parts."""
    return float(0.5 * np.logaddexp.reduce(2.0 * log))


def _drawn(own: ChannelErrors, factors: Sequence[float]) -> ChannelErrors:
    """Return errors that were drawn, of these sizes, in the place of those seen."""
    noise, rough, smooth, inertial = own.left
    of_noise, of_rough, of_smooth = factors
    size, model = own.size
    bent = (of_rough * rough + of_smooth * smooth) / model
    return replace(own, seen=of_noise / size * noise + bent + inertial)


def _fitted(
    channels: list[ChannelErrors], alike: Array, lag: int, sizes: tuple[float, float], bent: bool
) -> tuple[Array, float]:
    """Return logarithms of the factors of all parts, and the factor of all that is white."""
    square, expected, near = by_scale(channels, alike, lag)
    if not len(square):
        return np.zeros(0), 1.0
    noise, usual = sizes
    known = np.array([noise, usual, usual, usual])[:, None] ** 2 * expected[:4]
    fixed, weight = expected[4], np.full(len(square), 1.0 / lag)
    if not bent:
        known, fixed = known[:1], fixed + known[1]
    log: Array | None = None
    for _ in range(WEIGHINGS):
        log = likeliest(square, known, fixed, weight, 6, KINDS if bent else KINDS[:1], log)
        parts = np.exp(2.0 * log)[:, None] * known
        of_model = np.sum(parts[1:3], axis=0) if bent else fixed
        of_model = of_model / (np.sum(parts, axis=0) + fixed)
        weight = (1.0 - of_model + of_model * near) / lag
    # What is white but goes with the field, as of a jitter among gradients, is noise all told.
    white = float(np.sum(parts[::3]) / np.sum(known[0]))
    # Of a strong beacon less noise than declared is not to be told from a little model error.
    unsure = LEAST**2 * float(np.sum(known[3:]) / np.sum(known[0]))
    assert log is not None
    return log, float(np.sqrt(max(white, min(white + unsure, 1.0))))


def by_scale(channels: list[ChannelErrors], alike: Array, lag: int) -> tuple[Array, Array, Array]:
    """Return squares of a beacon's residuals on several scales of time, and their expectation.

    Noise is alike on all scales; an error that is constant in place is mostly in the longest.  How
    much of it is in the shorter ones depends on how smooth it is, which nobody declares: what they
    have is no measure of its size unless that is found, too.

    Returns
    -------
    square : ndarray, shape (m,)
    expected : ndarray, shape (5, m)
        Of a component, by noise, by a rough and by a smooth model error of size one, by a relative
        error of size one that is white, and by inertial noise.
    near : ndarray, shape (m,)
        Share of it that is independent, where model error prevails.
    """
    squares, parts, nears = [np.zeros(0)], [np.zeros((5, 0))], [np.zeros(0)]
    for scale in _haar(SCALES):
        seen, left, given = [], [], []
        for own in channels:
            used = len(own.seen) // (SCALES * lag) * SCALES * lag
            shape = (-1, SCALES, lag)
            rows = [
                np.einsum("s,bslk->blk", scale, v[:used].reshape(*shape, 6)).reshape(-1, 6)
                for v in (own.seen, *own.left)
            ]
            seen.append(np.sum(rows[0] ** 2, axis=1))
            left.append([np.sum(row**2, axis=1) for row in rows[1:]])
            given.append([np.mean(v[:used].reshape(shape), axis=1).ravel() for v in own.variance])
            close = np.mean(alike[own.epoch][:used].reshape(shape), axis=1).ravel()
            nears.append(np.minimum(SCALES * lag / close, 1.0))
        kept, drawn = np.concatenate(left, axis=1), np.concatenate(given, axis=1)
        # Of a wrong motion too, a stronger field has more.
        drawn = np.stack([*drawn, drawn[1], drawn[1]])
        noise, model = channels[0].size
        total = np.array([noise, model, model, 1.0]) ** 2 * np.sum(drawn, axis=1)
        share = np.divide(np.sum(kept, axis=1), total, out=np.ones(4), where=total > 0.0)
        squares += seen
        rows = share[:, None] * drawn / 6.0
        parts.append(np.stack([*rows[:3], share[0] * drawn[1] / 6.0, rows[3]]))
    return np.concatenate(squares), np.concatenate(parts, axis=1), np.concatenate(nears)


@cache
def _haar(size: int) -> Array:
    """Return the orthonormal Haar transform, shape (size, size): the mean first."""
    if size == 1:
        return np.ones((1, 1))
    means = np.kron(_haar(size // 2), [1.0, 1.0])
    steps = np.kron(np.eye(size // 2), [1.0, -1.0])
    return np.concatenate([means, steps]) / np.sqrt(2.0)


def likeliest(
    square: Array,
    parts: Array,
    fixed: Array,
    weight: Array,
    components: int,
    kinds: Sequence[slice] = (slice(0, 1),),
    near: Array | None = None,
) -> Array:
    """Return the logarithm of what each part's standard deviation is too small by.

    Parameters
    ----------
    square : ndarray, shape (m,)
        Squared norms of residuals.
    parts : ndarray, shape (kinds, m)
        Expected square of a component by each kind of noise, as declared.
    fixed : ndarray, shape (m,)
        And by all else.
    weight : ndarray, shape (m,)
        Of each: how much of it is independent.
    components : int
        Of each residual.
    kinds : sequence of slice
        Parts of which one sigma was declared for all together.  Of the others nothing was: there
        may be none of them.
    near : ndarray, shape (kinds,), optional
        What was found with other weights: the search begins there, but never of next to nothing,
        where the cost has no slope.
    """
    start, least = np.full(len(parts), np.log(LEAST)), np.full(len(parts), NONE)
    for kind in kinds:
        start[kind] = -0.5 * np.log(kind.stop - kind.start)
        least[kind.start] = LEAST
    if near is not None:
        start = np.maximum(near, np.log(LEAST))
    gain, width = NORMAL[components], STUDENT + components

    scaled = gain * square
    reach, constant = scaled / STUDENT, width * scaled

    def cost(log: Array) -> float:
        squares = np.exp(2.0 * log)
        variance = squares @ parts + fixed
        bounded = width * np.log1p(reach / variance)
        likelihood = 0.5 * float(weight @ (components * np.log(variance) + bounded))
        priors = [np.log(np.sum(squares[kind])) / PRIOR for kind in kinds]
        return likelihood + 0.125 * float(np.sum(np.square(priors)))

    def curved(log: Array) -> tuple[Array, Array]:
        squares = np.exp(2.0 * log)
        by = squares[:, None] * parts
        variance = np.sum(by, axis=0) + fixed
        heavy = STUDENT * variance + scaled
        left = (components - constant / heavy) / variance
        bend = (STUDENT * constant / heavy**2 - left) / variance
        slope = by @ (weight * left)
        curvature = 2.0 * (by * (weight * bend)) @ by.T + np.diag(2.0 * slope)
        for kind in kinds:
            total = float(np.sum(squares[kind]))
            share, off = squares[kind] / total, 0.5 * np.log(total) / PRIOR**2
            slope[kind] += off * share
            curvature[kind, kind] += 2.0 * off * np.diag(share)
            curvature[kind, kind] += (1.0 / PRIOR**2 - 2.0 * off) * np.outer(share, share)
        return slope, curvature

    limits = np.log(np.stack([least, np.full(len(parts), MOST)], axis=1))
    return minimise_curved(cost, curved, start, limits)
