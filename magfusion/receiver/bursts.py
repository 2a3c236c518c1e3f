"""Stamps of samples that a bus hands over several at a time: nearly one stamp for all of them.

They were taken one after the other since the burst before, and arrived together.  Each burst is
spread over the time since the last one, which is right to a step.
"""

import numpy as np

from magfusion.units import Array

TOGETHER = 0.2  # of the mean step; what is nearer to the one before arrived with it
SHARE = 0.4  # of the steps that are so short where samples come in bursts
LONGEST = 0.1  # s between two bursts; what pauses longer was switched, not handed over
MOST = 32  # samples in a burst
PAUSE = 3.0  # times the usual time between bursts: a gap, over which nothing is spread


def spread_bursts(stamps: Array) -> Array | None:
    """Return when samples were taken that arrived in bursts; None where they did not.

    Parameters
    ----------
    stamps : ndarray, shape (n,)
        Strictly increasing (s).

    Returns
    -------
    ndarray, shape (n,), or None
        Strictly increasing (s); the last of a burst is where its stamp was.
    """
    if len(stamps) < 2 * MOST:
        return None
    step = np.diff(stamps)
    inside = step[step < 2.0 * LONGEST]
    if len(inside) < MOST:
        return None
    apart = step > TOGETHER * float(np.mean(inside))
    if np.mean(~apart) < SHARE:
        return None
    last = np.append(np.flatnonzero(apart), len(stamps) - 1)
    count = np.diff(last, prepend=-1)
    between = np.diff(stamps[last])
    usual = float(np.median(between))
    if usual > LONGEST or np.median(count) > MOST:
        return None
    each = usual / float(np.median(count))
    whole = between < PAUSE * usual
    length = np.append(count[0] * each, np.where(whole, between, count[1:] * each))
    length = np.minimum(length, np.append(np.inf, between))
    place = np.arange(len(stamps)) - np.repeat(last, count)
    return np.asarray(np.repeat(stamps[last], count) + place * np.repeat(length / count, count))
