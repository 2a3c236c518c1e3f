"""Samples that no instrument gives in SI units: the mistake of unit that explains them."""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.model.magnetometer import Magnetometer
from magfusion.model.platform_motion import ImuModel
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Platform
from magfusion.units import Array, BoolArray

MAX_FIELD = 1e-3  # T; twenty times the Earth's
MAX_RATE = 50.0  # rad/s; beyond the range of common gyroscopes
FASTEST_RATE = 80.0  # rad/s; beyond the range of any
MAX_RATE_IN_DEGREES = ImuModel.gyro_range  # deg/s, and as much written for rad/s
MAX_FORCE = 1e4  # m/s^2
# A sample beyond these is no measurement, in whatever unit.
_MAX_SAMPLES = {  # by the number of columns
    6: np.repeat([ImuModel.gyro_range, ImuModel.accel_range], 3),
    **dict.fromkeys((1, 2, 3), np.array(Magnetometer.field_range)),
}
RANGE_ROUNDING = 1e-4  # of a range: its written decimals, and the missing code of 16 bits, 3e-5
RANGE_KEYS = {  # by the name of the instrument
    "gyroscope": "imu.gyro_range_rad_s",
    "accelerometer": "imu.accel_range_m_s2",
    "magnetometer": "magnetometer.range_t",
}
SOUND = 0.98  # of the samples, by size
CHECKED_DURATION = 2.0  # s
MAX_TEST_SAMPLES = 20_000  # samples
ONE_WAY = 0.9  # length of the mean of directions that are one
WEIGHT_IN_G = (0.9, 1.1)  # where gravity is 9.8 m/s^2
# Of the median, what nine in ten samples exceed: of a specific force without gravity half.
MIN_WEIGHT = 0.6
MIN_STEP = 2e-5  # s; faster than any inertial sensor


def beyond_range(values: Array) -> BoolArray:
    """Return which rows no instrument measures, shape (n,): a bit error in a number's exponent.

    `values` (n, columns): rate and specific force (rad/s, m/s^2), or up to three components of a
    field (T); of other columns no range is known.
    """
    largest = _MAX_SAMPLES.get(values.shape[1], np.array(np.inf))
    return np.asarray((np.abs(values) > largest).any(axis=1))


def declared_range(instrument: str, platform: Platform, name: str | None = None) -> float:
    """Return the range of an instrument, named as in `RANGE_KEYS`; infinite if none is declared.

    `name`: of one of several magnetometers.
    """
    if instrument == "magnetometer":
        every = {sensor.name: sensor for sensor in platform.magnetometers}
        own = every.get(name or "", platform.magnetometer)
        largest, usual = own.field_range, Magnetometer.field_range
    else:
        imu = platform.imu if platform.replaced is None else platform.replaced.imu
        largest, usual = imu.accel_range, ImuModel.accel_range
        if instrument == "gyroscope":
            largest, usual = imu.gyro_range, ImuModel.gyro_range
    return largest if largest < usual else np.inf


def exceeds(values: Array, largest: float) -> BoolArray:
    """Return which rows (n, axes) are beyond a declared range, shape (n,)."""
    return np.asarray((np.abs(values) > largest * (1.0 + RANGE_ROUNDING)).any(axis=1))


def reaches(values: Array, largest: float) -> BoolArray:
    """Return which values are at the end of a declared range, or beyond, in their shape."""
    return np.asarray(np.abs(values) >= largest * (1.0 - RANGE_ROUNDING))


def check_imu(imu: ImuSamples, place: str) -> None:
    """Refuse inertial samples that are in deg/s, in g, or whose times are not nanoseconds.

    Raises InputError naming ``place``, what was found and the likely factor.
    """
    # A few false samples are not the unit's fault.
    turning = np.sum(imu.gyro_body**2, axis=1)
    turning = turning[turning <= np.quantile(turning, SOUND)]
    rate, changes = float(np.sqrt(np.mean(turning))), bool(np.ptp(turning) > 0.0)
    fast = rate > FASTEST_RATE or (rate > MAX_RATE and not _keeps_its_direction(imu))
    if fast and rate < MAX_RATE_IN_DEGREES and changes:
        raise InputError(
            f"{place}: the angular rate is {rate:.3g} rad/s (RMS), so it is probably in deg/s;"
            " multiply it by pi/180."
        )
    if rate > FASTEST_RATE:
        raise InputError(
            f"{place}: the angular rate is {rate:.3g} rad/s (RMS), which no gyroscope measures;"
            " repair the sensor, or give its rates in rad/s."
        )
    sizes = np.linalg.norm(imu.accel_body, axis=1)
    force, least = (float(np.quantile(sizes, share)) for share in (0.5, 0.1))
    if force > MAX_FORCE:
        raise InputError(
            f"{place}: the specific force is {force:.3g} m/s^2 (median), which no accelerometer"
            " measures; repair the sensor, or give it in m/s^2."
        )
    in_g = WEIGHT_IN_G[0] < force < WEIGHT_IN_G[1] and least > MIN_WEIGHT * force
    if in_g and _keeps_its_direction(imu):
        raise InputError(
            f"{place}: the specific force is {force:.3g} m/s^2 (median), so it is probably in g;"
            " multiply it by 9.80665."
        )
    step = float(np.median(np.diff(imu.time))) if len(imu) > 1 else MIN_STEP
    if step < MIN_STEP:
        raise InputError(
            f"{place}: samples are {step:.3g} s apart (median), so that the times are probably"
            " not in nanoseconds; multiply them, by 1000 if they are in microseconds."
        )


def _keeps_its_direction(imu: ImuSamples) -> bool:
    """Return whether the specific force points one way in the world, as gravity does.

    Over spans so short that the gyroscope gives the rotation of the body in them: without gravity
    an acceleration of a g's tenth turns with the motion that makes it.
    """
    step = np.diff(imu.time, append=imu.time[-1:])
    step[step > CHECKED_DURATION] = 0.0
    count = max(1, int(CHECKED_DURATION / max(float(np.median(step)), MIN_STEP)))
    if len(imu) < 2 * count:
        return True  # too little to contradict the size
    ahead: list[Array] = []
    firm: list[float] = []
    world_from_body = np.eye(3)
    for k in range(min(len(imu), MAX_TEST_SAMPLES)):
        if k % count == 0:
            if ahead:
                firm.append(float(np.linalg.norm(np.mean(ahead, axis=0))))
            world_from_body, ahead = np.eye(3), []
        force = imu.accel_body[k]
        ahead.append(world_from_body @ force / max(float(np.linalg.norm(force)), 1e-12))
        world_from_body = (
            world_from_body @ Rotation.from_rotvec(imu.gyro_body[k] * step[k]).as_matrix()
        )
    return float(np.median(firm)) > ONE_WAY


def check_field(size: Array, place: str) -> None:
    """Refuse fields of a size (T) that is no beacon's and not the Earth's.

    Raises InputError naming ``place``, what was found and the likely factor.
    """
    field = float(np.median(size)) if len(size) else 0.0
    if field > MAX_FIELD:
        raise InputError(
            f"{place}: the field is {field:.3g} T (median), so it is probably in another unit;"
            " divide nanotesla by 1e9, microtesla by 1e6, gauss by 1e4."
        )
