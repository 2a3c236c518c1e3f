"""Windows of evenly spaced samples: few spacings recur.

Whether a window is even depends on its own samples only, not on other or earlier windows.
"""

from typing import NamedTuple

import numpy as np

from magfusion.units import Array, IntArray

# Largest time error of evenly spaced samples (rad of the fastest tone): of clocks with full
# precision, and of those with nanoseconds.
RATE_TOLERANCES = (1e-9, 1e-6)
WITHIN = 1.5  # steps of time error; each of the two numbers of a spacing is rounded to one half


class Spacing(NamedTuple):
    """Evenly spaced samples: number, and middle and half span in small steps."""

    number: int
    middle: int
    half: int
    step: float  # (s)

    def times(self) -> Array:
        """Return the sample times, shape (number,) (s)."""
        return self.step * (self.middle + self.half * np.linspace(-1.0, 1.0, self.number))


def spacings_of(time: Array, count: IntArray, fastest_hz: float) -> list[Spacing | None]:
    """Return the spacing of each window at the finest valid step; None if it is not even.

    `time` (n, m): of samples from the centre of each window (s). `count` (n,): samples in each
    window. `fastest_hz`: highest frequency of a tone.
    """
    result: list[Spacing | None] = [None] * len(count)
    for shared in RATE_TOLERANCES:
        step = shared / (2.0 * np.pi * WITHIN * fastest_hz)
        middle, half, even = _rounded(time, count, step)
        for k in np.flatnonzero(even).tolist():
            if result[k] is None:
                result[k] = Spacing(int(count[k]), int(middle[k]), int(half[k]), step)
        if None not in result:
            break
    return result


def _rounded(time: Array, count: IntArray, step: float) -> tuple[Array, Array, Array]:
    """Return middles and half spans in steps (s), and which windows they describe."""
    known = np.maximum(count, 2)
    first, last = time[:, 0], time[np.arange(len(count)), known - 1]
    middle, half = np.rint(0.5 * (first + last) / step), np.rint(0.5 * (last - first) / step)
    reach = np.arange(time.shape[1])
    share = reach * (2.0 / (known - 1))[:, None] - 1.0
    off = np.abs(time - step * (middle[:, None] + half[:, None] * share))
    worst = np.max(off, axis=1, where=reach < count[:, None], initial=0.0)
    return middle, half, (worst <= WITHIN * step) & (count > 2)
