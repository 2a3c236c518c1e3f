"""Simulated twins of recordings as they are public: the columns, units and habits of each kind."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from magfusion.units import Array

G = 9.80665  # m/s^2
EARTH = np.array([3.0, 21.0, -43.0])  # uT, world (east, north, up)
SITE = """\
magfusion_site: 1
world:
  gravity_m_s2: 9.80665
  earth_field_t: [3.0e-6, 21.0e-6, -43.0e-6]
beacons: []
platform:
  imu: {gyro_noise: 2.0e-4, accel_noise: 2.0e-3, gyro_bias_walk: 1.0e-5, accel_bias_walk: 1.0e-4,
    gyro_bias_sigma: 0.01, accel_bias_sigma: 0.05, time_offset_sigma_s: 0.03}
  magnetometer:
    noise_density_t_rthz: 3.0e-8
"""


@dataclass(frozen=True, eq=False)
class Motion:
    """True attitude and what ideal instruments measure, body axes.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    gyro, accel, field : ndarray, shape (n, 3)
        (rad/s), (m/s^2), (uT).
    """

    time: Array
    world_from_body: Rotation
    gyro: Array
    accel: Array
    field: Array


def turning(
    time: Array, seed: int, axes: tuple[float, float, float] = (1.6, 1.3, 3.0), swing: float = 6.0
) -> Motion:
    """Return a body that turns about its axes, at one place.

    Parameters
    ----------
    axes : tuple of float
        Standard deviation of roll, pitch and yaw (rad).
    swing : float
        Time between two turning points (s).
    """
    rng = np.random.default_rng(seed)
    knots = np.arange(time[0] - swing, time[-1] + 2.0 * swing, swing)
    angles = CubicSpline(knots, np.array(axes) * rng.standard_normal((len(knots), 3)))
    attitude, step = Rotation.from_euler("xyz", angles(time)), 1e-4
    after = Rotation.from_euler("xyz", angles(time + step))
    gyro = (attitude.inv() * after).as_rotvec() / step
    up = attitude.inv().apply(np.tile([0.0, 0.0, G], (len(time), 1)))
    return Motion(time, attitude, gyro, up, attitude.inv().apply(np.tile(EARTH, (len(time), 1))))


def noisy(values: Array, sigma: float, seed: int) -> Array:
    """Return values with white noise."""
    return values + sigma * np.random.default_rng(seed).standard_normal(values.shape)


def write(
    path: Path, head: list[str], *columns: Array, sign: str = ",", form: str = "%.7g"
) -> Path:
    """Write columns as text."""
    rows = np.column_stack(columns)
    forms = [form] * rows.shape[1]
    lines = [sign.join(f % v for f, v in zip(forms, row, strict=True)) for row in rows]
    path.write_text("\n".join([*head, *lines]) + "\n", encoding="utf-8")
    return path
