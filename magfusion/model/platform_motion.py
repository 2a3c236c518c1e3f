"""How the platform moves, what of it an IMU measures, and what is assumed where there is none."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MotionModel:
    """How the platform moves, and what counts as rest; by default that of a hand.

    Parameters
    ----------
    rest_gyro, rest_accel : float
        It rests where rate (rad/s) and specific force (m/s^2) deviate less from their means.
    rest_span : float
        Duration of that (s).
    rest_speed_sigma : float
        Of the zero velocity (m/s).
    rest_known_speed : float
        A velocity with a larger sigma is not taken for zero (m/s).
    speed_sigma : float
        Usual speed (m/s).
    accel_sigma : float
        Of the mean specific force against gravity, in motion (m/s^2).
    accel_span : float
        Over which it is averaged (s).
    start_speed_sigma : float
        Prior of the first velocity (m/s).
    """

    rest_gyro: float = 0.03
    rest_accel: float = 0.25
    rest_span: float = 1.0
    rest_speed_sigma: float = 0.01
    rest_known_speed: float = 0.1
    speed_sigma: float = 1.0
    accel_sigma: float = 1.5
    accel_span: float = 2.0
    start_speed_sigma: float = 10.0


A_HAND = MotionModel()


@dataclass(frozen=True)
class ImuModel:
    """Inertial noise: densities per square root of hertz, walks per square root of second.

    ``time_offset`` says that the sample stamped t was taken at t + offset on the log's clock (s);
    that is of the first sample, and grows by ``clock_rate`` from there on.
    """

    gyro_noise: float
    accel_noise: float
    gyro_bias_walk: float
    accel_bias_walk: float
    gyro_bias_sigma: float
    accel_bias_sigma: float
    time_offset: float = 0.0
    time_offset_sigma: float = 0.01
    clock_rate: float = 0.0
    clock_rate_sigma: float = 5e-5


@dataclass(frozen=True)
class HeldModel(ImuModel):
    """What stands for an IMU by a motion prior that has no rate about an axis.

    Of a receiver of one axis, whose roll about its coil nothing tells.

    Parameters
    ----------
    held_axis : tuple of float
        Body axes, of length one.
    """

    held_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)


# Of a site that describes none: nothing is known by it.
NO_IMU = ImuModel(
    gyro_noise=float("inf"),
    accel_noise=float("inf"),
    gyro_bias_walk=0.0,
    accel_bias_walk=0.0,
    gyro_bias_sigma=0.0,
    accel_bias_sigma=0.0,
    time_offset_sigma=0.0,
    clock_rate_sigma=0.0,
)


@dataclass(frozen=True)
class MotionPrior:
    """What is assumed of the motion where no IMU measures it: white accelerations.

    Parameters
    ----------
    accel_density : float
        Of the acceleration, each axis (m/s^2/sqrt(Hz)): velocity walks by it.
    angular_accel_density : float
        Of the angular acceleration, each axis (rad/s^2/sqrt(Hz)): the rate walks by it.
    rate_sigma : float
        Of the rate at the beginning (rad/s).
    """

    accel_density: float = 2.0
    angular_accel_density: float = 3.0
    rate_sigma: float = 3.0


@dataclass(frozen=True)
class Replaced:
    """What of a site stands aside while the motion prior is in its place."""

    imu: ImuModel
    motion: MotionModel
    gravity: float
