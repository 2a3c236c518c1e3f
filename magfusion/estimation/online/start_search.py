"""The search for a navigator's first state: when to try, and which result to accept."""

from dataclasses import replace

from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.state import State
from magfusion.estimation.initialization.earlier_state import with_earlier
from magfusion.estimation.initialization.early import (
    first_try,
    is_clear,
    is_open,
    next_try,
    open_start,
)
from magfusion.estimation.initialization.online import NoStart, OnlineStart
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.estimation.online.queue.arrivals import Arrivals
from magfusion.model.parameters import Block
from magfusion.model.site import Site

MARGIN = 0.5  # s; of a span that a start uses
MAX_START_DURATIONS = (
    4.0  # durations of a start; as much is kept, and an open hypothesis waits so long
)


class StartSearch:
    """Attempts at a first state, each on more data than the one before.

    `needed`: duration of data before the next attempt (s). `why`: why there is no state yet.
    `earlier`: whose biases and calibration the first state takes over.
    """

    needed: float
    why: NoStart
    earlier: State | None

    def __init__(self, site: Site, settings: NavigatorSettings) -> None:
        self._site, self._settings = site, settings
        self.needed = first_try(site, settings.start_duration)
        self.why, self.earlier = NoStart(), None

    def wait_for(self, span: float) -> None:
        """Start on all input that is to come within some seconds, a span (s)."""
        self.needed = max(self.needed, span - MARGIN)

    def attempt(self, arrived: Arrivals, *, diagnose: bool) -> OnlineStart | NoStart | None:
        """Return the result of an attempt; None as long as there are too few data."""
        until = arrived.gathered(self._settings.delay, self.needed)
        if until is None:
            return None
        return arrived.first_state(until, self._settings, diagnose=diagnose)

    def accepted(self, start: OnlineStart | NoStart, arrived: Arrivals) -> OnlineStart | None:
        """Return a start that is clear enough; otherwise note why not, and when to try again."""
        usual, several = self._settings.start_duration, len(self._site.beacons) > 1
        early, later = self.needed < usual, next_try(self.needed, usual)
        if early and not is_clear(start, several=several, last=later >= usual):
            if isinstance(start, OnlineStart) and start.ambiguous:
                self.why = open_start(start)
            self.needed = later
            return None
        if isinstance(start, NoStart):
            self.why = replace(start, corrections=())  # tried at once; a checkpoint has none
            self.needed *= 2.0 if start.trust.findings else 1.5
            arrived.limit_history(MAX_START_DURATIONS * usual)
            return None
        if is_open(start) and self.needed < MAX_START_DURATIONS * usual:
            self.why = open_start(start)
            self.needed += 0.5 * usual
            return None
        return start

    def with_earlier(
        self, start: OnlineStart, estimated: tuple[Block, ...], noise: ProcessNoise
    ) -> OnlineStart:
        """Return a start with the biases and calibration of the earlier state, if there is one."""
        if self.earlier is None:
            return start
        state = with_earlier(start.state, self.earlier, self._site, estimated, noise)
        self.earlier = None
        return replace(start, state=state)
