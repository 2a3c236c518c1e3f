"""Dead-reckoning steps in closed form, on arrays: rate and specific force constant in each."""

from typing import NamedTuple

import numpy as np

from magfusion.model.field import skew
from magfusion.units import Array

SMALL = 0.03  # rad; below it the series are as accurate as the closed forms


class StepMotion(NamedTuple):
    """Increments of steps, in body axes at the beginning of each."""

    rotation: Array  # (n, 3, 3), ``before_from_after``
    # velocity, position: (n, 3), gain from the specific force alone (m/s, m)
    velocity: Array
    position: Array


def steps_of(gyro_body: Array, accel_body: Array, dt: Array) -> StepMotion:
    """Return the increments of steps with constant rate and specific force in body axes.

    `gyro_body`, `accel_body` (n, 3) (rad/s, m/s^2), `dt` (n,) (s).
    """
    turn, length = gyro_body * dt[:, None], dt[:, None]
    square = np.sum(turn**2, axis=1)
    angle = np.sqrt(square)
    near = angle < SMALL
    safe = np.where(near, 1.0, angle)
    half = np.sin(0.5 * safe)
    sine, cosine = np.sin(safe), 2.0 * half**2
    # Rotation, its integral and double integral, with powers of the angle factored out.
    first = np.where(near, 1.0 - square / 6.0 * (1.0 - square / 20.0), sine / safe)
    second = np.where(near, 0.5 - square / 24.0 * (1.0 - square / 30.0), cosine / safe**2)
    third = np.where(
        near, (1.0 - square / 20.0 * (1.0 - square / 42.0)) / 6.0, (safe - sine) / safe**3
    )
    fourth = np.where(
        near,
        (1.0 - square / 30.0 * (1.0 - square / 56.0)) / 24.0,
        (0.5 * safe**2 - cosine) / safe**4,
    )
    across = skew(turn)
    twice = across @ across
    once_on, twice_on = ((matrix @ accel_body[..., None])[..., 0] for matrix in (across, twice))
    rotation = np.eye(3) + first[:, None, None] * across + second[:, None, None] * twice
    velocity = accel_body + second[:, None] * once_on + third[:, None] * twice_on
    position = 0.5 * accel_body + third[:, None] * once_on + fourth[:, None] * twice_on
    return StepMotion(rotation, velocity * length, position * length**2)
