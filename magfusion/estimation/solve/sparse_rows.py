"""Products of rows that depend on few of the hundreds of parameters of many beacons."""

from math import prod

import numpy as np
from scipy.sparse import csr_array

from magfusion.units import Array

SPARSE_COLUMNS = 256  # of parameters; of so many, a row depends on few


def sparse_if_wide(matrix: Array) -> Array | csr_array:
    """Return a matrix (m, n), sparse if it has the columns of many beacons."""
    return csr_array(matrix) if matrix.shape[1] >= SPARSE_COLUMNS else matrix


def times_spread(columns: Array, spread: Array) -> Array:
    """Return columns (..., k) times a spread (k, h) of parameters, most of them independent."""
    rows = prod(columns.shape[:-1]), len(spread)
    result = columns.reshape(rows) @ sparse_if_wide(spread)
    return np.asarray(result).reshape(*columns.shape[:-1], spread.shape[1])
