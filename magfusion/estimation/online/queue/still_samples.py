"""Where no IMU measures: the zeros of a motion prior, as far as the fields have come."""

import numpy as np

from magfusion.model.without_imu import MAX_STEP, STEPS
from magfusion.units import Array


class StillSamples:
    """When there are samples of the motion prior: on one grid, whose step the fields choose.

    `until`: stamp of the last (s). `step`: between two (s); not finite before it is known.
    """

    until: float
    step: float

    def __init__(self) -> None:
        self.until, self.step = -np.inf, np.nan

    def stamps(self, time: Array, *, raw: bool) -> Array:
        """Return the new stamps (s) up to some of the fields, and a step beyond.

        `time` (k,): of the fields (s), increasing; of the first epochs two are needed. `raw`:
        whether they are samples, whose windows are longer than any step.
        """
        known = np.isfinite(self.step)
        if len(time) < (1 if raw or known else 2):
            return np.zeros(0)
        newest = float(np.max(time))
        if not known:
            shortest = MAX_STEP if raw else float(np.median(np.diff(time))) / STEPS
            self.step = min(MAX_STEP, shortest)
            self.until = float(np.min(time)) - self.step
        count = int(np.ceil((newest - self.until) / self.step)) + 1
        if newest <= self.until or count < 1:
            return np.zeros(0)
        built = self.until + self.step * np.arange(1, count + 1)
        self.until = float(built[-1])
        return np.asarray(built)
