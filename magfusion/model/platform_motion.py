"""Models of the platform's motion and its IMU, and the motion prior without one."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MotionModel:
    """Motion of the platform, and its rest thresholds; the defaults suit a hand."""

    # rest_gyro, rest_accel: at rest, rate (rad/s) and specific force (m/s^2) deviate by less from
    # their means
    rest_gyro: float = 0.03
    rest_accel: float = 0.25
    rest_span: float = 1.0  # minimum duration of rest (s)
    rest_speed_sigma: float = 0.01  # of the zero-velocity update (m/s)
    rest_known_speed: float = 0.1  # a velocity with a larger sigma is not set to zero (m/s)
    speed_sigma: float = 1.0  # usual speed (m/s)
    accel_sigma: float = 1.5  # of the mean specific force against gravity, in motion (m/s^2)
    accel_span: float = 2.0  # averaging time of the specific force (s)
    start_speed_sigma: float = 10.0  # prior of the first velocity (m/s)


A_HAND = MotionModel()


@dataclass(frozen=True)
class ImuModel:
    """Inertial noise: densities per square root of hertz, walks per square root of second.

    A sample stamped t was taken at t + ``time_offset`` on the log's clock; the offset is that of
    the first sample and grows by ``clock_rate``.  ``gyro_range`` (rad/s) and ``accel_range``
    (m/s^2) are the largest values of each axis in size; by default no instrument has larger ones.
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
    gyro_range: float = 6000.0  # a deg/s value of a fast gyroscope, if written for rad/s
    accel_range: float = 1e6  # ten times a shock accelerometer's


@dataclass(frozen=True)
class HeldModel(ImuModel):
    """Model of a motion prior without rotation about an axis, in place of an IMU.

    For a receiver of one axis, whose roll about its coil is unobservable.
    """

    held_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)  # unit vector in body axes


# Default of a site that declares none: nothing is known from it.
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
    """Motion assumed where no IMU measures it: white accelerations."""

    # of the acceleration, each axis (m/s^2/sqrt(Hz)); velocity is its random walk
    accel_density: float = 2.0
    # of the angular acceleration, each axis (rad/s^2/sqrt(Hz)); the rate is its random walk
    angular_accel_density: float = 3.0
    rate_sigma: float = 3.0  # of the initial rate (rad/s)


@dataclass(frozen=True)
class Replaced:
    """Parts of a site that the motion prior replaces, stored to restore them."""

    imu: ImuModel
    motion: MotionModel
    gravity: float
