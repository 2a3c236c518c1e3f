"""Time stamps of samples that a bus delivers several at a time, with nearly one stamp for all.

The samples of a burst were taken one after the other since the burst before.  Each burst is spread
over the time since the last one, which is accurate to one step.
"""

import numpy as np

from magfusion.model.batches import spread_batches
from magfusion.units import Array

TOGETHER = 0.2  # of the mean step; samples closer than that arrived in one burst
SHARE = 0.4  # least share of such short steps where samples come in bursts
LONGEST = 0.1  # s between two bursts; a longer pause is a switched stream, not a bus
MAX_SAMPLES = 32  # samples in a burst


def spread_bursts(stamps: Array) -> Array | None:
    """Return sampling times of samples that arrived in bursts; None if they did not.

    `stamps` (n,): strictly increasing (s). Returns strictly increasing stamps, shape (n,)
    (s), or None; the last sample of a burst keeps its stamp.
    """
    if len(stamps) < 2 * MAX_SAMPLES:
        return None
    step = np.diff(stamps)
    inside = step[step < 2.0 * LONGEST]
    if len(inside) < MAX_SAMPLES:
        return None
    separate = step > TOGETHER * float(np.mean(inside))
    if np.mean(~separate) < SHARE:
        return None
    last = np.append(np.flatnonzero(separate), len(stamps) - 1)
    count = np.diff(last, prepend=-1)
    between = np.diff(stamps[last])
    usual = float(np.median(between))
    if usual > LONGEST or np.median(count) > MAX_SAMPLES:
        return None
    return spread_batches(stamps, last)
