"""Slope of a series with correlated errors, whose correlation time is estimated from the series.

A line through a random walk has a slope that the scatter about it does not show.  The errors are a
Gauss-Markov process of unknown correlation time and white noise of unknown share; short times make
blocks of them independent, long ones make them a random walk.  The restricted likelihood (H. D.
Patterson and R. Thompson, Biometrika 58, 1971) gives the probability of each, apart from the line,
and the slope of generalised least squares is averaged over all of them, so that the interval is
wider for a short series.  The prior of a time is proportional to it: for a walk with a line the
restricted likelihood alone still too often selects a short correlation time
(`tests/test_drift.py`).
"""

from typing import NamedTuple

import numpy as np
from scipy.special import stdtr, stdtrit

from magfusion.units import Array

MAX_BLOCKS = 60  # whose means stand for the series
TIMES = 10  # correlation times, from half a block to `MAX_BLOCK` spans in equal ratios
MAX_BLOCK = 10.0
WHITE = (0.0, 0.3, 1.0, 3.0, 10.0, 100.0)  # variance, by what the process changes in a block
_TAILS = (0.975, 0.9995)  # quantiles that Student's distribution takes from the average


class Trend(NamedTuple):
    """A slope and Student's distribution of its error.

    `rate`: unit of the values per unit of time. `freedom`: degrees of freedom: those that give the
    average's quantiles of 97.5 and 99.95 %.
    """

    rate: float
    standard_error: float
    freedom: float


def trend(time: Array, value: Array) -> Trend:
    """Return the slope of a series and its standard error.

    Raises ValueError where fewer than three blocks have any value. `time` (n,): increasing. `value`
    (n,).
    """
    when, mean = _block_means(time, value)
    if len(when) < 3:
        raise ValueError(f"at least three blocks must have values; got {len(when)}")
    span = when[-1] - when[0]
    design = np.stack([np.ones_like(when), (when - np.mean(when)) / span], axis=1)
    lag = np.abs(when[:, None] - when) / span
    own, fresh = np.eye(len(when)), 1.0 / len(when)
    result = [
        (memory, *_fitted(design, mean, np.exp(-lag / memory) + noise * own))
        for memory in np.geomspace(0.5 * fresh, MAX_BLOCK, TIMES)
        for noise in -np.expm1(-fresh / memory) * np.array(WHITE)
    ]
    memory, rate, error, likelihood = np.array(result).T
    weight = memory * np.exp(likelihood - np.max(likelihood))
    weight /= np.sum(weight)
    freedom = len(when) - 2
    middle = float(weight @ rate)
    if not np.any(weight * error > 0.0):
        return Trend(middle / span, 0.0, freedom)
    near, far = (_half_width(rate - middle, error, weight, freedom, tail) for tail in _TAILS)
    shared = _freedom_of(far / near, freedom)
    return Trend(middle / span, near / float(stdtrit(shared, _TAILS[0])) / span, shared)


def _block_means(time: Array, value: Array) -> tuple[Array, Array]:
    """Return times and means of blocks of equal length, without empty ones."""
    blocks = min(MAX_BLOCKS, len(time))
    edges = np.linspace(time[0], time[-1], blocks + 1)
    own = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, blocks - 1)
    count = np.bincount(own, minlength=blocks)
    kept = count > 0
    sums = (np.bincount(own, part, minlength=blocks) for part in (time, value))
    when, mean = (total[kept] / count[kept] for total in sums)
    return when, mean


def _fitted(design: Array, value: Array, shape: Array) -> tuple[float, float, float]:
    """Return slope, its standard error and the restricted log-likelihood under a covariance."""
    lower = np.linalg.cholesky(shape)
    columns = np.linalg.solve(lower, np.column_stack([design, value]))
    remaining, upper = np.linalg.qr(columns[:, :2])
    along = remaining.T @ columns[:, 2]
    slope = float(along[1] / upper[1, 1])
    rest = columns[:, 2] - remaining @ along
    freedom = len(value) - 2
    # Below it, the residual of a straight line is rounding.
    least = (1e-12 * float(np.max(np.abs(value)) or 1.0)) ** 2
    square = max(float(rest @ rest), least)
    sizes = np.abs(np.concatenate([np.diag(lower), np.diag(upper)]))
    likelihood = -float(np.sum(np.log(sizes))) - 0.5 * freedom * np.log(square)
    return slope, float(np.sqrt(square / freedom)) / abs(float(upper[1, 1])), likelihood


def _half_width(offset: Array, error: Array, weight: Array, freedom: float, tail: float) -> float:
    """Return the quantile of an average of Student's distributions, relative to its middle."""
    reach = float(stdtrit(freedom, tail))
    low, high = 0.0, float(np.max(np.abs(offset) + reach * error))
    for _ in range(60):
        half = 0.5 * (low + high)
        both = stdtr(freedom, (half - offset) / error)
        both = both + stdtr(freedom, (half + offset) / error)
        if float(weight @ both) < 2.0 * tail:
            low = half
        else:
            high = half
    return high


def _freedom_of(ratio: float, maximum: float) -> float:
    """Return the degrees of freedom with this ratio of the outer to the inner quantile."""
    low, high = 1.0, float(maximum)
    for _ in range(50):
        half = 0.5 * (low + high)
        near, far = stdtrit(half, _TAILS)
        low, high = (half, high) if far / near > ratio else (low, half)
    return high
