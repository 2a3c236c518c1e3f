"""A head before a source: it turns while it sways, rests, and turns again; and how a run is set."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from magfusion.units import DEGREE, Array

GRAVITY = 9.80665
CARRIER_HZ = 6000.0
RESTING, TURNING = 5.0, 8.5  # s; it turns at its full rate until a second before, and from then
CHANGE = 1.0  # s; from rest to the full rate


@dataclass(frozen=True)
class Config:
    """One run.

    Parameters
    ----------
    duration : float
        (s)
    rate_deg_s : float
        While turning, about.
    noise : float
        Of a sample (T).
    mains : float
        Amplitude of its fundamental (T).
    drive_drift : float
        Share of the current that is lost in a minute.
    imu_rate_hz : float
    ahead : float
        Of the display's instant (s).
    source_ppm : float, optional
        By how much the clock of the source runs fast, which is then its own: when a cycle begins
        the site does not declare, a fourth slot is silent, and the stream determines it.
    plate : bool
        Whether a plate of aluminium is brought near the head, kept there, and removed.
    hemisphere : bool
        Whether the site specifies on which side of the source the head is.
    inertial : bool
        Whether there is an IMU; else the site has a motion prior.
    rate_hz : float
        Cycles a second.
    carrier_hz : float
        Zero of pulses of direct current.
    """

    duration: float = 16.0
    rate_deg_s: float = 100.0
    noise: float = 1e-9
    mains: float = 0.15e-6
    drive_drift: float = 1e-3
    imu_rate_hz: float = 500.0
    ahead: float = 0.02
    source_ppm: float | None = None
    plate: bool = False
    hemisphere: bool = True
    inertial: bool = True
    rate_hz: float = 120.0
    carrier_hz: float = CARRIER_HZ
    seed: int = 0

    @property
    def cycle(self) -> float:
        """Duration of a cycle (s)."""
        return 1.0 / self.rate_hz

    @property
    def slots(self) -> int:
        """Of a cycle."""
        return 3 if self.source_ppm is None else 4


class Head:
    """Turns while it sways by centimetres, rests, and turns again."""

    def __init__(self, config: Config) -> None:
        rng = np.random.default_rng(config.seed)
        knots = np.arange(0.0, config.duration + 3.0, 0.5)
        turn, axis = [Rotation.random(rng=rng)], rng.standard_normal(3)
        for _ in knots[1:]:
            axis = axis / np.linalg.norm(axis) + 0.3 * rng.standard_normal(3)
            step = config.rate_deg_s * DEGREE * 0.5 * axis / np.linalg.norm(axis)
            turn.append(turn[-1] * Rotation.from_rotvec(step))
        sway = np.array([0.45, 0.0, -0.05]) + rng.uniform(-0.08, 0.08, (len(knots), 3))
        self._turn = RotationSpline(knots, Rotation.concatenate(turn))
        self._place = make_interp_spline(knots, sway, 5)

    @staticmethod
    def _run(time: Array) -> tuple[Array, Array, Array]:
        """Return how far along its path it is (s), how fast that grows, and how fast this does."""
        far, speed, growth = time.copy(), np.ones(len(time)), np.zeros(len(time))
        for sign, begin in ((-1.0, RESTING - CHANGE), (1.0, TURNING - CHANGE)):
            share = np.clip((time - begin) / CHANGE, 0.0, 1.0)
            beyond = np.maximum(time - begin - CHANGE, 0.0)
            far += sign * (CHANGE * (share**3 - 0.5 * share**4) + beyond)
            speed += sign * (3.0 * share**2 - 2.0 * share**3)
            growth += sign * 6.0 * (share - share**2) / CHANGE
        return far, speed, growth

    def place(self, time: Array) -> Array:
        """Return the position (n, 3) (m)."""
        return np.asarray(self._place(self._run(time)[0]))

    def turn(self, time: Array) -> Rotation:
        """Return world_from_body."""
        return self._turn(self._run(time)[0])

    def rate_body(self, time: Array) -> Array:
        """Return the angular rate (n, 3) (rad/s)."""
        far, speed, _ = self._run(time)
        return np.asarray(self._turn(far, 1) * speed[:, None])

    def accel_world(self, time: Array) -> Array:
        """Return the acceleration (n, 3) (m/s^2)."""
        far, speed, growth = self._run(time)
        own = self._place(far, 2) * speed[:, None] ** 2 + self._place(far, 1) * growth[:, None]
        return np.asarray(own)

    def imu(self, config: Config, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Return stamps, rates and specific forces of a good consumer's IMU."""
        step = 1.0 / config.imu_rate_hz
        time = np.arange(0.0, config.duration, step)
        gyro = self.rate_body(time)
        force_world = self.accel_world(time) + np.array([0.0, 0.0, GRAVITY])
        accel = self.turn(time).inv().apply(force_world)
        white = np.sqrt(config.imu_rate_hz)
        gyro = gyro + 2e-3 * rng.standard_normal(3) + 1e-4 * white * rng.standard_normal(gyro.shape)
        accel = accel + 0.03 * rng.standard_normal(3)
        return time, gyro, accel + 1e-3 * white * rng.standard_normal(accel.shape)
