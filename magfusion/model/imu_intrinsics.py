"""Scale factors, axes and g-sensitivity of an IMU."""

from dataclasses import dataclass, field

import numpy as np

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
