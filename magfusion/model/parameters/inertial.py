"""Parameters of the inertial sensors that no estimator has: only tests of an estimate see them."""

from typing import ClassVar, NamedTuple

import numpy as np

from magfusion.model.parameters.parameter import AXES, DEGREES, PERCENT, Parameter, ParameterUnit
from magfusion.model.perturbation import skew
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.units import Array


class Stream(NamedTuple):
    """What a parameter of the inertial sensors is seen by."""

    imu: ImuSamples
    world_from_body: Array  # (states, 3, 3)


class Inertial(Parameter):
    """A parameter that acts on the inertial stream as a bias that changes would."""

    owner = "imu"
    group = "inertial"
    size: ClassVar[int] = 3
    of_states: ClassVar[bool] = False  # whether it is told between states, not at samples

    def sigma(self, site: Site, owner: str) -> Array:
        """Return zeros: no site declares it."""
        return np.zeros(self.size)

    def as_bias(self, stream: Stream) -> Array:
        """Return what bias a unit of it looks like, shape (samples or states - 1, 6, columns).

        Accelerometer, then gyro (m/s^2, rad/s), at each sample or already between the states.
        """
        raise NotImplementedError


class Bias(Inertial):
    """A constant bias: the states have one, which its declared sigma keeps near zero."""

    columns: ClassVar[slice]

    def as_bias(self, stream: Stream) -> Array:
        """Return ones in its own rows."""
        return np.broadcast_to(np.eye(6)[:, self.columns], (len(stream.imu), 6, 3))


class _GyroBias(Bias):
    kind, components, display_unit = "gyro_bias", AXES, ParameterUnit("rad/s", 1.0)
    words, columns = "the bias of the gyro's {axis}", slice(3, 6)


class _AccelBias(Bias):
    kind, components, display_unit = "accel_bias", AXES, ParameterUnit("m/s^2", 1.0)
    words, columns = "the bias of the accelerometer's {axis}", slice(0, 3)


class _GyroScale(Inertial):
    kind, components, display_unit = "gyro_scale", AXES, PERCENT
    words = "the scale of the gyro's {axis}"

    def as_bias(self, stream: Stream) -> Array:
        return _stacked(
            np.zeros((len(stream.imu), 3, 3)), stream.imu.gyro_body[:, :, None] * np.eye(3)
        )


class _AccelScale(Inertial):
    kind, components, display_unit = "accel_scale", AXES, PERCENT
    words = "the scale of the accelerometer's {axis}"

    def as_bias(self, stream: Stream) -> Array:
        return _stacked(
            stream.imu.accel_body[:, :, None] * np.eye(3), np.zeros((len(stream.imu), 3, 3))
        )


class _GyroAlignment(Inertial):
    kind, components, display_unit = "gyro_alignment", AXES, DEGREES
    words = "the turn of the gyro against the accelerometer about {axis}"

    def as_bias(self, stream: Stream) -> Array:
        # Each unit turn across the rate is a column.
        return _stacked(np.zeros((len(stream.imu), 3, 3)), -skew(stream.imu.gyro_body))


class _GyroGSensitivity(Inertial):
    kind, components = "gyro_g_sensitivity", tuple(a + b for a in AXES for b in AXES)
    display_unit = ParameterUnit("rad/s per m/s^2", 1.0)
    words = tuple(f"the gyro's {a} per specific force along {b}" for a in AXES for b in AXES)
    size = 9

    def as_bias(self, stream: Stream) -> Array:
        force = stream.imu.accel_body[:, None, None, :] * np.eye(3)[:, :, None]
        return _stacked(np.zeros((len(force), 3, 9)), force.reshape(len(force), 3, 9))


class _Gravity(Inertial):
    owner, kind, display_unit = "site", "gravity", ParameterUnit("m/s^2", 1.0)
    words, size, of_states = "the size of gravity", 1, True

    def as_bias(self, stream: Stream) -> Array:
        up_body = 0.5 * (stream.world_from_body[1:, 2] + stream.world_from_body[:-1, 2])
        # More gravity than declared is a specific force upwards, as a bias of it would be.
        return _stacked(up_body[:, :, None], np.zeros((len(up_body), 3, 1)))


def _stacked(accel: Array, gyro: Array) -> Array:
    return np.concatenate([accel, gyro], axis=1)


GYRO_SCALE, ACCEL_SCALE, GYRO_ALIGNMENT = _GyroScale(), _AccelScale(), _GyroAlignment()
GYRO_G_SENSITIVITY, GRAVITY = _GyroGSensitivity(), _Gravity()
GYRO_BIAS, ACCEL_BIAS = _GyroBias(), _AccelBias()
INERTIAL: tuple[Inertial, ...] = (
    GYRO_BIAS,
    ACCEL_BIAS,
    GYRO_SCALE,
    ACCEL_SCALE,
    GYRO_ALIGNMENT,
    GYRO_G_SENSITIVITY,
    GRAVITY,
)
