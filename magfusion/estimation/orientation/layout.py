"""State of an orientation without beacons, and the tangent of its covariance.

Errors of attitude, velocity and offset are in world axes, the last two rotated with the attitude
(the two-frame group of Barrau and Bonnabel).  The unobservable direction, the heading at rest with
an unknown offset, is then independent of the estimate, and the filter gains no false information
on it.  Fields are in microtesla, so that the covariance stays well conditioned.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.units import Array

TURN, SPEED = slice(0, 3), slice(3, 6)
GYRO_BIAS, ACCEL_BIAS, GYRO_MATRIX = slice(6, 9), slice(9, 12), slice(12, 21)
OFFSET, NEAR, MATRIX = slice(21, 24), slice(24, 27), slice(27, 36)
LAG, FAR = slice(36, 37), slice(37, 40)
GYRO_FORCE, ACCEL_MATRIX, ARM = slice(40, 49), slice(49, 58), slice(58, 61)
SIZE = 61


@dataclass(frozen=True, eq=False)
class Orientation:
    """Attitude and other estimates, at one time."""

    time: float  # (s)
    world_from_body: Array  # (3, 3)
    velocity_world: Array  # (3,), kept near zero within the usual speed (m/s)
    # gyro_bias, accel_bias: (3,), body axes (rad/s, m/s^2)
    gyro_bias: Array
    accel_bias: Array
    # (3, 3), true rate = (1 + matrix) measured rate - bias - force matrix times measured force
    gyro_matrix: Array
    # gyro_force, accel_matrix: (3, 3), true force = (1 + matrix) measured force - bias
    gyro_force: Array
    accel_matrix: Array
    arm: Array  # (3,), from the point that the platform swings about to its sensor, body axes (m)
    offset: Array  # (3,), of the magnetometer, measured axes (uT)
    # near, far: (3,), deviation of the field from the declared one, world axes (uT): local and
    # present, and everywhere
    near: Array
    matrix: Array  # (3, 3), of the magnetometer
    lag: float  # delay of the field samples relative to the inertial samples (s)
    far: Array
    cov: Array  # (61, 61)

    def moved(self, step: Array, measured_from_body: Array) -> "Orientation":
        """Return the state moved by a tangent vector; the covariance is constant."""
        turn = Rotation.from_rotvec(step[TURN]).as_matrix()
        attitude = turn @ self.world_from_body
        return replace(
            self,
            world_from_body=attitude,
            velocity_world=turn @ self.velocity_world + step[SPEED],
            gyro_bias=self.gyro_bias + step[GYRO_BIAS],
            accel_bias=self.accel_bias + step[ACCEL_BIAS],
            gyro_matrix=self.gyro_matrix + step[GYRO_MATRIX].reshape(3, 3),
            gyro_force=self.gyro_force + step[GYRO_FORCE].reshape(3, 3),
            accel_matrix=self.accel_matrix + step[ACCEL_MATRIX].reshape(3, 3),
            arm=self.arm + step[ARM],
            offset=self.offset + measured_from_body @ attitude.T @ step[OFFSET],
            near=self.near + step[NEAR],
            matrix=self.matrix + step[MATRIX].reshape(3, 3),
            lag=self.lag + float(step[LAG][0]),
            far=self.far + step[FAR],
        )

    def step_to(self, other: "Orientation", measured_from_body: Array) -> Array:
        """Return the tangent vector to another state: the inverse of `moved`."""
        turn = other.world_from_body @ self.world_from_body.T
        offset = np.linalg.solve(measured_from_body, other.offset - self.offset)
        return np.concatenate(
            [
                Rotation.from_matrix(turn).as_rotvec(),
                other.velocity_world - turn @ self.velocity_world,
                other.gyro_bias - self.gyro_bias,
                other.accel_bias - self.accel_bias,
                (other.gyro_matrix - self.gyro_matrix).ravel(),
                other.world_from_body @ offset,
                other.near - self.near,
                (other.matrix - self.matrix).ravel(),
                [other.lag - self.lag],
                other.far - self.far,
                (other.gyro_force - self.gyro_force).ravel(),
                (other.accel_matrix - self.accel_matrix).ravel(),
                other.arm - self.arm,
            ]
        )
