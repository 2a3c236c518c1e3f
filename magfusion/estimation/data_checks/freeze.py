"""Online detection of a frozen instrument: one that repeats its last sample for too long."""

import numpy as np

from magfusion.estimation.data_checks.samples import CHANCE, MIN_FREEZE
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array, BoolArray

SAMPLES = 1e7  # of a stream, among which the chance of a false alarm is `CHANCE`
MIN_REPEATS = 6  # equal samples in a row, at least


class Freeze:
    """Freeze detector of one instrument, fed with its samples in order.

    `frozen_since`: stamp of the first sample equal to the newest (s). `is_frozen`: whether the
    instrument is frozen at the newest sample.
    """

    frozen_since: float
    is_frozen: bool
    _sample: Array
    _repeats: int
    _repeat_count: int
    _seen: int

    def __init__(self) -> None:
        self.frozen_since, self.is_frozen = -np.inf, False
        self._sample = np.full(3, np.nan)
        self._repeats, self._repeat_count, self._seen = 0, 0, 0

    def stretches(self, time: Array, samples: Array) -> list[tuple[float, float]]:
        """Return begin and end (s) of the stretches in which samples (k, 3) repeat."""
        out: dict[float, float] = {}
        if len(time) == 0:
            return []
        same = np.empty(len(time), dtype=bool)
        same[0] = (samples[0] == self._sample).all()
        np.equal(samples[1:, 0], samples[:-1, 0], out=same[1:])
        if same[1:].any():
            np.logical_and.reduce(samples[1:] == samples[:-1], axis=1, out=same[1:])
        self._sample = samples[-1].copy()
        if self._passed(time, same):
            return []
        for k in range(len(time)):
            if same[k]:
                self._repeats += 1
                self.is_frozen = self.is_frozen or self._too_long(float(time[k]))
            else:
                self._seen += 1 if self.is_frozen else 1 + self._repeats
                self._repeat_count += 0 if self.is_frozen else self._repeats
                self.frozen_since, self.is_frozen, self._repeats = float(time[k]), False, 0
            if self.is_frozen:
                out[self.frozen_since] = float(time[k])
        return list(out.items())

    def _passed(self, time: Array, same: BoolArray) -> bool:
        """Count samples quickly where no repetition is long (the usual case)."""
        if not (self.is_frozen or same.any() or self._repeats >= MIN_REPEATS):
            self._seen, self._repeat_count = (
                self._seen + len(same) + self._repeats,
                self._repeat_count + self._repeats,
            )
            self._repeats, self.frozen_since = 0, float(time[-1])
            return True
        changed = np.flatnonzero(~same)
        ends = np.concatenate([changed, [len(same)]])
        repeats = np.diff(ends, prepend=-1 - self._repeats) - 1
        if self.is_frozen or np.max(repeats) >= MIN_REPEATS:
            return False
        closed = int(np.sum(repeats[:-1]))
        self._seen, self._repeat_count = (
            self._seen + len(changed) + closed,
            self._repeat_count + closed,
        )
        self._repeats = int(repeats[-1])
        if len(changed):
            self.frozen_since = float(time[changed[-1]])
        return True

    def _too_long(self, time: float) -> bool:
        # Instruments quantize, and may be read faster than they measure.
        usual = min(max(self._repeat_count / max(self._seen, 1), 1e-3), 0.97)
        by_chance = np.log(CHANCE / SAMPLES) / np.log(usual)
        return (
            self._repeats >= max(by_chance, MIN_REPEATS) and time - self.frozen_since >= MIN_FREEZE
        )


def imu_remarks(
    start_time: float | None, begin: float, end: float, *, gap_bridged: bool
) -> tuple[Finding, ...]:
    """Return the findings on the IMU between two epochs (s).

    `start_time`: start of a freeze (s); None where there is none. `gap_bridged`: whether samples
    are missing there.
    """
    if start_time is not None and end > start_time:
        text = f"all axes are frozen since {start_time:.2f} s: the sensor or its driver hangs."
        text += " Repeated samples are dropped; the magnetic fields bridge the gap."
        return (Finding("frozen_imu", f"IMU: {text}", Verdict.TRUSTWORTHY),)
    if not gap_bridged:
        return ()
    text = f"samples are missing between {begin:.2f} and {end:.2f} s. The magnetic"
    return (Finding("gap", f"IMU: {text} fields bridge the gap.", Verdict.TRUSTWORTHY),)
