"""Prediction by a motion prior without an IMU, in the filter's steps, with its covariance."""

import numpy as np

from magfusion.estimation.graph.dead_reckoning_error import step_noise, step_transitions
from magfusion.estimation.online.propagated import Passage
from magfusion.model.platform_motion import ImuModel
from magfusion.model.strapdown_steps import steps_of
from magfusion.model.without_imu import MAX_STEP
from magfusion.units import Array


def ahead_by_prior(passage: Passage, horizon: float, imu: ImuModel) -> Passage:
    """Return a passage predicted with white accelerations of rate and velocity only.

    Without a stream the error of a prediction cannot be measured: it follows from the prior.
    `horizon` (s). `imu`: of `magfusion.model.without_imu.on_motion_prior`.
    """
    count = max(1, int(np.ceil(horizon / MAX_STEP - 1e-9)))
    length = np.full(len(passage), horizon / count)
    rotated = steps_of(passage.gyro_body, passage.accel_body, length)
    rotation, position = passage.world_from_body, passage.position_world
    velocity = passage.velocity_world
    transition, noise = passage.transition, passage.noise
    for _ in range(count):
        after = rotation @ rotated.rotation
        middle = 0.5 * (rotation + after)
        force = (middle @ passage.accel_body[..., None])[..., 0]
        step = step_transitions(length, middle, force)
        noise = step @ noise @ np.swapaxes(step, 1, 2) + _added(length, middle, imu)
        transition = step @ transition
        moved = (rotation @ rotated.position[..., None])[..., 0]
        position = position + velocity * length[:, None] + moved
        velocity = velocity + (rotation @ rotated.velocity[..., None])[..., 0]
        rotation = after
    return Passage(
        passage.time + horizon,
        rotation,
        position,
        velocity,
        passage.gyro_body,
        passage.accel_body,
        transition,
        noise,
    )


def _added(length: Array, rotation: Array, imu: ImuModel) -> Array:
    """Return the covariance that a step adds, including the rotation by its random-walk rate."""
    noise = step_noise(length, imu, np.zeros(len(length), dtype=np.bool_))
    walk = imu.gyro_bias_walk**2
    axes = np.arange(3)
    noise[:, axes, axes] += (walk * length**3 / 3.0)[:, None]
    # An error of the rate acts as a bias of the opposite sign.
    both = -0.5 * walk * (length**2)[:, None, None] * rotation
    noise[:, :3, 12:] += both
    noise[:, 12:, :3] += np.swapaxes(both, 1, 2)
    return noise
