"""A trajectory: poses over time."""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of the body over time; optional parts are None where they are not known.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds since the log's epoch, strictly increasing.
    world_from_body : ndarray, shape (n, 3, 3)
        Rotation matrices.
    position_world : ndarray, shape (n, 3)
        (m)
    velocity_world : ndarray, shape (n, 3), optional
        (m/s)
    gyro_bias_body : ndarray, shape (n, 3), optional
        (rad/s)
    accel_bias_body : ndarray, shape (n, 3), optional
        (m/s^2)
    pose_cov : ndarray, shape (n, 6, 6), optional
        Rotation, then position; body axes, right perturbation (rad, m).
    """

    time: Array
    world_from_body: Array
    position_world: Array
    velocity_world: Array | None = None
    gyro_bias_body: Array | None = None
    accel_bias_body: Array | None = None
    pose_cov: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.time)
        shapes = {"time": (n,), "world_from_body": (n, 3, 3), "position_world": (n, 3)}
        shapes |= {k: (n, 3) for k in ("velocity_world", "gyro_bias_body", "accel_bias_body")}
        shapes["pose_cov"] = (n, 6, 6)
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"{name} must have shape {shape}; got {value.shape}")
        if n > 1 and np.any(np.diff(self.time) <= 0):
            raise ValueError("time must be strictly increasing")

    def __len__(self) -> int:
        return len(self.time)
