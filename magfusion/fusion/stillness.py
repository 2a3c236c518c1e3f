"""Whether a moving estimate may be told that the platform stands."""

import numpy as np

from magfusion.fusion.state import VELOCITY, State
from magfusion.strapdown import resting
from magfusion.units import Array

REST_SIGMA = 0.01  # m/s; of a velocity that is none
KNOWN_SPEED = 0.1  # m/s; a velocity less well known is not called none
REST_SPAN = 1.0  # s
REST_GATE = 30.7  # chi square of three components, one in a million: days have many rests
LONGEST_SILENCE = 0.1  # s; a gap looks quiet
REACH = 0.1  # s, beyond the span, that the samples should cover


def stands(state: State, time: Array, gyro_body: Array, accel_body: Array, stamp: float) -> bool:
    """Tell whether the IMU is quiet and nothing that is known says that the platform moves.

    A slow steady motion is as quiet: the velocity decides, and one that nobody knows contradicts
    nothing.

    Parameters
    ----------
    state : State
    time, gyro_body, accel_body : ndarray
        Inertial samples of the last `REST_SPAN` and a little more.
    stamp : float
        Of the state on the IMU's clock (s).
    """
    if len(time) < 10 or time[0] > stamp - REST_SPAN or time[-1] < stamp - REACH:
        return False
    known = np.max(np.diag(state.cov)[VELOCITY]) < KNOWN_SPEED**2
    if not known or np.max(np.diff(time)) > LONGEST_SILENCE:
        return False
    still = resting(time, gyro_body, accel_body, REST_SPAN - REACH)
    if not still[np.searchsorted(time, stamp - REST_SPAN / 2)]:
        return False
    spread = state.cov[VELOCITY, VELOCITY] + REST_SIGMA**2 * np.eye(3)
    velocity = state.velocity_world
    return bool(velocity @ np.linalg.solve(spread, velocity) < REST_GATE)
