"""Zero-velocity update: detection of a stationary platform, and its measurement."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.graph.measurement import Measurement, Rows
from magfusion.estimation.graph.state import States
from magfusion.model.parameters import Block, Calibration
from magfusion.model.samples import ImuSamples
from magfusion.model.site import MotionModel
from magfusion.model.strapdown import resting
from magfusion.units import Array, BoolArray, IntArray

REST_GATE = 30.7  # chi square of three components, one in a million: days have many rests
MAX_SILENCE = 0.1  # s; a gap looks quiet
MIN_SAMPLES = 10
REACH = 0.1  # s, beyond the span, that the samples should cover
_EYE = np.eye(3)


@dataclass(frozen=True, eq=False)
class ZeroVelocity(Measurement):
    """The velocity is zero: the platform is at rest."""

    sigma: Array  # (n,) (m/s)

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate, one group of three."""
        weight = 1.0 / self.sigma[:, None, None]
        return Rows(
            error=weight * states.velocity_world[:, None], by_velocity=weight[..., None] * _EYE
        )


def zero_velocity(epoch: IntArray, sigma: float) -> ZeroVelocity:
    """Return zero velocity at some epochs, with one sigma (m/s)."""
    return ZeroVelocity(epoch, np.full(len(epoch), sigma))


def quiet_before(imu: ImuSamples, stamps: Array, motion: MotionModel) -> BoolArray:
    """Return at which times the IMU has been quiet for the rest span, without a gap.

    `stamps` (n,): on the IMU's clock (s).
    """
    time, count, span = imu.time, len(imu), motion.rest_span
    if count < MIN_SAMPLES:
        return np.zeros(len(stamps), dtype=bool)
    first = np.searchsorted(time, stamps - span - REACH)
    last = np.searchsorted(time, stamps + REACH, side="right")
    enough = last - first >= MIN_SAMPLES
    first, last = np.minimum(first, count - 1), np.maximum(np.minimum(last, count), 1)
    covered = (time[first] <= stamps - span) & (time[last - 1] >= stamps - REACH)
    silent = np.zeros(count, dtype=np.int64)
    gap = time[1:] - time[:-1] > MAX_SILENCE
    if gap.any():
        gap.cumsum(out=silent[1:])
    middle = np.minimum(np.searchsorted(time, stamps - span / 2), count - 1)
    streams = time, imu.gyro_body, imu.accel_body
    still = resting(*streams, span - REACH, motion=motion, at=middle)
    return enough & covered & (silent[last - 1] == silent[first]) & still


def slow_enough_to_stand(velocity_world: Array, motion: MotionModel) -> BoolArray:
    """Return where `may_stand` holds for some covariance, which then need not be computed.

    The variance of a known velocity is in no direction beyond its trace.
    """
    variance = 3.0 * motion.rest_known_speed**2 + motion.rest_speed_sigma**2
    return np.asarray((velocity_world**2).sum(axis=-1) < REST_GATE * variance)


def may_stand(velocity_world: Array, cov: Array, motion: MotionModel) -> BoolArray:
    """Return where the velocity estimate is consistent with rest.

    A slow steady motion is as quiet as a rest, so that the velocity decides.  An unknown velocity
    is consistent with anything and gives no information. `velocity_world` (..., 3) (m/s).
    `cov` (..., 3, 3): of the velocity (m^2/s^2).
    """
    known = np.diagonal(cov, axis1=-2, axis2=-1).max(axis=-1) < motion.rest_known_speed**2
    slow = (velocity_world**2).sum(axis=-1) < REST_GATE * motion.rest_speed_sigma**2
    if not known.any() or slow.all():  # a covariance only decreases the distance
        return np.asarray(known & slow)
    cov = cov + motion.rest_speed_sigma**2 * _EYE
    solved = np.linalg.solve(cov, velocity_world[..., None])[..., 0]
    return known & ((velocity_world * solved).sum(axis=-1) < REST_GATE)
