"""Counters of 32 bits, or 16 bits of milliseconds, as clocks: where they wrap, the stamps go on."""

import numpy as np

from magfusion.units import Array

# s; of 32 bits of nanoseconds and coarser units, and of 16 bits of milliseconds
PERIODS = (2.0**32 * 1e-9, 2.0**32 * 1e-6, 2.0**32 * 1e-3, 2.0**16 * 1e-3)
NEAR_END, NEAR_SHARE = 1.0, 0.05  # s, of a period, at most; before and after it wraps


def lost_by_wrapping(raw: Array, last: float, wrapped: float, near_end: float = NEAR_END) -> Array:
    """Return what a counter has lost by wrapping (s), at each of its stamps.

    Parameters
    ----------
    raw : ndarray, shape (n,)
        Stamps (s).
    last : float
        The one before them; minus infinity before the first.
    wrapped : float
        What the counter had lost until then (s); a late stamp may be of before it wrapped.
    near_end : float
        As `NEAR_END` (s); more after a silence.
    """
    step = np.diff(raw, prepend=last if np.isfinite(last) else raw[0])
    result = np.full(len(raw), wrapped)
    if not np.any(np.abs(step) > 0.5 * PERIODS[0]):
        return result
    for period in PERIODS:
        near = min(near_end, NEAR_SHARE * period)
        turns = -np.round(step / period)
        turns[(np.abs(turns) != 1.0) | (np.abs(step + turns * period) > near)] = 0.0
        ends = np.minimum(raw, raw - step), np.maximum(raw, raw - step) - period
        turns[np.maximum(*map(np.abs, ends)) > near] = 0.0
        missing = wrapped + period * np.cumsum(turns)
        if np.any(turns) and np.min(missing) >= 0.0:
            result = result + missing - wrapped
    return result
