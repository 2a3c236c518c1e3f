"""Difference quotients, for tests of Jacobians."""

from collections.abc import Callable

import numpy as np


def central_difference(
    function: Callable[[np.ndarray], np.ndarray], dimension: int, step: float
) -> np.ndarray:
    """Return the derivative of a function of a vector at zero; the vector's axis is the last."""
    columns = [
        (function(step * axis) - function(-step * axis)) / (2.0 * step)
        for axis in np.eye(dimension)
    ]
    return np.stack(columns, axis=-1)


def relative_to_group(result: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest error of a group of columns in units of the group's largest entry."""
    assert result.shape == expected.shape
    return float(np.max(np.abs(result - expected)) / np.max(np.abs(expected)))
