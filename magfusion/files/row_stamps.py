"""Stamps of a recording's rows that are not those of their samples: of batches."""

import numpy as np

from magfusion.files.lost_rows import MAX_DUPLICATED
from magfusion.model.batches import spread_batches
from magfusion.model.trust import Finding, Verdict
from magfusion.units import NANOSECOND, Array, IntArray

MAX_BATCH = 2.0  # s between two stamps; coarser ones do not determine the times of samples
MIN_BATCHES = 3
MAX_BATCH_RATIO = 4.0  # times the usual size, unless it took as much longer to fill
ROUNDING_NS = 500  # of stamps in microseconds
MAX_COPIES = 0.5  # of the rows with the stamp of the one above; more are one row, written again


def separate_stamps(time_ns: IntArray, values: Array) -> IntArray | None:
    """Return the sampling times of rows that have one stamp a batch; None of others.

    A stamp is that of the last sample, as where a driver reads a buffer; of a coarse clock it is
    not. `time_ns` (n,): sorted stamps (ns). `values` (n, columns): rows that repeat the numbers of
    the one above are no other samples. Returns strictly increasing stamps, shape (n,) (ns), or
    None; the last sample of a batch keeps its stamp.
    """
    twice = np.diff(time_ns) == 0
    if not len(twice) or np.mean(twice) <= MAX_DUPLICATED:
        return None
    copies = ((values[1:] == values[:-1]) | np.isnan(values[1:])).all(axis=1)
    last = np.append(np.flatnonzero(~twice), len(time_ns) - 1)
    if np.mean(copies[twice]) > MAX_COPIES or len(last) < MIN_BATCHES:
        return None
    step = float(np.median(np.diff(time_ns[last])))
    if step * NANOSECOND > MAX_BATCH or _is_rounded(time_ns[last], round(step)):
        return None
    if _stalls(time_ns[last], np.diff(last, prepend=-1)):
        return None
    seconds = (time_ns - time_ns[0]) * NANOSECOND
    result = time_ns[0] + np.rint(spread_batches(seconds, last) / NANOSECOND).astype(np.int64)
    return result if np.all(np.diff(result) > 0) else None


def _is_rounded(time_ns: IntArray, step: int) -> bool:
    """Return whether stamps are those of a clock that is read in whole steps (ns).

    Whether such a clock is rounded down, up or to the nearest step is not known.
    """
    return bool(np.all((time_ns + ROUNDING_NS) % step <= 2 * ROUNDING_NS))


def _stalls(time_ns: IntArray, count: IntArray) -> bool:
    """Return whether the clock stopped for a while, in which samples were taken.

    `time_ns` (batches,): stamps of batches (ns). `count` (batches,): samples of each.
    """
    between = np.diff(time_ns)
    usual, size = float(np.median(between)), float(np.median(count))
    large = count > MAX_BATCH_RATIO * size
    crowded = between / usual < count[1:] / size / MAX_BATCH_RATIO
    # How long the first took to fill is not known: a recorder may begin with a full buffer.
    first = large[0] and count[0] > MAX_DUPLICATED * np.sum(count)
    return bool(first or np.any(crowded & large[1:]))


def batches_text(time_ns: IntArray) -> str:
    """Return how many of the rows have the stamp of the one above, and what becomes of them."""
    twice = np.diff(time_ns) == 0
    size = len(time_ns) / (len(time_ns) - np.sum(twice))
    return (
        f"{np.sum(twice)} of {len(time_ns)} samples have the stamp of the one before, in batches of"
        f" {size:.3g}. They are spread evenly; the last of each batch keeps its stamp."
    )


def batches_finding(stream: str, time_ns: IntArray) -> Finding:
    """Return the finding of a stream whose stamps were those of batches."""
    text = f"{stream}: {batches_text(time_ns)}"
    return Finding("repeated_stamps", text, Verdict.TRUSTWORTHY)
