"""Zero angular rate: in a stationary interval the gyroscope measures its bias.

Between two epochs hours apart nothing else separates a bias from a rotation.  The same noise is in
the inertial stream between the states, so that the uncertainty of the rotation within the interval
is overestimated, never underestimated.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.graph.measurement import Measurement, Rows
from magfusion.estimation.graph.state import States
from magfusion.model.parameters import Block, Calibration
from magfusion.model.samples import ImuSamples
from magfusion.units import Array, IntArray

MAX_MEAN = 2.0  # s


@dataclass(frozen=True, eq=False)
class ZeroRate(Measurement):
    """The gyroscope's bias equals its reading."""

    measured_body: Array  # (n, 3) (rad/s)
    sigma: Array  # (n,) (rad/s)

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate, one group of three."""
        weight = 1.0 / self.sigma[:, None, None]
        error = weight * (states.read_bias()[:, 3:] - self.measured_body)[:, None]
        by_bias = np.zeros((len(self.sigma), 1, 3, 6))
        by_bias[..., 3:] = weight[..., None] * np.eye(3)
        return Rows(error=error, by_bias=by_bias)


def zero_rate(
    epoch: IntArray,
    time: Array,
    within: tuple[Array, Array],
    imu: ImuSamples,
    time_offset: Array,
    noise: float,
) -> ZeroRate | None:
    """Return the gyroscope's mean around stationary epochs as a measurement; None in a gap.

    `time` (n,): of the epochs, increasing (s). `within` (n,) each: begin and end of the stationary
    interval of each (s). `time_offset` (n,): of the IMU's stamps at each (s). `noise`: density of
    the gyroscope's noise (rad/s/sqrt(Hz)).
    """
    if len(time) == 0 or len(imu) == 0:
        return None
    gap = np.diff(time, prepend=-np.inf, append=np.inf)
    half = 0.5 * np.minimum(MAX_MEAN, np.minimum(gap[:-1], gap[1:]))
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.gyro_body, axis=0)])
    begin, end = np.maximum(time - half, within[0]), np.minimum(time + half, within[1])
    first, last = (np.searchsorted(imu.time, one - time_offset) for one in (begin, end))
    some = last > first
    if not np.any(some):
        return None
    count = (last - first)[some]
    mean = (total[last] - total[first])[some] / count[:, None]
    step = float(np.median(np.diff(imu.time))) if len(imu) > 1 else MAX_MEAN
    return ZeroRate(epoch[some], mean, noise / np.sqrt(count * step))


def without_bias(imu: ImuSamples, begin: Array, end: Array) -> ImuSamples:
    """Remove the mean rate of stationary intervals from inertial samples, interpolated between.

    `begin`, `end` (rests,): by the IMU's stamps (s).
    """
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.gyro_body, axis=0)])
    first, last = np.searchsorted(imu.time, begin), np.searchsorted(imu.time, end)
    some = last > first
    if not np.any(some):
        return imu
    mean = (total[last] - total[first])[some] / (last - first)[some, None]
    edge = np.stack([begin[some], end[some]], axis=1).ravel()
    each = np.repeat(mean, 2, axis=0)
    bias = np.stack([np.interp(imu.time, edge, value) for value in each.T], axis=1)
    return ImuSamples(imu.time, imu.gyro_body - bias, imu.accel_body)
