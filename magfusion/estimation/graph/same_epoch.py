"""Stamps that differ by rounding belong to one state.

Between states as near as rounding an inertial factor has no covariance, and the graph no solution.
"""

import numpy as np

from magfusion.units import Array

SAME_TIME = 1e-6  # s; stamps that differ by less are of one state


def at_epochs(time: Array, epochs: Array) -> Array:
    """Return times, each replaced by an epoch that it means.

    `time` (n,) (s). `epochs` (m,): in any order, at least one (s).
    """
    every = np.sort(epochs)
    row = np.searchsorted(every, time)
    before, after = every[np.maximum(row - 1, 0)], every[np.minimum(row, len(every) - 1)]
    nearest = np.where(time - before < after - time, before, after)
    return np.where(np.abs(nearest - time) < SAME_TIME, nearest, time)
