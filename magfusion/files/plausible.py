"""Samples that no instrument gives in SI units: the mistake of unit that explains them."""

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import ImuSamples
from magfusion.units import Array

LARGEST_FIELD = 1e-3  # T; twenty times the Earth's
LARGEST_RATE = 50.0  # rad/s; beyond the range of common gyroscopes
WEIGHT_IN_G = (0.9, 1.1)  # where gravity is 9.8 m/s^2
# Of the median, what nine in ten samples exceed: of a specific force without gravity half.
LEAST_WEIGHT = 0.6
SHORTEST_STEP = 2e-5  # s; faster than any inertial sensor


def check_imu(imu: ImuSamples, place: str) -> None:
    """Refuse inertial samples that are in deg/s, in g, or whose times are not nanoseconds.

    Raises
    ------
    InputError
        Naming ``place``, what was found and the likely factor.
    """
    rate = float(np.sqrt(np.mean(np.sum(imu.gyro_body**2, axis=1))))
    if rate > LARGEST_RATE:
        raise InputError(
            f"{place}: the angular rate is {rate:.3g} rad/s (RMS), so it is probably in deg/s;"
            " multiply it by pi/180."
        )
    sizes = np.linalg.norm(imu.accel_body, axis=1)
    force, least = (float(np.quantile(sizes, share)) for share in (0.5, 0.1))
    if WEIGHT_IN_G[0] < force < WEIGHT_IN_G[1] and least > LEAST_WEIGHT * force:
        raise InputError(
            f"{place}: the specific force is {force:.3g} m/s^2 (median), so it is probably in g;"
            " multiply it by 9.80665."
        )
    step = float(np.median(np.diff(imu.time))) if len(imu) > 1 else SHORTEST_STEP
    if step < SHORTEST_STEP:
        raise InputError(
            f"{place}: samples are {step:.3g} s apart (median), so that the times are probably"
            " not in nanoseconds; multiply them, by 1000 if they are in microseconds."
        )


def check_field(size: Array, place: str) -> None:
    """Refuse fields of a size (T) that is no beacon's and not the Earth's.

    Raises
    ------
    InputError
        Naming ``place``, what was found and the likely factor.
    """
    field = float(np.median(size)) if len(size) else 0.0
    if field > LARGEST_FIELD:
        raise InputError(
            f"{place}: the field is {field:.3g} T (median), so it is probably in another unit;"
            " divide nanotesla by 1e9, microtesla by 1e6, gauss by 1e4."
        )
