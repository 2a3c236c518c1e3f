"""Settings of navigation, along a log or from records on standard input."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from magfusion.errors import InputError
from magfusion.jobs.live import LiveSettings
from magfusion.jobs.rates import RateSettings
from magfusion.jobs.region import RegionSettings
from magfusion.jobs.rest_settings import RestSettings
from magfusion.jobs.settings import (
    EarthSettings,
    EstimateSettings,
    ReplayedSettings,
    RiskSettings,
    WindowSettings,
    argument,
    option,
)

if TYPE_CHECKING:
    from magfusion.estimation.online.navigator import NavigatorSettings
    from magfusion.jobs.inputs import Job


PIPE, ROS2 = "-", "ros2:"
OF_A_LOG = {"output", "start", "end", "realtime", "as_json"}
OF_THE_OTHER = {PIPE: {"topics"}, ROS2: {"form"}}


@dataclass(frozen=True, kw_only=True)
class NavigateSettings(
    RegionSettings,
    WindowSettings,
    RestSettings,
    ReplayedSettings,
    EarthSettings,
    EstimateSettings,
    RiskSettings,
    LiveSettings,
    RateSettings,
):
    """Online navigation, along a log or from records on standard input."""

    log: Path = argument(
        "Log to replay, - for records on standard input, or ros2: for topics of ROS 2"
    )
    estimator: Literal["smoother", "ekf"] = option(
        "smoother", "Fixed-lag smoother, or Kalman filter"
    )
    lag: float = option(4.0, "Window of the smoother", unit="s", least=0.5, most=60.0)
    delay: float = option(
        0.0,
        "Maximum delay of samples",
        unit="s",
        least=0.0,
        most=10.0,
        note="states have this latency",
    )
    horizon: float = option(
        0.0,
        "Prediction of states between epochs beyond the inertial samples",
        unit="s",
        least=0.0,
        most=1.0,
    )
    blend: float = option(
        0.0,
        "Time over which a correction is smoothed into states between epochs",
        unit="s",
        least=0.0,
        most=10.0,
        note="0: immediate",
    )
    lost_beyond: float = option(
        1.0,
        "Position sigma beyond which a platform that detects no beacon is lost",
        unit="m",
        above=0.0,
        most=1e4,
    )
    checkpoint: Path | None = option(
        None, "Checkpoint file", note="default: in the output while the job runs"
    )
    every: float = option(30.0, "Interval of checkpoints", unit="s", least=0.1, most=86400.0)
    resume: bool = option(False, "Continue from the checkpoint, if there is one")
    keep_going: bool = option(False, "Count bad records, and skip them")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rate == "field" and (self.horizon or self.blend):
            raise InputError(
                "--horizon and --blend require states between epochs; give --rate imu, or --rate HZ"
            )

    @property
    def is_live(self) -> bool:
        """Whether data arrive while it runs."""
        return str(self.log) in (PIPE, ROS2)

    def live_site(self, given: set[str]) -> Path:
        """Return the site's file of data that arrive while it runs.

        Raises InputError where it is not given, or an option that such data do not have.
        """
        if self.site is None:
            raise InputError(
                f"navigate {self.log} requires the site's file; give it with --site SITE.yaml"
            )
        if given & (OF_A_LOG | OF_THE_OTHER[str(self.log)]):
            other = "--topics" if str(self.log) == PIPE else "--format"
            raise InputError(
                f"--output, --start, --end, {other}, --realtime and --json require another source;"
                f" omit them with {self.log}"
            )
        return self.site

    def navigator(self, job: Job) -> NavigatorSettings:
        """Return the settings of the estimator."""
        from magfusion.estimation.online.navigator import NavigatorSettings

        return NavigatorSettings(
            estimator=self.estimator,
            lag=self.lag,
            delay=self.delay,
            estimate=self.groups,
            earth=self.earth,
            lockin=self.lockin(job),
            risk=self.risks,
            rate=self.rates,
            horizon=self.horizon,
            correction_time=self.blend,
            lost_beyond=self.lost_beyond,
        )
