"""Cubics through values and slopes.

As `scipy.interpolate.CubicHermiteSpline`, which takes longer to import than what it does here.
"""

import numpy as np

from magfusion.units import Array


def hermite(known: Array, value: Array, slope: Array, wanted: Array) -> tuple[Array, Array]:
    """Return values and slopes at some times of the cubics through those at the known ones.

    Beyond the ends the last cubics go on.

    Parameters
    ----------
    known : ndarray, shape (n,)
        Strictly increasing (s).
    value, slope : ndarray, shape (n, k)
    wanted : ndarray, shape (m,)
        (s)

    Returns
    -------
    tuple of ndarray, shape (m, k)
    """
    index = np.clip(np.searchsorted(known, wanted, side="right") - 1, 0, len(known) - 2)
    step = (known[index + 1] - known[index])[:, None]
    share = (wanted - known[index])[:, None] / step
    rise, begin, end = value[index + 1] - value[index], slope[index] * step, slope[index + 1] * step
    square, cube = 3.0 * rise - 2.0 * begin - end, begin + end - 2.0 * rise
    return (
        value[index] + share * (begin + share * (square + share * cube)),
        (begin + share * (2.0 * square + 3.0 * share * cube)) / step,
    )
