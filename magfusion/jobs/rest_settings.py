"""Options of the jobs that integrate whole rests."""

from dataclasses import dataclass

from magfusion.estimation.rests.stationary_integration import IntegratedRests, integrate_rests
from magfusion.jobs.settings import Settings, option
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.receiver.windows import LockinSettings


@dataclass(frozen=True, kw_only=True)
class RestSettings(Settings):
    """Whether whole rests are integrated."""

    at_rest: bool = option(
        False, "Make one epoch of each rest, of any length, for beacons far below the noise"
    )
    false_alarm: float = option(
        1e-3, "With --at-rest: false-alarm probability per rest and beacon", least=1e-9, most=0.1
    )

    def integrated(
        self, log: Log, site: Site, lockin: LockinSettings | None, least: int = 1
    ) -> IntegratedRests | None:
        """Return the requested rests of a log; None if not requested.

        `least`: minimum number of epochs.
        """
        if not self.at_rest:
            return None
        return integrate_rests(log, site, lockin, self.false_alarm, least)
