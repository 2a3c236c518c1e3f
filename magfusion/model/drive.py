"""Recorded drive currents of coils, relative to those for which moments are declared.

A reading is a complex ratio: of a window, or of a time slot, the phasor of the current through the
coils of a tone over the phasor of the declared current.  Amplitude and phase are linear between
readings and are extrapolated by one interval beyond the last, then constant: a running estimator
needs them at the time of the next reading.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from magfusion.units import Array, BoolArray, ComplexArray

MAX_READINGS = 1000  # readings of each channel, or part, that a running estimator keeps
MIN_SHARE = 1e-6  # of a drive that is off, to keep its logarithm finite
MIN_CURRENT_SHARE = 0.05  # of the declared current; below, the drive is off and has no phase


@dataclass(frozen=True, eq=False)
class DriveSamples:
    """Sampled currents."""

    time: Array  # (n,), seconds since the log's epoch, strictly increasing
    # (n,) each, current of each beacon, by its name (A); ``""`` for all that have none of their own
    current: Mapping[str, Array]

    def rows(self, kept: slice | BoolArray) -> "DriveSamples":
        """Return a subset of the samples."""
        own = {name: values[kept] for name, values in self.current.items()}
        return DriveSamples(self.time[kept], own)


class DriveShares:
    """Readings of several channels, complete or streamed.

    `readings`: by channel, as of `key`, shape (3, n): times, increasing (s), logarithms of the
    ratios' magnitudes, and their angles, unwrapped (rad).
    """

    readings: dict[str, Array]  # part of a checkpoint

    def __init__(self, readings: Mapping[str, Array] | None = None) -> None:
        self.readings = {} if readings is None else dict(readings)

    @staticmethod
    def key(beacon: str, tone: int) -> str:
        """Return the key of a channel's readings."""
        return f"{tone} {beacon}"

    def add_readings(self, beacon: str, tone: int, time: Array, share: ComplexArray) -> None:
        """Add readings of a channel, in order of time, later than the stored ones."""
        key = self.key(beacon, tone)
        known = self.readings.get(key, np.zeros((3, 0)))
        angle = np.angle(share)
        if known.shape[1]:
            angle = np.unwrap(np.append(known[2, -1], angle))[1:]
        else:
            angle = np.unwrap(angle)
        size = np.log(np.maximum(np.abs(share), MIN_SHARE))
        self.readings[key] = np.concatenate([known, [time, size, angle]], axis=1)

    def discard_old(self) -> None:
        """Discard readings that a running estimator no longer needs."""
        self.readings = {key: known[:, -MAX_READINGS:] for key, known in self.readings.items()}

    def at(self, beacon: str, tone: int, time: Array) -> tuple[Array, Array] | None:
        """Return log-magnitudes and angles (rad) of a channel, of the shape of the times (s).

        None without readings of it.
        """
        known = self.readings.get(self.key(beacon, tone))
        if known is None:
            return None
        known = _gone_on(known)
        return np.interp(time, known[0], known[1]), np.interp(time, known[0], known[2])


def _gone_on(known: Array) -> Array:
    """Return readings with one extrapolated reading, where the drive was on."""
    if known.shape[1] < 2 or np.min(known[1, -2:]) < np.log(MIN_CURRENT_SHARE):
        return known
    return np.column_stack([known, 2.0 * known[:, -1] - known[:, -2]])
