"""Sampling times of samples that arrive in batches, each with one stamp."""

import numpy as np

from magfusion.units import Array, IntArray

PAUSE = 3.0  # times the usual time between batches: a gap, over which nothing is spread


def spread_batches(stamps: Array, last: IntArray) -> Array:
    """Spread the samples of each batch evenly over the time since the batch before.

    `stamps` (n,): times of arrival (s), not decreasing. `last` (batches,): the last sample of each
    batch, which keeps its stamp; two batches at least. Returns (n,): strictly increasing (s),
    accurate to one step.
    """
    count = np.diff(last, prepend=-1)
    between = np.diff(stamps[last])
    usual = float(np.median(between))
    each = usual / float(np.median(count))
    whole = between < PAUSE * usual
    length = np.append(count[0] * each, np.where(whole, between, count[1:] * each))
    length = np.minimum(length, np.append(np.inf, between))
    place = np.arange(len(stamps)) - np.repeat(last, count)
    return np.asarray(np.repeat(stamps[last], count) + place * np.repeat(length / count, count))
