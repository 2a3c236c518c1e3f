"""What a user chooses of an online estimator."""

from dataclasses import dataclass
from typing import Literal

from magfusion.estimation.batch.prepared import LONGEST_STEP
from magfusion.estimation.batch.settings import EstimatorSettings
from magfusion.model.short_repr import short_repr
from magfusion.model.trust import Risk
from magfusion.units import Rate


@dataclass(frozen=True)
class NavigatorSettings(EstimatorSettings):
    """How to navigate.

    Parameters
    ----------
    estimator : {'smoother', 'ekf'}
    lag : float
        Window of the smoother (s).
    delay : float
        How late samples may come and still be used in their order (s); so much later are states.
    start_duration : float
        Data gathered before the first state (s); longer where they leave it ambiguous.
    longest_step : float
        Without any field a state is made after so long (s).
    risk : Risk, optional
        What the protection levels promise; without it there are none, and an update costs less.
    rate : 'field', 'imu' or float
        Where states are made beside those of the epochs: nowhere, at every inertial sample, or so
        many a second (Hz); they are carried there from the newest epoch.
    horizon : float
        So far ahead of that they are told (s).
    blend : float
        A correction enters them within so long (s); at once where it is zero.
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
    blend: float = 0.0
