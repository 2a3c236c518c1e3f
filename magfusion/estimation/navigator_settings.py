"""What a user chooses of an online estimator."""

from dataclasses import dataclass
from typing import Literal

from magfusion.estimation.prepared import LONGEST_STEP
from magfusion.estimation.settings import EstimatorSettings
from magfusion.model.trust import Risk


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
    """

    estimator: Literal["smoother", "ekf"] = "smoother"
    lag: float = 4.0
    delay: float = 0.0
    start_duration: float = 6.0
    longest_step: float = LONGEST_STEP
    risk: Risk | None = None
