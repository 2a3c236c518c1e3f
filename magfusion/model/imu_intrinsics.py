"""Scale factors, axes and g-sensitivity of an IMU."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class ImuIntrinsics:
    """Deterministic errors of an IMU, besides its biases.

    ``measured gyro = gyro_matrix @ rate + gyro_g_sensitivity @ force + bias`` and
    ``measured accel = accel_matrix @ force + bias``, in body axes.
    """

    # gyro_matrix, accel_matrix: (3, 3), scale factors and directions of the axes
    gyro_matrix: Array = field(default_factory=lambda: np.eye(3))
    accel_matrix: Array = field(default_factory=lambda: np.eye(3))
    # (3, 3), rate (rad/s) that each m/s^2 of specific force causes
    gyro_g_sensitivity: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def corrected(self, gyro_body: Array, accel_body: Array) -> tuple[Array, Array]:
        """Return rates (rad/s) and specific forces (m/s^2), shape (n, 3), without these errors."""
        accel = np.linalg.solve(self.accel_matrix, accel_body.T).T
        caused = accel @ self.gyro_g_sensitivity.T
        gyro = np.linalg.solve(self.gyro_matrix, (gyro_body - caused).T).T
        return np.asarray(gyro, dtype=np.float64), np.asarray(accel, dtype=np.float64)

    def recorded(self, gyro_body: Array, accel_body: Array) -> tuple[Array, Array]:
        """Return the measured values of `corrected` ones."""
        gyro = gyro_body @ self.gyro_matrix.T + accel_body @ self.gyro_g_sensitivity.T
        return np.asarray(gyro), np.asarray(accel_body @ self.accel_matrix.T)


def turn_of_imu(before: ImuIntrinsics | None, after: ImuIntrinsics | None) -> Rotation:
    """Return the rotation to the axes of an IMU that is corrected for being rotated.

    The identity where they differ in anything else.
    """
    known, result = before or ImuIntrinsics(), after or ImuIntrinsics()
    gyro = np.linalg.solve(known.gyro_matrix, result.gyro_matrix)
    accel = np.linalg.solve(known.accel_matrix, result.accel_matrix)
    is_rotated = np.allclose(gyro, accel, rtol=1e-5, atol=1e-8) and np.allclose(
        gyro @ gyro.T, np.eye(3), rtol=1e-5, atol=1e-8
    )
    if not is_rotated or np.linalg.det(gyro) < 0.0:
        return Rotation.identity()
    return Rotation.from_matrix(gyro.T)
