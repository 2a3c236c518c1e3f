"""Clock of a reference in a stream: a line through the lags of successive stretches."""

from dataclasses import dataclass

import numpy as np

from magfusion.model.samples import Waveform
from magfusion.receiver.reference import BLOCK, FINER, Lag, common_noise
from magfusion.units import Array

MEMORY = 0.9  # weight of earlier stretches in each later one
LAG_SIGMA, RATE_SIGMA = 1e-3, 1e-4  # s, and relative: of an estimated lag, of any clock


@dataclass(frozen=True)
class ReferenceClock:
    """Estimated lags, and the line through them."""

    weight: float = 0.0  # sum over all lags
    # time, lag: weighted means (s)
    time: float = 0.0
    lag: float = 0.0
    # square, product: weighted sums of the squares of times, and of times by lags, about the means
    # (s^2)
    square: float = 0.0
    product: float = 0.0

    def updated(self, time: float, lag: float) -> "ReferenceClock":
        """Return it with the lag at a time added (s)."""
        old = MEMORY * self.weight
        weight = old + 1.0
        off_time, off_lag = time - self.time, lag - self.lag
        share = old / weight
        return ReferenceClock(
            weight,
            self.time + off_time / weight,
            self.lag + off_lag / weight,
            MEMORY * self.square + share * off_time**2,
            MEMORY * self.product + share * off_time * off_lag,
        )

    @property
    def line(self) -> Lag | None:
        """Lag over time; None before the first estimate."""
        if self.weight == 0.0:
            return None
        rate = self.product / (self.square + (LAG_SIGMA / RATE_SIGMA) ** 2)
        return Lag(self.lag - rate * self.time, rate)


def lag_in(waveform: Waveform, reference: Waveform, lines_hz: Array) -> tuple[float, float] | None:
    """Return the time and lag of a reference in a stretch (s); None if it is not received.

    `lines_hz`: tones and mains (Hz), which are excluded.
    """
    common = common_noise(waveform, reference, lines_hz)
    if common is None:
        return None
    _, starts, mean, best, lags = common
    step = float(np.median(np.diff(waveform.time)))
    size = int(BLOCK / step) // 2 * 2
    at = int(np.clip(best, 1, len(mean) - 2))
    before, here, after = mean[at - 1 : at + 2]
    finer = 0.5 * (before - after) / min(before - 2.0 * here + after, -1e-300)
    middle = float(waveform.time[starts].mean()) + 0.5 * size * step
    return middle, float(lags[at] + np.clip(finer, -0.5, 0.5)) * step / FINER
