"""Error growth of dead reckoning: transition and noise of short steps, world axes.

Rotation, position, velocity, accelerometer and gyro bias; the rotation error is a left
perturbation, about the world's axes.
"""

import numpy as np

from magfusion.estimation.graph.preintegration import (
    BRIDGE_ACCEL_NOISE,
    BRIDGE_GYRO_NOISE,
    bias_walks,
)
from magfusion.estimation.graph.state import MOTION
from magfusion.model.field import skew
from magfusion.model.site import ImuModel
from magfusion.units import Array, BoolArray


def step_transitions(length: Array, rotation: Array, force_world: Array) -> Array:
    """Return the error transition of steps, shape (..., 15, 15).

    `length` (...) (s). `rotation` (..., 3, 3): ``world_from_body``. `force_world` (..., 3):
    specific force (m/s^2).
    """
    dt = length[..., None, None]
    by_turn, by_bias = -dt * skew(force_world), -dt * rotation
    step = np.zeros((*length.shape, MOTION, MOTION))
    step[...] = np.eye(MOTION)
    step[..., :3, 12:] = by_bias
    step[..., 3:6, :3], step[..., 6:9, :3] = 0.5 * dt * by_turn, by_turn
    by_both = by_turn @ by_bias
    step[..., 3:6, 12:], step[..., 6:9, 12:] = dt / 6.0 * by_both, 0.5 * by_both
    step[..., 3:6, 6:9] = dt * np.eye(3)
    step[..., 3:6, 9:12], step[..., 6:9, 9:12] = 0.5 * dt * by_bias, by_bias
    return step


def step_noise(length: Array, imu: ImuModel, gap_bridged: BoolArray) -> Array:
    """Return the covariance added by steps, shape (..., 15, 15).

    `length` (...) (s). `imu`: its densities. `gap_bridged` (...): steps in a gap of the stream.
    """
    gyro = np.where(gap_bridged, max(BRIDGE_GYRO_NOISE, imu.gyro_noise), imu.gyro_noise) ** 2
    accel = np.where(gap_bridged, max(BRIDGE_ACCEL_NOISE, imu.accel_noise), imu.accel_noise) ** 2
    axes = np.arange(3)
    noise = np.zeros((*length.shape, MOTION, MOTION))
    noise[..., axes, axes] = (gyro * length)[..., None]
    noise[..., 3 + axes, 3 + axes] = (accel * length**3 / 3.0)[..., None]
    noise[..., 6 + axes, 6 + axes] = (accel * length)[..., None]
    both = (0.5 * accel * length**2)[..., None]
    noise[..., 3 + axes, 6 + axes] = noise[..., 6 + axes, 3 + axes] = both
    for begin, walk in zip((12, 9), bias_walks(imu), strict=True):
        rows = begin + axes
        noise[..., rows, rows] = (walk**2 * length)[..., None]
    return noise
