"""From the complete data of a navigator to the states that it reports, epoch by epoch."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.graph.state import State
from magfusion.estimation.integrity.correction import Correction, continued, corrections, spread_of
from magfusion.estimation.online.applied_corrections import AppliedCorrections
from magfusion.estimation.online.epoch_update import Estimator
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.estimation.online.next_epoch import NextEpoch, TooLate, next_epoch
from magfusion.estimation.online.queue.arrivals import Arrivals
from magfusion.estimation.online.queue.of_site import arrivals_of
from magfusion.estimation.online.running_estimate import RunningEstimate
from magfusion.estimation.online.start_search import StartSearch
from magfusion.estimation.online.state_of_now import EpochReport, StateOfNow
from magfusion.estimation.online.state_reports import StateReports
from magfusion.estimation.online_integrity.judgement import JudgedState
from magfusion.files.plain_data import Rules, from_plain, resume, to_plain
from magfusion.model.site import Site
from magfusion.model.trust import Verdict


class EstimationLoop:
    """The parts of a navigator, and the order in which they process its data.

    Attributes: `possible`: what may be wrong with the site, the most likely first. `tried`: which
    the site includes on trial. `remainder`: of a corrected parameter, by what it still seems to be
    wrong.
    """

    arrived: Arrivals
    running: RunningEstimate
    search: StartSearch
    reports: StateReports
    now: StateOfNow
    corrections: AppliedCorrections  # mistakes of the declared site that are undone
    rival_chi_square: float | None  # as of `magfusion.estimation.initialization.online.OnlineStart`

    def __init__(self, site: Site, settings: NavigatorSettings) -> None:
        self.site, self.settings = site, settings
        self.running = RunningEstimate(site, settings)
        # Short windows contain no static field.
        self.arrived = arrivals_of(site, settings.lockin, short=not settings.earth)
        self.search = StartSearch(site, settings)
        self.reports = StateReports(lagged=settings.estimator == "smoother")
        self.now = StateOfNow(settings)
        self.rival_chi_square = None
        self.corrections = AppliedCorrections()
        self.possible: tuple[Correction, ...] = ()
        self.tried: Correction | None = None
        self.remainder: Correction | None = None

    @property
    def is_lost_repeatedly(self) -> bool:
        """Whether inertial data lead away from the fields again and again."""
        return any(finding.code == "restarts" for finding in self.reports.judgement.reasons)

    @property
    def counts(self) -> Counter[str]:
        """Numbers of rejections, losses and recoveries, by reason."""
        return self.running.update.gate.counts

    def advance(self) -> None:
        """Process all complete data."""
        changed = self.running.estimator is None and self._begin()
        while self._step():
            changed = True
        if changed:
            self.restart_propagation()

    def restart_propagation(self) -> None:
        """Propagate the newest estimate from here on."""
        imu, reports = self.arrived.imu, self.reports
        report = EpochReport(reports.judgement, reports.reset_counter, self.running.update.bank)
        self.now.restart_from(self.running.propagation_start(imu), report, imu)

    def plain_estimator(self, rules: Rules) -> Any:
        """Return the estimator as plain data, after all that was postponed has been computed."""
        self.arrived.settle()
        self.running.update.score.settle()
        return to_plain(self.running.estimator, rules)

    def resume_estimator(self, data: Any, rules: Rules) -> None:
        """Load the estimator of `plain_estimator`."""
        state = data.get("state") if isinstance(data, dict) else None
        self.running.start_at(from_plain(State, state, "estimator.state", rules))
        resume(self.running.estimator, data, "estimator", rules)
        self.restart_propagation()

    def _begin(self) -> bool:
        """Find the first state, once enough data have arrived."""
        search, running = self.search, self.running
        attempt = search.attempt(self.arrived, diagnose=self.tried is None)
        if attempt is None:
            return False
        self.possible = attempt.corrections
        start = search.accepted(attempt, self.arrived)
        if start is None:
            return False
        start = search.with_earlier(start, running.estimated, running.process_noise)
        running.begin(start, self.arrived.imu)
        self.arrived.start(start, self.settings.delay)
        self.rival_chi_square = start.rival_chi_square
        if self.tried is not None:
            self.corrections.widen(spread_of(self.tried, start.score)[-1])
            self.remainder = continued(self.tried, start.score)
        self.reports.summary.unverified = start.trust.unverified
        doubted = self.corrections.doubted(running.update.begin(start))
        self.reports.store(start.state, doubted)
        return True

    def _step(self) -> bool:
        """Process the next epoch, if all its data have arrived."""
        running = self.running
        if running.estimator is None:
            return False
        separate = running.update.recovery.needs_separate_beacons
        epoch = next_epoch(self.arrived, running.estimator.state, self.settings, separate)
        if isinstance(epoch, TooLate):
            self.counts[epoch.reason] += epoch.number
        elif epoch is not None:
            self._process(running.estimator, epoch)
        return epoch is not None

    def _process(self, estimator: Estimator, epoch: NextEpoch) -> None:
        """Propagate to an epoch, process its measurements, and report its state."""
        predicted, judgement = self.running.process(epoch.time, epoch.samples, self.arrived)
        score = self.running.update.score
        aiding, known = self.running.update.aiding, score.correction
        known = None if known is None or aiding.is_early(known) else known
        of_aiding = corrections(self.site, (), (), aiding.diagnosis)
        if known is not None or score.is_steel or of_aiding:
            self.possible = (*of_aiding, *(() if known is None else (known,)))
        self.corrections.drop_refuted(score)
        state: State = estimator.state
        reports, counts = self.reports, self.counts
        restarts = counts["lost and found again"]
        if self.site.platform.inertial:  # a motion prior may be uncertain, with regular fixes
            restarts += counts["found by a fix"]
        jumps = reports.discontinuities
        jumps.update(predicted.state, state, reports.judgement, judgement, restarts)
        reports.store(state, self.corrections.doubted(judgement))
        lag = self.arrived.imu.reapply_offset(state, self.running.blocks)
        if lag:
            estimator.replace_state(replace(state, time=state.time + lag))
            counts["time offset updated"] += 1
        self.arrived.discard_before(self.running.time)

    # Output

    def state_at(self, time: float | None) -> JudgedState:
        """Return the state at a time (s), as `Navigator.state`."""
        if self.running.estimator is None:
            raise EstimationError("there is no state yet: the navigator is still gathering data")
        last, imu = self.running.estimator.state, self.arrived.imu
        wanted = imu.reached if time is None else time
        return (
            self.reports.with_judgement(last) if wanted <= last.time else self.now.at(imu, wanted)
        )

    def take_lagged(self) -> list[JudgedState]:
        """Return the states that left the smoother's window since the last call."""
        window = self.running.estimator
        if not isinstance(window, SlidingWindow):
            return []
        outgoing, window.outgoing = window.outgoing, []
        return [self.reports.with_own_judgement(state) for state in outgoing]

    @property
    def losses(self) -> dict[str, int]:
        """All rejections, losses and recoveries by reason: `counts`, windows, samples."""
        window = self.running.estimator
        dropped = window.dropped if isinstance(window, SlidingWindow) else 0
        of_factors = {"factors dropped": dropped} if dropped else {}
        return {**self.counts, **of_factors, **self.arrived.losses}

    # After another

    def follow(self, earlier: "EstimationLoop") -> None:
        """Start again after another: with its reports, and what a trustworthy state knew."""
        reports, known = earlier.reports, earlier.running.estimator
        self.reports.discontinuities, self.reports.summary = (
            reports.discontinuities,
            reports.summary,
        )
        self.reports.discontinuities.counter += known is not None
        self.counts.update(earlier.counts)
        self.counts["started again"] += 1
        corrected = bool(earlier.corrections.findings)
        if known is None:
            self.search.earlier = earlier.search.earlier
        elif reports.judgement.verdict is Verdict.TRUSTWORTHY and not corrected:
            self.search.earlier = _on_site(known.state, self.site)

    def try_correction(
        self, correction: Correction, earlier: "EstimationLoop", declared: Site, span: float
    ) -> None:
        """Prepare a trial of a corrected site, for the newest input of another loop.

        `declared`: without any correction. `span`: duration of that input (s).
        """
        reports = earlier.reports
        reasons = (*reports.judgement.reasons, *earlier.search.why.trust.reasons)
        self.tried = correction
        self.corrections = earlier.corrections.further(correction, declared, reasons)
        self.reports.discontinuities.counter = reports.reset_counter + (reports.until > -np.inf)
        self.search.wait_for(span)


def _on_site(state: State, site: Site) -> State:
    """Return a state whose calibration shares the readings of temperature and current of a site."""
    shared = replace(state.calibration.site, temperatures=site.temperatures, drives=site.drives)
    return replace(state, calibration=replace(state.calibration, site=shared))
