"""Values kept constant by the resolution of an instrument or by a multiplexer, not by a freeze.

Where a field moves by less than an instrument's step, its values are constant for long, and the
next differs by one step.  After a freeze, the value is wherever the motion led meanwhile.
"""

import numpy as np

from magfusion.units import Array, BoolArray, IntArray

ONE_STEP = 1.5  # steps of an instrument; less is one
REST = 2.5  # steps; an axis at rest between two of them reads no more than three values
MIN_PAUSES, EVEN = 5, 0.1  # of a multiplexer, and their largest relative difference


def step_of_axes(value: Array) -> Array:
    """Return the steps in which an instrument reads, zero where it is constant, shape (axes,)."""
    change = np.abs(np.diff(value, axis=0))
    least = np.min(np.where(change > 0.0, change, np.inf), axis=0)
    return np.where(np.isfinite(least), least, 0.0)


def within_a_step(
    value: Array, axes: tuple[int, ...], first: IntArray, last: IntArray
) -> BoolArray:
    """Return which constant stretches may be a field that moved by less than a step.

    A stretch at the end shows no next value: the other axes must be at rest, or, where all are
    constant, an earlier stretch must have been as long. `value` (n, axes). `axes`: those that are
    constant. `first`, `last` (k,): samples of the stretches, both inclusive.
    """
    step, ends = _step(value), last + 1 < len(value)
    after = np.minimum(last + 1, len(value) - 1)
    jump = np.max(np.abs(value[after] - value[last])[:, axes], axis=1, initial=0.0)
    result = np.asarray(ends & (jump < ONE_STEP * step))
    longest = np.max((last - first)[result], initial=0)
    for k in np.flatnonzero(~ends).tolist():
        others = np.delete(value[first[k] :], axes, axis=1)
        if others.shape[1]:
            result[k] = np.max(np.ptp(others, axis=0)) < REST * step
        else:
            result[k] = last[k] - first[k] <= longest
    return result


def is_scheduled(first: IntArray, last: IntArray) -> bool:
    """Return whether stretches are equally long and equally far apart: a multiplexer's pauses."""
    if len(first) < MIN_PAUSES:
        return False
    inner = slice(1, -1)  # those at the ends of a log are cut
    return all(
        np.ptp(own[inner]) <= max(2.0, EVEN * float(np.median(own)))
        for own in (last - first, np.diff(first))
    )


def is_coarse(value: Array) -> bool:
    """Return whether most changes are of one step: a value that is late would change by more."""
    change = np.abs(np.diff(value, axis=0))
    usual = [np.median(own[own > 0.0]) for own in change.T if np.any(own)]
    return bool(usual and max(usual) < ONE_STEP * _step(value))


def reached_in_steps(value: Array, axis: int, limit: float) -> bool:
    """Return whether an axis comes to its extreme value, and leaves it, by single steps.

    A signal that an instrument clips does so at any slope.  An axis that is always there is
    between two steps where the others are.
    """
    at = value[:, axis] == limit
    change = np.abs(np.diff(value[:, axis]))[at[1:] != at[:-1]]
    if len(change):
        return bool(np.max(change) < ONE_STEP * _step(value))
    others = np.delete(value, axis, axis=1)
    return bool(others.shape[1] and np.max(np.ptp(others, axis=0)) < REST * _step(value))


def _step(value: Array) -> float:
    """Return the least step of all axes; zero where none changes."""
    step = step_of_axes(value)
    return float(np.min(step[step > 0.0], initial=np.inf)) if np.any(step) else 0.0
