"""User settings of an online estimator."""

from dataclasses import dataclass
from typing import Literal

from magfusion.estimation.batch.preprocessed_log import MAX_STEP
from magfusion.estimation.batch.settings import EstimatorSettings
from magfusion.model.short_repr import short_repr
from magfusion.model.trust import Risk
from magfusion.units import Rate


@dataclass(frozen=True)
class NavigatorSettings(EstimatorSettings):
    """Settings of a navigator.

    Parameters
    ----------
    estimator : {'smoother', 'ekf'}
        Fixed-lag smoother (default), or iterated extended Kalman filter.
    lag : float
        Lag of the smoother (s); 4 by default. The filter ignores it.
    delay : float
        Largest delay of samples that are still sorted in (s); states are delayed as much. 0 by
        default.
    start_duration : float
        Data gathered before the first state (s); longer while they are ambiguous. 6 by default; a
        third of it for a tracker whose side is undeclared, and for a receiver without static field.
    longest_step : float
        Longest time between states without any field (s); 5 by default.
    risk : Risk, optional
        Integrity risk of the protection levels; without it (default) there are none, and updates
        cost less.
    rate : 'field', 'imu' or float
        Where states are output besides those of the epochs: nowhere (default), at every inertial
        sample, or at a rate (Hz); they are propagated from the newest epoch.
    horizon : float
        How far ahead they are predicted (s); 0 by default.
    correction_time : float
        Time in which a correction enters them (s); at once where it is zero (default).
    lost_beyond : float
        Sigma of the position (m) beyond which a platform that detects no beacon is lost; 1 by
        default.

    Notes
    -----
    The other fields are those of `EstimatorSettings`: ``estimate``, ``lockin``, ``earth`` and
    ``parameters``.
    """

    __repr__ = short_repr

    estimator: Literal["smoother", "ekf"] = "smoother"
    lag: float = 4.0
    delay: float = 0.0
    start_duration: float = 6.0
    longest_step: float = MAX_STEP
    risk: Risk | None = None
    rate: Rate = "field"
    horizon: float = 0.0
    correction_time: float = 0.0
    lost_beyond: float = 1.0
