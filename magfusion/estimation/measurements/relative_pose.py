"""Relative pose between two times, as of visual or laser odometry from keyframe to keyframe.

The inertial samples of the interval give the earlier pose from the later state, so that the
measurement is of one state: with the preintegrated rotation dR, velocity dv and position dp, the
body was displaced, in its axes at the beginning, by ``T dR R^T (v + T g / 2) - T dv + dp``, where R
and v are attitude and velocity at the end, T is the length and g points up.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.imu_decimation import thinned
from magfusion.estimation.graph.preintegration import (
    RATE_SPAN,
    bias_walks,
    cut_at_epochs,
    inertial_at,
    preintegrate,
)
from magfusion.estimation.graph.state import States
from magfusion.estimation.measurements.aiding import AidingMeasurement, Prediction
from magfusion.model.aiding import MAX_INTERVAL, AidingSamples, AidingSensor
from magfusion.model.parameters import AIDING_POSITION, AIDING_ROTATION, AIDING_SCALE
from magfusion.model.perturbation import skew
from magfusion.model.samples import ImuSamples
from magfusion.model.site import ImuModel, Site
from magfusion.units import Array

UP_WORLD = np.array([0.0, 0.0, 1.0])
ROUNDING = 1e-6  # of the longest interval


@dataclass(frozen=True, eq=False)
class RelativePose(AidingMeasurement):
    """Translation in the sensor's axes at the beginning, and rotation, from the end's state.

    The rows of the rotation are the rotation vector from the measured to the predicted one; their
    measured value is zero.
    """

    interval: Array  # (n,), length (s)
    rotation_measured: Array  # (n, 3, 3)
    noise: Array  # (n, 6), of the sensor; ``sigma`` includes that of the inertial samples (m, rad)
    gravity: float  # (m/s^2)
    rate_begin: Array  # (n, 3), measured at the beginning, with its bias (rad/s)
    # (n, 6), accelerometer, then gyro bias at which the samples are preintegrated (m/s^2, rad/s)
    bias: Array
    # rotated, gained, passed: (n, 3, 3) and (n, 3), preintegrated rotation, velocity (m/s) and
    # position (m) in axes of the body at the beginning
    rotated: Array
    gained: Array
    passed: Array
    by_bias: Array  # (n, 9, 6), their derivatives: rotation on the right, position and velocity

    def over_interval(
        self,
        imu: ImuSamples,
        time_offset: float,
        end: Array,
        bias: Array,
        site: Site,
        usual: float | None = None,
    ) -> Self:
        """Return the measurement with the inertial samples of its intervals.

        One that lacks some of them, or is too long, is not measured: its sigmas are infinite.

        Parameters
        ----------
        time_offset : float
            Added to the stamps of the samples (s).
        end : ndarray, shape (n,)
            Of the intervals (s).
        bias : ndarray, shape (n, 6)
            At which to preintegrate, accelerometer first (m/s^2, rad/s).
        usual : float, optional
            Sampling interval (s); the median by default.
        """
        begin, model = end - self.interval, site.platform.imu
        own = replace(
            self,
            gravity=site.gravity,
            bias=bias,
            sigma=np.hypot(self.noise, self._inertial_noise(model, site.gravity)),
            **{k: getattr(self, k).copy() for k in ("rotated", "gained", "passed", "by_bias")},
        )
        own.sigma[self.interval > MAX_INTERVAL * (1.0 + ROUNDING)] = np.inf
        if len(imu) < 2:
            own.sigma[:] = np.inf
            return own
        usual = float(np.median(np.diff(imu.time))) if usual is None else usual
        first = np.maximum(np.searchsorted(imu.time, begin - time_offset) - 3, 0)
        last = np.searchsorted(imu.time, end - time_offset) + 3
        for k in np.flatnonzero(np.isfinite(own.sigma[:, 0])).tolist():
            part = slice(first[k], last[k])
            stream = ImuSamples(imu.time[part], imu.gyro_body[part], imu.accel_body[part])
            if len(stream) < 2 or not own._preintegrate(
                k, stream, time_offset, end[k], site, usual
            ):
                own.sigma[k] = np.inf
        return replace(own, rate_begin=inertial_at(imu, time_offset, begin)[:, :3])

    def _preintegrate(
        self, k: int, imu: ImuSamples, time_offset: float, end: float, site: Site, usual: float
    ) -> bool:
        """Fill the preintegrated values of one interval; return whether all samples are there."""
        epochs = np.array([end - self.interval[k], end])
        increments = cut_at_epochs(imu, time_offset, epochs, usual)
        accel, gyro = self.bias[k : k + 1, :3], self.bias[k : k + 1, 3:]
        increments = thinned(increments, accel, gyro)
        result = preintegrate(increments, site.platform.imu, site.gravity, accel, gyro)[0]
        moved, by_bias = np.zeros((9, 9), order="F"), np.zeros((9, 6), order="F")
        bias = gtsam.imuBias.ConstantBias(accel[0], gyro[0])
        result.predict(gtsam.NavState(), bias, moved, by_bias)
        turn = result.deltaRij().matrix()
        self.rotated[k], self.gained[k], self.passed[k] = turn, result.deltaVij(), result.deltaPij()
        self.by_bias[k] = by_bias
        self.by_bias[k, 3:6] = turn @ by_bias[3:6]  # GTSAM has them in axes at the end
        self.by_bias[k, 6:] = turn @ by_bias[6:]
        return not increments.gap_bridged[0]

    def _inertial_noise(self, model: ImuModel, gravity: float) -> Array:
        """Return the sigmas of the rows by the inertial samples, shape (n, 6).

        The end's state is known, so that errors grow towards the beginning: white noise and bias
        walk of the gyro turn the specific force, which is mostly that of gravity, and the
        displacement.
        """
        length = self.interval
        gyro_walk, accel_walk = bias_walks(model)
        rotation = model.gyro_noise**2 * length + gyro_walk**2 * length**3 / 3.0
        translation = model.accel_noise**2 * length**3 / 3.0 + accel_walk**2 * length**5 / 20.0
        translation += gravity**2 * model.gyro_noise**2 * length**5 / 20.0
        translation += gravity**2 * gyro_walk**2 * length**7 / 252.0
        translation += rotation * np.sum(self.value[:, :3] ** 2, axis=1)
        return np.sqrt(np.repeat(np.stack([translation, rotation], axis=1), 3, axis=1))

    def predicted(self, states: States, rate_body: Array, sensor: AidingSensor) -> Prediction:
        """Return scaled translation and rotation of the sensor, which has a lever arm."""
        count, lever, length = len(states), sensor.position_body, self.interval[:, None]
        away, bias = states.read_bias() - self.bias, states.read_bias()
        change = np.einsum("nij,nj->ni", self.by_bias, away)
        turn = self.rotated @ Rotation.from_rotvec(change[:, :3]).as_matrix()
        gained, passed = self.gained + change[:, 6:], self.passed + change[:, 3:6]
        body_from_world = np.swapaxes(states.world_from_body, 1, 2)
        up_world = self.gravity * UP_WORLD
        gain_world = length * (states.velocity_world + 0.5 * length * up_world)
        gain_body = _times(body_from_world, gain_world)
        moved = _times(turn, gain_body + lever) - length * gained + passed - lever
        sensor_from_body = sensor.body_from_sensor.T
        translation = moved @ sensor_from_body.T
        rotation = sensor_from_body @ turn @ sensor.body_from_sensor
        error = Rotation.from_matrix(np.swapaxes(self.rotation_measured, 1, 2) @ rotation)
        residual = error.as_rotvec()
        by_rotation = _of_each(gtsam.Rot3.LogmapDerivative, residual)
        scaled = float(sensor.scale) * sensor_from_body

        turned_by_bias = _of_each(gtsam.Rot3.ExpmapDerivative, change[:, :3])
        rotated_by_bias = turned_by_bias @ self.by_bias[:, :3]
        by_pose, by_bias = np.zeros((count, 6, 6)), np.zeros((count, 6, 6))
        by_pose[:, :3, :3] = scaled @ turn @ skew(gain_body)
        by_velocity = np.zeros((count, 6, 3))
        by_velocity[:, :3] = length[..., None] * (scaled @ turn @ body_from_world)
        own = self.by_bias[:, 3:6] - length[..., None] * self.by_bias[:, 6:]
        by_bias[:, :3] = scaled @ (own - turn @ skew(gain_body + lever) @ rotated_by_bias)
        by_bias[:, 3:] = by_rotation @ sensor_from_body @ rotated_by_bias

        begin = self.rate_begin - bias[:, 3:]
        shift = gained - length * _times(turn, _times(body_from_world, up_world))
        shift = shift - np.cross(begin, moved + lever) + _times(turn, np.cross(rate_body, lever))
        turning = (rate_body - _times(np.swapaxes(turn, 1, 2), begin)) @ sensor_from_body.T
        by_scale, by_mounting = np.zeros((count, 6, 1)), np.zeros((count, 6, 3))
        by_scale[:, :3, 0] = translation
        by_mounting[:, :3] = float(sensor.scale) * skew(translation)
        by_mounting[:, 3:] = by_rotation @ (np.eye(3) - np.swapaxes(rotation, 1, 2))
        by_lever = np.zeros((count, 6, 3))
        by_lever[:, :3] = scaled @ (turn - np.eye(3))
        return Prediction(
            np.hstack([float(sensor.scale) * translation, residual]),
            by_pose,
            by_velocity,
            by_bias,
            {AIDING_SCALE: by_scale, AIDING_ROTATION: by_mounting, AIDING_POSITION: by_lever},
            by_time=np.hstack([shift @ scaled.T, _times(by_rotation, turning)]),
        )


def relative_pose(
    sensor: AidingSensor, samples: AidingSamples, robust: str | None = None
) -> RelativePose:
    """Return samples of a sensor as a measurement, without the inertial samples it needs."""
    count = len(samples)
    translation = sensor.in_si(samples.value[:, 1:4])
    noise = np.repeat([[sensor.sigma, sensor.rotation_sigma]], 3, axis=1).repeat(count, axis=0)
    way = np.linalg.norm(translation, axis=1, keepdims=True)
    noise[:, :3] = np.hypot(noise[:, :3], sensor.relative_sigma * way)
    return RelativePose(
        epoch=np.arange(count),
        sensor=sensor.name,
        robust=robust,
        value=np.hstack([translation, np.zeros((count, 3))]),
        sigma=noise,
        time_offset=np.full(count, float(sensor.time_offset)),
        inertial_body=np.zeros((count, 6)),
        interval=samples.value[:, 0],
        rotation_measured=Rotation.from_rotvec(samples.value[:, 4:]).as_matrix(),
        noise=noise,
        gravity=0.0,
        rate_begin=np.zeros((count, 3)),
        bias=np.zeros((count, 6)),
        rotated=np.tile(np.eye(3), (count, 1, 1)),
        gained=np.zeros((count, 3)),
        passed=np.zeros((count, 3)),
        by_bias=np.zeros((count, 9, 6)),
    )


def longest_interval(site: Site) -> float:
    """Return how long before a state inertial samples may be needed (s); zero without a sensor."""
    needed = any(sensor.quantity == "relative_pose" for sensor in site.aiding)
    return MAX_INTERVAL + RATE_SPAN if needed else 0.0


def _times(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _of_each(derivative: Callable[[Array], Array], vector: Array) -> Array:
    """Return derivatives on the right at rotation vectors (n, 3), shape (n, 3, 3)."""
    return np.array([derivative(one) for one in vector]).reshape(-1, 3, 3)
