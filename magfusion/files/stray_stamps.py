"""Single stamps that are hours or years from all others, of a clock that was not set yet."""

from collections.abc import Sequence

import numpy as np

from magfusion.model.trust import Finding, Verdict
from magfusion.units import NANOSECOND, BoolArray, IntArray

LONGEST_GAP = 3600.0  # s; of a clock that did not jump
# Share and number of rows that are left out as false; more are a part of the recording.
MOST_STRAY, MOST_STRAY_ROWS = 0.01, 100


def stray_rows(
    time_ns: IntArray,
    before: int = 0,
    last_ns: int | None = None,
    accepted_share: float = MOST_STRAY,
    accepted_rows: int = MOST_STRAY_ROWS,
) -> BoolArray:
    """Return which rows have a stamp that is more than an hour from those of the others.

    Parameters
    ----------
    time_ns : ndarray of int, shape (n,)
        Stamps (ns), in any order.
    before : int
        Rows of the same table that were read before these.
    last_ns : int, optional
        Stamp of the last of them.
    accepted_share, accepted_rows : float, int
        Of the rows, that may be stray.

    Returns
    -------
    ndarray of bool, shape (n,)
        None of them where they are too many for an accident: then the clock jumped.
    """
    seconds = time_ns * NANOSECOND  # as doubles: differences may be beyond int64
    last = seconds[:1] if last_ns is None else np.array([last_ns * NANOSECOND])
    stray = np.zeros(len(time_ns), dtype=bool)
    if not (np.abs(np.diff(seconds, prepend=last)) > LONGEST_GAP).any():
        return stray
    order = np.argsort(seconds, kind="stable")
    group = np.cumsum(np.diff(seconds[order], prepend=seconds[order[0]]) > LONGEST_GAP)
    count = np.bincount(group)
    few = count < count.max()
    if last_ns is not None:
        near = np.abs(seconds[order] - last) <= LONGEST_GAP
        few = ~np.isin(np.arange(len(count)), group[near])
    accepted = min(max(1.0, accepted_share * (len(time_ns) + before)), accepted_rows)
    if np.sum(count[few]) <= accepted:
        stray[order] = few[group]
    return stray


def stray_finding(stream: str, stray_ns: Sequence[int] | IntArray) -> tuple[Finding, ...]:
    """Return how many rows are left out of a stream for their stamps (ns), if there are such."""
    if not len(stray_ns):
        return ()
    text = (
        f"{stream}: {len(stray_ns)} samples have stamps more than an hour from those of all others"
        f" (the first is {stray_ns[0]} ns). They are left out."
    )
    return (Finding("stray_stamps", text, Verdict.TRUSTWORTHY),)
