"""User settings of an online estimator."""

from dataclasses import dataclass
from typing import Literal

from magfusion.estimation.batch.preprocessed_log import LONGEST_STEP
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
    lag : float
        Window of the smoother (s).
    delay : float
        Largest delay of samples that are still sorted in (s); states are delayed as much.
    start_duration : float
        Data gathered before the first state (s); longer while they are ambiguous.
    longest_step : float
        Longest time between states without any field (s).
    risk : Risk, optional
        Integrity risk of the protection levels; without it there are none, and updates cost less.
    rate : 'field', 'imu' or float
        Where states are output besides those of the epochs: nowhere, at every inertial sample, or
        at a rate (Hz); they are propagated from the newest epoch.
    horizon : float
        How far ahead they are predicted (s).
    correction_time : float
        Time in which a correction enters them (s); at once where it is zero.
    lost_beyond : float
        Sigma of the position (m) beyond which a platform that detects no beacon is lost.
    """

    __repr__ = short_repr

    estimator: Literal["smoother", "ekf"] = "smoother"
    lag: float = 4.0
    delay: float = 0.0
    start_duration: float = 6.0
    longest_step: float = LONGEST_STEP
    risk: Risk | None = None
    rate: Rate = "field"
    horizon: float = 0.0
    correction_time: float = 0.0
    lost_beyond: float = 1.0
