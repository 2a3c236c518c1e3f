"""Whether an estimator's covariance is consistent: chi-square tests of normalised errors."""

import numpy as np
from scipy.special import gammaincinv

from magfusion.units import Array, IntArray


def average_nees_bounds(dof: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the two-sided interval of the average NEES of a consistent estimator.

    Parameters
    ----------
    dof : int
        Degrees of freedom of one error.
    runs : int
        Number of independent errors in the average.
    confidence : float
        Probability that a consistent estimator falls inside.

    Returns
    -------
    tuple of float
        Lower and upper bound; the expectation is ``dof`` (Bar-Shalom, Li and Kirubarajan, 5.4.2).
    """
    tail = 0.5 * (1.0 - confidence)
    low, high = 2.0 * gammaincinv(0.5 * dof * runs, [tail, 1.0 - tail]) / runs
    return float(low), float(high)


def pooled_nees(errors: Array, covs: Array, epochs: IntArray) -> float:
    """Return the average NEES over runs and a few well separated epochs.

    Errors correlate in time, so that neighbouring epochs would count one error many times.

    Parameters
    ----------
    errors : ndarray, shape (runs, n, dof)
    covs : ndarray, shape (runs, n, dof, dof)
    epochs : ndarray of int, shape (m,)
        Which epochs to pool; compare with ``average_nees_bounds(dof, runs * m)``.
    """
    picked = errors[:, epochs]
    weighted = np.linalg.solve(covs[:, epochs], picked[..., None])[..., 0]
    return float(np.mean(np.einsum("rmi,rmi->rm", picked, weighted)))
