"""Single stamps far from those of the samples around them: damaged, or of a clock not set yet."""

from collections.abc import Sequence

import numpy as np

from magfusion.model.trust import Finding, Verdict
from magfusion.units import NANOSECOND, BoolArray, IntArray

MAX_GAP = 3600.0  # s; of a clock that did not jump
# Share and number of rows that are left out as false; more are a part of the recording.
MAX_STRAY_SHARE, MAX_STRAY_ROWS = 0.01, 100
MIN_ROWS = 10  # from which the step of a stream is known
MAX_SEPARATION_STEPS = (
    3.0  # steps between the rows around a stray one: its own place, and a lost row
)
FAR = 10.0  # steps; a stamp that is less away may be one of jitter, or of a late message
# s, steps; a first or last row that is more away: else it may be one before or after a pause
EDGE_S, EDGE = 1.0, 20.0
HOLE = 1.5  # steps between two rows, from which more a row is missing between them


def stray_rows(
    time_ns: IntArray,
    before: int = 0,
    last_ns: int | None = None,
    accepted_share: float = MAX_STRAY_SHARE,
    accepted_rows: int = MAX_STRAY_ROWS,
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
    if not (np.abs(np.diff(seconds, prepend=last)) > MAX_GAP).any():
        return stray
    order = np.argsort(seconds, kind="stable")
    group = np.cumsum(np.diff(seconds[order], prepend=seconds[order[0]]) > MAX_GAP)
    count = np.bincount(group)
    few = count < count.max()
    if last_ns is not None:
        near = np.abs(seconds[order] - last) <= MAX_GAP
        few = ~np.isin(np.arange(len(count)), group[near])
    accepted = min(max(1.0, accepted_share * (len(time_ns) + before)), accepted_rows)
    if np.sum(count[few]) <= accepted:
        stray[order] = few[group]
    return stray


def all_strays(
    time_ns: IntArray, accepted_share: float = MAX_STRAY_SHARE, accepted_rows: int = MAX_STRAY_ROWS
) -> BoolArray:
    """Return which rows of a whole stream are stray, by `stray_rows` or `misplaced_rows`.

    Parameters are those of the two; returns ndarray of bool, shape (n,).
    """
    stray = stray_rows(time_ns, 0, None, accepted_share, accepted_rows)
    stray[~stray] = misplaced_rows(time_ns[~stray], accepted_share, accepted_rows)
    return stray


def counted_back(time_ns: IntArray, count: int) -> int:
    """Return the time of a stream's first sample (ns), of which the first were left out.

    `time_ns` (n,): sorted stamps (ns) of the others. `count`: samples left out before them.
    """
    steps = np.diff(time_ns)
    step = np.median(steps[steps > 0]) if np.any(steps > 0) else 0.0
    return int(time_ns[0]) - round(count * float(step))


def misplaced_rows(
    time_ns: IntArray, accepted_share: float = MAX_STRAY_SHARE, accepted_rows: int = MAX_STRAY_ROWS
) -> BoolArray:
    """Return which single rows have a stamp that is neither of their place nor of another.

    Without such a row its neighbours are about a step apart, and where its stamp belongs no row is
    missing. A message that arrived late fills a hole there.

    Parameters
    ----------
    time_ns : ndarray of int, shape (n,)
        Stamps (ns) in the order of arrival.
    accepted_share, accepted_rows : float, int
        As of `stray_rows`.

    Returns
    -------
    ndarray of bool, shape (n,)
        None of them where they are too many for an accident.
    """
    stray = np.zeros(len(time_ns), dtype=bool)
    if len(time_ns) < MIN_ROWS:
        return stray
    seconds = time_ns * NANOSECOND
    steps = np.diff(seconds)
    if not (np.any(steps < 0.0) or max(steps[0], steps[-1]) > EDGE_S) or not np.any(steps > 0.0):
        return stray
    step = float(np.median(steps[steps > 0.0]))
    before = np.append(seconds[1] - 2.0 * step, seconds[:-1])
    after = np.append(seconds[1:], seconds[-2] + 2.0 * step)
    limit = np.full(len(seconds), FAR * step)
    limit[[0, -1]] = max(EDGE_S, EDGE * step)
    gap = after - before
    away = np.maximum(before - seconds, seconds - after) > limit
    candidate = away & (gap >= 0.0) & (gap <= MAX_SEPARATION_STEPS * step)
    others = np.concatenate([[-np.inf], np.sort(seconds[~candidate]), [np.inf]])
    place = np.searchsorted(others, seconds[candidate])
    below, above = seconds[candidate] - others[place - 1], others[place] - seconds[candidate]
    fits = (below + above > HOLE * step) & (np.minimum(below, above) <= FAR * step)
    if np.sum(~fits) <= min(max(1.0, accepted_share * len(time_ns)), accepted_rows):
        stray[candidate] = ~fits
    return stray


def stray_finding(stream: str, stray_ns: Sequence[int] | IntArray) -> tuple[Finding, ...]:
    """Return how many rows are left out of a stream for their stamps (ns), if there are such."""
    if not len(stray_ns):
        return ()
    text = (
        f"{stream}: {len(stray_ns)} samples have stamps far from those of the samples around them"
        f" (the first is {stray_ns[0]} ns). They are left out."
    )
    return (Finding("stray_stamps", text, Verdict.TRUSTWORTHY),)
