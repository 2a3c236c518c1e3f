"""A clock that was set back in a recording: rows of two times have the same stamps."""

from typing import NamedTuple

import numpy as np

from magfusion.files.lost_rows import copied_rows
from magfusion.units import NANOSECOND, Array, BoolArray, IntArray

MAX_STEP_BACK = 1.0  # s; no message is late by more
MAX_LATE_ROWS = 2  # rows out of order, of a late message
DENSE = 1.5  # times the rows of the time before or after: two runs make twice as many
# Times the longest steps but the rarest: within bursts of rows their rate is no measure.
WIDE, RARE = 2.0, 0.99
SHUFFLED = 0.25  # of the rows that go back, from which arrival does not show the usual step
LOCAL = 20  # rows before and after, at least, whose rate is compared
MIN_LOCAL = 10  # rows, from which their rate is known


class ClockSetBack(NamedTuple):
    """A step of a clock to the past.

    `row`: the first row after it, from 0. `stamp_ns`: its stamp. `before_ns`: the latest stamp
    before it. `size_s`: by how much the clock was set back (s).
    """

    row: int
    stamp_ns: int
    before_ns: int
    size_s: float


def clock_set_back(time_ns: IntArray, values: Array) -> ClockSetBack | None:
    """Return the first step back of a clock, or None.

    Late messages fill holes of a stream; after a step back, two runs of rows overlap.

    Parameters
    ----------
    time_ns : ndarray of int, shape (n,)
        Stamps (ns) in the order of arrival, without stray ones.
    values : ndarray, shape (n, columns)
        Rows that were written twice are counted once.
    """
    if not np.any(np.diff(time_ns) < 0):
        return None
    order = np.argsort(time_ns, kind="stable")
    rows = np.sort(order[~copied_rows(time_ns[order], values[order])])
    stamps = time_ns[rows]
    steps = np.diff(stamps)
    back = np.flatnonzero(steps < 0) + 1
    if not len(back) or not np.any(steps > 0):
        return None
    ordered = np.sort(stamps)
    between = np.diff(ordered) if len(back) > SHUFFLED * len(steps) else steps
    step = float(np.median(between[between > 0]))
    highest = np.maximum.accumulate(stamps)
    lowest = np.minimum.accumulate(stamps[::-1])[::-1]
    first, last = stamps[back], highest[back - 1]
    older = back - np.searchsorted(highest, first, "right")
    newer = np.searchsorted(lowest, last, "right") - back
    size = last - first
    many = (
        (older > MAX_LATE_ROWS)
        & (newer > MAX_LATE_ROWS)
        & (size > WIDE * np.quantile(np.diff(ordered), RARE))
    )
    is_step = many & ((size * NANOSECOND > MAX_STEP_BACK) | _dense(ordered, first, last, step))
    if not is_step.any():
        return None
    k = int(np.argmax(is_step))
    size_s = float(size[k] + step) * NANOSECOND
    return ClockSetBack(int(rows[back[k]]), int(first[k]), int(last[k]), size_s)


def _dense(ordered: IntArray, first: IntArray, last: IntArray, step: float) -> BoolArray:
    """Return between which stamps there are more rows than the rate of the rows around them has.

    `ordered` (n,): sorted stamps. `first`, `last` (m,): of m intervals. `step`: the usual one (ns).
    """
    begin = np.searchsorted(ordered, first)
    end = np.searchsorted(ordered, last, "right") - 1
    width = np.maximum(end - begin, LOCAL)
    start, stop = np.maximum(begin - width, 0), np.minimum(end + width, len(ordered) - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        around = np.stack(
            [
                np.where(count >= MIN_LOCAL, span / count, np.inf)
                for span, count in (
                    (first - ordered[start], begin - start),
                    (ordered[stop] - last, stop - end),
                )
            ]
        ).min(axis=0)
    return np.asarray(
        (end - begin) * np.where(np.isinf(around), step, around) > DENSE * (last - first)
    )
