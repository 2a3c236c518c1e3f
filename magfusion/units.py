"""Constants and the type of every numeric array."""

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
AnyArray = npt.NDArray[Any]

MU0_OVER_4PI = 1e-7  # T m / A
MU0 = 4.0 * np.pi * MU0_OVER_4PI  # T m / A
NANOTESLA, MICROTESLA = 1e-9, 1e-6  # T
DEGREE = np.pi / 180.0  # rad
NANOSECOND, HOUR, DAY = 1e-9, 3600.0, 86_400.0  # s
NS_PER_S = 1_000_000_000
STANDARD_GRAVITY = 9.80665  # m/s^2
TINY = 1e-300  # added to, or least value of, a divisor that may be zero

# Rate of states: at the field epochs, at every inertial sample, or a number per second (Hz).
Rate = Literal["field", "imu"] | float
