"""Stationary intervals of a sensor that is placed in one orientation after another."""

from dataclasses import dataclass

import numpy as np

from magfusion.model.samples import ImuSamples
from magfusion.model.site import MotionModel
from magfusion.model.strapdown import resting
from magfusion.units import DEGREE, Array

MIN_STOP = 1.5  # s; of a stop
RATE = 0.05  # rad/s; a gyro's bias is below it, a turn by hand above
SAME = 10.0 * DEGREE  # stops whose vertical and turn differ by less are one orientation


@dataclass(frozen=True, eq=False)
class Stops:
    """Stationary intervals of the platform."""

    # begin, end: (n,) (s), the IMU's stamps
    begin: Array
    end: Array

    def __len__(self) -> int:
        return len(self.begin)

    @property
    def centre(self) -> Array:
        """Middle of each stop (s)."""
        return 0.5 * (self.begin + self.end)

    @property
    def length(self) -> Array:
        """Length of each stop (s)."""
        return self.end - self.begin


def find_stops(imu: ImuSamples, motion: MotionModel) -> Stops:
    """Find sufficiently long stationary intervals.

    `motion`: defines rest. Returned in order of time; a slow even rotation, which scatters as
    little as rest, is excluded.
    """
    still = resting(imu.time, imu.gyro_body, imu.accel_body, motion=motion)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    first, last = edges[::2], edges[1::2] - 1
    long = imu.time[last] - imu.time[first] >= MIN_STOP
    first, last = first[long], last[long]
    rates = [
        float(np.linalg.norm(np.mean(imu.gyro_body[i : j + 1], axis=0)))
        for i, j in zip(first, last, strict=True)
    ]
    kept = np.array(rates, dtype=float) < RATE
    return Stops(imu.time[first[kept]], imu.time[last[kept]])


def distinct(world_from_body: Array) -> int:
    """Return how many of some attitudes, shape (n, 3, 3), differ by more than `SAME`."""
    kept: list[Array] = []
    for attitude in world_from_body:
        traces = [float(np.trace(other.T @ attitude)) for other in kept]
        if all(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)) > SAME for trace in traces):
            kept.append(attitude)
    return len(kept)
