"""Clock of a counter of samples, steered slowly to the host's time of their arrival.

A host receives samples late by some milliseconds, unevenly, but its clock is that of the other
sensors.  The counter is even; its rate is found by a line through the arrivals.  Tones turn by
radians in the time by which arrivals scatter, so that stamps follow the line without a step.  As a
sample is late, never early, the line is through the earliest of a second.
"""

from collections import deque

import numpy as np

from magfusion.units import Array

LATENESS = 2e-2  # s, one sigma; of the earliest arrival in a second, by a sound server
CRYSTAL = 5e-5  # relative deviation of a clock, one sigma
MEMORY = 200.0  # s; of the line, in which the temperature of a crystal changes little
RECENT = 1.0  # s; of which the earliest arrival counts
SETTLING = 3000.0  # s; in which the distance to the line is made up: 20 ms by 7 ppm


class HostClock:
    """Stamps of a counter.

    `step`: nominal time from one count to the next (s).
    """

    def __init__(self, step: float) -> None:
        self._step, self.rate = step, 0.0
        self._count = self._time = self._arrival = 0.0
        self._sums = np.zeros(5)  # weight, elapsed, late, elapsed^2, elapsed late
        self._started = False
        self._recent: deque[tuple[float, float]] = deque()  # nominal time, lateness; increasing

    def stamps(self, counts: Array, arrival: float) -> Array:
        """Return the times (s) of consecutive counts that have arrived at a time (s).

        `counts` (n,): larger than those before.
        """
        last = float(counts[-1])
        arrival = self._earliest(last * self._step, arrival)
        if not self._started:
            self._started = True
            self._count, self._time, self._arrival = last, arrival, arrival
            self._sums[0] = 1.0
        time = self._time + (counts - self._count) * self._step * (1.0 + self.rate)
        self._steer(float(time[-1]), last, arrival)
        return np.asarray(time)

    def _earliest(self, nominal: float, arrival: float) -> float:
        """Return when a count would have arrived if it were no later than the others."""
        late = arrival - nominal
        while self._recent and self._recent[-1][1] >= late:
            self._recent.pop()
        self._recent.append((nominal, late))
        while self._recent[0][0] < nominal - RECENT:
            self._recent.popleft()
        return nominal + self._recent[0][1]

    def _steer(self, time: float, count: float, arrival: float) -> None:
        # The line is of the nominal counter's distance to the arrivals, since the newest count.
        elapsed = (count - self._count) * self._step
        weight, first, late, square, both = self._sums * np.exp(-elapsed / MEMORY)
        both -= elapsed * late
        square += elapsed * (elapsed * weight - 2.0 * first)
        first -= elapsed * weight
        late -= (arrival - self._arrival - elapsed) * weight
        both -= (arrival - self._arrival - elapsed) * first
        own = min(elapsed / RECENT, 1.0)
        self._sums = np.array([weight + own, first, late, square, both])
        self._count, self._time, self._arrival = count, time, arrival
        weight, first, late, square, both = self._sums
        spread = square - first**2 / weight
        slope = (both - first * late / weight) / (spread + (LATENESS / CRYSTAL) ** 2)
        on_line = arrival + late / weight - slope * first / weight
        self.rate = float(slope + (on_line - time) / SETTLING)
