"""Time stamps of samples that a bus delivers several at a time, close to each other.

The samples of a burst were taken one after the other since the burst before.  Each burst is spread
over the time since the last one, which is accurate to one step.
"""

import numpy as np

from magfusion.model.batches import PAUSE, spread_batches
from magfusion.units import Array, IntArray

TOGETHER = 0.2  # of the mean step; samples closer than that arrived in one burst
SHARE = 0.4  # least share of such short steps where samples come in bursts
MAX_PAUSE = 0.1  # s without a sample; a longer pause is a switched stream, not a bus
MAX_SAMPLES = 64  # samples in a burst
MIN_SAMPLES = 64  # in which bursts are recognised
CLUSTERS = 2.5  # times a step within a burst; the least pause. A lost sample makes a step of two
OUTSIDE = 0.01  # share of the steps of either kind that may be between
RESOLVED = 5e-4  # s; sensors that sample faster for a while are rare, buses are not
REGULAR = 0.02  # of a step, by which the steps of a sensor's own clock scatter
LATTICE = 0.15  # of a step; pauses that differ less from whole steps hold lost samples
EQUAL = 0.9  # share of bursts of one size in a stream that is switched by a clock
PIECE = 40  # bursts in which lateness is compared
MAX_LATENESS = 2.0  # steps, one sigma; a bus may be as late in any case
SHARE_LATE = 0.1  # of the distance of bursts, one sigma; likewise where there are few
MIN_BURSTS = 8  # that show whether their lateness accumulates
RELATED = 0.5  # of the variance of distances, if numbers and pauses were independent
WANDERING = 1.1  # times the scatter of an interval: lateness alone has 0.7, a random walk 1.6


def burst_limit(stamps: Array) -> float | None:
    """Return the time (s) below which samples are of one burst; None if they come evenly.

    `stamps` (n,): strictly increasing (s).
    """
    step = np.diff(stamps)
    if len(stamps) < MIN_SAMPLES or np.sum(step < 2.0 * MAX_PAUSE) < MIN_SAMPLES // 2:
        return None
    limit = shortest_pause(step)
    short, pause = step[step <= limit], step[step > limit]
    if len(short) < SHARE * len(step) or len(pause) < 2 or np.median(pause) > MAX_PAUSE:
        return None
    last = np.append(np.flatnonzero(step > limit), len(stamps) - 1)
    if np.median(np.diff(last, prepend=-1)) > MAX_SAMPLES:
        return None
    inner = float(np.median(short))
    if inner > RESOLVED and _is_switched(short, pause, np.diff(last)):
        return None
    together = np.max(short) <= TOGETHER * np.mean(step[step < 2.0 * MAX_PAUSE])
    return limit if together or _keeps_to_a_rate(stamps, last, inner) else None


def shortest_pause(step: Array) -> float:
    """Return a time (s) between the steps in bursts and the pauses, if samples come in bursts.

    `step` (n,): between samples (s).
    """
    inside = step[step < 2.0 * MAX_PAUSE]
    mean = float(np.mean(inside)) if len(inside) else 0.0
    short, pause = inside[inside <= mean], inside[inside > mean]
    if not len(short) or not len(pause):
        return TOGETHER * mean
    below, above = np.quantile(short, 1.0 - OUTSIDE), np.quantile(pause, OUTSIDE)
    return float(np.sqrt(below * above)) if above > CLUSTERS * below > 0.0 else TOGETHER * mean


def _is_switched(short: Array, pause: Array, count: IntArray) -> bool:
    """Return whether a clock switches the stream: equal bursts, and pauses as regular as steps."""
    equal = np.mean(count == np.median(count)) > EQUAL
    allowed = 2.0 * _spread(short) + REGULAR * float(np.median(short))
    return bool(equal) and _spread(pause) < allowed


def _keeps_to_a_rate(stamps: Array, last: IntArray, inner: float) -> bool:
    """Return whether bursts hold as many samples as their distances require.

    Then distances vary less than numbers and pauses would by themselves, or the lateness of bursts
    does not accumulate. Where samples are lost or a sensor pauses it does, and the pauses of an
    even clock are whole steps. `inner`: step in a burst (s).
    """
    own, count, between = np.diff(stamps), np.diff(last), np.diff(stamps[last])
    near = between < PAUSE * np.median(between)
    near[-1] = False  # it may not be complete
    pause, count, between = own[last[:-1]][near], count[near], between[near]
    if not len(count):
        return False
    step = float(np.sum(between) / np.sum(count))
    off = between - step * count
    independent = np.var(pause) + (step - inner) ** 2 * np.var(count)
    if len(count) >= MIN_BURSTS and np.var(off) < RELATED * independent:
        return True
    whole, regular = pause / inner, float(np.std(own[own < np.min(pause)])) / inner
    if np.std(whole - np.rint(whole)) < min(REGULAR + 1.5 * regular, LATTICE):
        return False
    size = min(PIECE, len(count))
    off = off[: len(off) // size * size].reshape(-1, size)
    late = np.cumsum(off - np.mean(off, axis=1, keepdims=True), axis=1)
    allowed = MAX_LATENESS * step
    if len(count) < MIN_BURSTS:
        allowed = max(allowed, SHARE_LATE * float(np.median(between)))
    elif len(count) >= PIECE // 2:
        allowed = max(allowed, WANDERING * float(np.median(np.std(off, axis=1))))
    return bool(np.median(np.std(late, axis=1)) < allowed)


def _spread(values: Array) -> float:
    """Return the scatter of values, ignoring outliers (one sigma)."""
    return float(np.median(np.abs(values - np.median(values))) / 0.6745)


def spread_bursts(stamps: Array) -> Array | None:
    """Return sampling times of samples that arrived in bursts; None if they did not.

    `stamps` (n,): strictly increasing (s). Returns strictly increasing stamps, shape (n,)
    (s), or None; the last sample of a burst keeps its stamp.
    """
    limit = burst_limit(stamps)
    return None if limit is None else spread_batches(stamps, burst_ends(stamps, limit))


def burst_ends(stamps: Array, limit: float) -> IntArray:
    """Return the last sample of each burst; `limit`: as of `burst_limit` (s)."""
    return np.append(np.flatnonzero(np.diff(stamps) > limit), len(stamps) - 1)
