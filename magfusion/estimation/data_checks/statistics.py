"""Statistical tests that share one budget of false alarms.

A result is tested many times, by parameter, beacon, axis and time.  By Holm's procedure, all tests
together raise a false alarm in a share of `FALSE_ALARMS` of correct results.
Probabilities are logarithms, since those of real faults underflow.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtrc, chdtri, fdtri, gammaln, ndtri_exp

from magfusion.units import Array, BoolArray

FALSE_ALARMS = 0.005  # of all tests of one result together
TEST_FAMILIES = 5  # that share it equally; each applies Holm's procedure to its part
TEST_BUDGET = FALSE_ALARMS / TEST_FAMILIES
P_CERTAIN = 1e-9  # probability of `DETECTION_SIGMAS`, two-sided: evidence that may fail a result
DETECTION_SIGMAS = 6.0
# Of the prior's variance; below, a direction has no information from the data.
MIN_INFORMATION_RATIO = 0.02
TOLERATED = 2.0  # chi square per degree of freedom below which sigmas are acceptable
MAD_TO_SIGMA = 1.4826  # standard over median absolute deviation, normal distribution
_UNDERFLOW = -600.0  # log probability below which the exact function underflows


def log_p_chi_square(value: Array | float, freedom: Array | float) -> Array:
    """Return the logarithm of the probability of a chi square at least this large.

    `value`, `freedom`: the degrees of freedom may be fractional, for correlated numbers. Returns
    finite for every finite value.
    """
    value, freedom = np.broadcast_arrays(
        np.maximum(np.asarray(value, dtype=float), 0.0), np.asarray(freedom, dtype=float)
    )
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        # As chi2.logsf, which is minus infinity below the range of a float.
        exact = np.where(freedom > 0.0, np.log(chdtrc(freedom, value)), np.nan)
        half, shape = 0.5 * value, 0.5 * freedom
        # Far out: the first terms of the asymptotic series of the incomplete gamma function.
        excess = np.maximum(half - shape + 1.0, 1.0)
        tail = shape * np.log(np.maximum(half, 1e-300)) - half - np.log(excess) - gammaln(shape)
    return np.where((exact > _UNDERFLOW) | (half < shape), exact, np.minimum(tail, 0.0))


def largest_mean_square(probability: float, freedom: float, noise_freedom: float) -> float:
    """Return the mean square that chance exceeds with a probability, relative to its expectation.

    `freedom`: degrees of freedom of the mean square. `noise_freedom`: of its expectation if that is
    estimated, and the ratio has Fisher's F distribution; infinite if it is known.
    """
    if np.isinf(noise_freedom):
        return float(chdtri(freedom, probability)) / freedom
    return float(fdtri(freedom, noise_freedom, 1.0 - probability))


def sigmas(log_p: Array | float) -> Array:
    """Return the two-sided number of standard deviations of a probability."""
    return np.asarray(-ndtri_exp(np.minimum(np.asarray(log_p, dtype=float) - np.log(2.0), -0.7)))


def holm(log_p: Sequence[float] | Array, budget: float = FALSE_ALARMS) -> BoolArray:
    """Return which tests are significant, at a family-wise false-alarm rate of ``budget``.

    `log_p`: of all tests, also of insignificant ones.
    """
    given = np.asarray(log_p, dtype=float)
    out = np.zeros(len(given), dtype=bool)
    order = np.argsort(given, kind="stable")
    residual = np.log(budget) - np.log(np.arange(len(given), 0, -1, dtype=float))
    missed = np.flatnonzero(~(given[order] <= residual))
    out[order[: missed[0] if len(missed) else len(given)]] = True
    return out


def effective_number(residual: Array) -> float:
    """Return the effective number of independent samples of a series, from its autocorrelation.

    `residual` (n, ...): time first; all series are assumed to have the same correlation. NaN is
    missing. Returned at most n: Bartlett's sum for the variance of a sum of squares, up to where
    the correlation falls below its own noise.
    """
    flat = residual.reshape(len(residual), -1)
    known = np.isfinite(flat)
    filled = np.where(known, flat, 0.0)
    count = len(flat)
    if count < 3 or not np.any(known):
        return float(count)
    squares = float(np.sum(filled**2))
    if squares == 0.0:
        return float(count)
    total, mean_square = 1.0, squares / np.sum(known)
    for lag in range(1, count // 2):
        both = float(np.sum(known[lag:] & known[:-lag]))
        if both == 0.0:
            break
        correlation = float(np.sum(filled[lag:] * filled[:-lag])) / (both * mean_square)
        if correlation < 2.0 / np.sqrt(both):
            break
        total += 2.0 * (1.0 - lag / count) * correlation**2
    return count / total
