"""Constant-motion model: the covariance of predictions that keep rate and specific force constant.

It is measured on the inertial stream itself, by the errors of such predictions in its past.
"""

import numpy as np

from magfusion.model.samples import ImuSamples
from magfusion.model.trajectory import interpolated
from magfusion.units import Array, IntArray

REFERENCE = 0.05  # s; the measured horizon where none is requested
# Initially, of a hand: change of rate (rad/s^2) and of force (m/s^3) in a second.
ANGULAR, JERK = 10.0, 30.0
PRIOR = 1.0  # s of the stream; the weight of these
MEMORY, RECENT = 20.0, 1.0  # s
PARTS = (slice(0, 3), slice(3, 9))  # rotation, then position and velocity


class ConstantMotionModel:
    """Covariance of prediction errors, body axes.

    The average of the last `MEMORY` seconds, or of the most recent ones where that is larger.
    `horizon`: of the measured predictions (s); others scale with powers of time, bounded below.
    """

    _mean: Array
    _recent: Array
    _weight: float
    _last_time: float

    def __init__(self, horizon: float) -> None:
        self.horizon = horizon if horizon > 0.0 else REFERENCE
        h = self.horizon
        self._mean = np.zeros((9, 9))
        sizes = (0.5 * ANGULAR * h**2, JERK * h**3 / 6.0, 0.5 * JERK * h**2)
        self._mean[np.arange(9), np.arange(9)] = np.repeat(sizes, 3) ** 2
        self._recent, self._weight, self._last_time = self._mean.copy(), PRIOR, -np.inf

    def update(self, imu: ImuSamples) -> None:
        """Process the new samples of the stream."""
        if len(imu) < 3:
            return
        begin = max(self._last_time, imu.time[0])
        own = (imu.time >= begin) & (imu.time + self.horizon <= imu.time[-1])
        passed = float(imu.time[-1] - self.horizon) - begin
        if passed <= 0.0 or not np.any(own):
            return
        missed = _missed(imu, np.flatnonzero(own), self.horizon)
        square = missed.T @ missed / len(missed)
        weight = min(self._weight + passed, MEMORY)
        self._mean = self._mean + min(passed / weight, 1.0) * (square - self._mean)
        self._recent = self._recent + min(passed / RECENT, 1.0) * (square - self._recent)
        self._weight, self._last_time = weight, float(imu.time[-1] - self.horizon)

    def cov(self, horizon: float) -> Array:
        """Return the covariance of rotation, position and velocity after a horizon (s)."""
        ratio = horizon / self.horizon
        grown = ratio ** np.where(ratio > 1.0, [2.0, 3.0, 2.0], [1.0, 2.0, 1.0])
        scale = np.repeat(grown, 3)
        for part in PARTS:
            more = np.diagonal(self._recent)[part] / np.diagonal(self._mean)[part]
            scale[part] *= np.sqrt(max(1.0, float(np.max(more))))
        return scale[:, None] * self._mean * scale


def _missed(imu: ImuSamples, at: IntArray, horizon: float) -> Array:
    """Return errors of predictions from some samples: rotation, position, velocity, (n, 9)."""
    time, count = imu.time, max(int(np.ceil(horizon / np.median(np.diff(imu.time)))), 2)
    dt = horizon / count
    turn, gained, moved = np.zeros((3, len(at), 3))
    now = time[at]
    gyro, force = imu.gyro_body[at], imu.accel_body[at]
    for k in range(count):
        start_time = (k + 0.5) * dt
        rate = interpolated(now + start_time, time, imu.gyro_body)
        later = interpolated(now + start_time, time, imu.accel_body)
        # The force is constant in world axes: it rotates with respect to the body.
        change = (later + start_time * np.cross(gyro, later) - force) * dt
        turn += (rate - gyro) * dt
        moved += gained * dt + 0.5 * change * dt
        gained += change
    return np.hstack([turn, moved, gained])
