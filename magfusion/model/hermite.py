"""Cubic Hermite interpolation.

Equivalent to `scipy.interpolate.CubicHermiteSpline`, which first computes the cubics between all
known times and takes fifty times as long for a hundred times among five thousand.
"""

import numpy as np

from magfusion.units import Array


def hermite(known: Array, value: Array, slope: Array, wanted: Array) -> tuple[Array, Array]:
    """Return values and slopes of the interpolating cubics at some times.

    Beyond the ends the last cubics are extrapolated. `known` (n,): strictly increasing (s).
    `value`, `slope` (n, k), `wanted` (m,) (s). Returns (m, k) each.
    """
    index = known.searchsorted(wanted, side="right") - 1
    index = np.minimum(np.maximum(index, 0), len(known) - 2)  # faster than clip for few
    later, from_time, from_value = index + 1, known[index], value[index]
    step = (known[later] - from_time)[:, None]
    share = (wanted - from_time)[:, None] / step
    rise, begin, end = value[later] - from_value, slope[index] * step, slope[later] * step
    square, cube = 3.0 * rise - 2.0 * begin - end, begin + end - 2.0 * rise
    return (
        from_value + share * (begin + share * (square + share * cube)),
        (begin + share * (2.0 * square + 3.0 * share * cube)) / step,
    )
