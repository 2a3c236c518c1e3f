"""Navigation as the data arrive: one interface for the fixed-lag smoother and the filter.

`Navigator` reads no files.  It takes samples as they arrive; it returns a state at every field
epoch, and on request at any later time.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.stream_buffer import LARGEST_JUMP, check_clock
from magfusion.estimation.demodulation.drive_reference import drive_findings
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.state import State
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.initialization.online import NoStart
from magfusion.estimation.integrity.correction import Correction, continued, spread_of
from magfusion.estimation.measurements.earth import check_earth
from magfusion.estimation.measurements.factor_of_state import state_factor
from magfusion.estimation.online.applied_corrections import AppliedCorrections
from magfusion.estimation.online.epoch_update import Estimator
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.online.input_history import InputHistory
from magfusion.estimation.online.navigator_data import navigator_rules
from magfusion.estimation.online.navigator_settings import NavigatorSettings as NavigatorSettings
from magfusion.estimation.online.next_epoch import NextEpoch, TooLate, next_epoch
from magfusion.estimation.online.queue.arrivals import Arrivals
from magfusion.estimation.online.queue.of_site import arrivals_of
from magfusion.estimation.online.running_estimate import RunningEstimate
from magfusion.estimation.online.start_search import StartSearch
from magfusion.estimation.online.state_of_now import EpochReport, PropagatedState, StateOfNow
from magfusion.estimation.online.state_reports import StateReports
from magfusion.estimation.online_integrity.judgement import (
    JudgedState,
    Judgement,
)
from magfusion.estimation.online_integrity.summary import Summary
from magfusion.files.blas_threads import warn_about_threads
from magfusion.files.plain_data import Rules, from_plain, resume, to_plain
from magfusion.model.aiding import AidingSamples
from magfusion.model.arguments import check_arguments
from magfusion.model.drive import DriveSamples, DriveShares
from magfusion.model.marks import Marks
from magfusion.model.platform_motion import NO_IMU
from magfusion.model.samples import FieldSamples, SteadyFields
from magfusion.model.site import Site
from magfusion.model.temperature import Temperatures
from magfusion.model.trust import Finding, Verdict
from magfusion.model.without_imu import on_motion_prior, require_motion_prior
from magfusion.receiver.drive import DriveReceiver
from magfusion.units import Array, IntArray

MARGIN = 0.5  # s; of a span that a start uses


class Navigator:
    """A running estimate of the platform's motion.

    Attributes
    ----------
    declared : Site
        As given, without the corrections of ``site``.
    remainder : Correction, optional
        Of a corrected parameter, by what it still seems to be wrong.

    Raises
    ------
    TypeError
        If the first argument is no site.
    InputError
        If the Earth field is to be measured but the site declares none.
    """

    # Contents of a checkpoint, besides the estimator.
    _arrived: Arrivals
    _running: RunningEstimate
    _search: StartSearch
    _reports: StateReports
    _now: StateOfNow
    _degrees: Temperatures
    _drives: DriveShares
    _currents: DriveReceiver
    rival_chi_square: float | None
    _corrections: AppliedCorrections

    def __init__(self, site: Site, settings: NavigatorSettings | None = None) -> None:
        check_arguments("Navigator", site=(site, Site))
        warn_about_threads()
        if site.platform.imu == NO_IMU:
            site = on_motion_prior(site)
        require_motion_prior(site)
        # A copy of its own: no other navigator shares its future readings.
        known = site.temperatures
        self._degrees = Temperatures(None if known is None else known.readings)
        currents = None if site.drives is None else site.drives.readings
        self._drives = DriveShares(currents)
        site = replace(site, temperatures=self._degrees, drives=self._drives)
        self._currents = DriveReceiver(site, self._drives)
        self.site = self.declared = site
        self.settings = settings = NavigatorSettings() if settings is None else settings
        if settings.earth:
            check_earth(site)
        self._running = RunningEstimate(site, settings)
        self.blocks = self._running.blocks
        # Short windows contain no static field.
        self._arrived = arrivals_of(site, settings.lockin, short=not settings.earth)
        self._search = StartSearch(site, settings)
        self._reports = StateReports(lagged=settings.estimator == "smoother")
        self._now, self._history = StateOfNow(settings), InputHistory()
        self.rival_chi_square = None
        self._corrections = AppliedCorrections()
        self._possible: tuple[Correction, ...] = ()
        self._tried: Correction | None = None
        self.remainder: Correction | None = None

    # Input

    def add_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Add inertial samples: times (k,), rates and specific forces (k, 3).

        Raises
        ------
        InputError
            If a number is not finite, the clock jumped, or the site describes no IMU.
        """
        self.propagate_imu(time, gyro_body, accel_body)
        self.advance()

    def propagate_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Add inertial samples as `add_imu`, and only propagate the state to them.

        `advance` does what takes longer, so that the current state need not wait for it.
        """
        if not self.site.platform.inertial:
            raise InputError(
                "imu: the site declares a motion prior instead of an IMU; describe platform.imu, or"
                " drop the inertial samples"
            )
        self._arrived.add_imu(time, gyro_body, accel_body)
        self._history.add(time, "propagate_imu", time, gyro_body, accel_body)
        self._now.reach(self._arrived.imu)

    def add_magnetometer(
        self, time: Array, measured_sensor: Array, magnetometer: str | None = None
    ) -> None:
        """Add raw samples of a magnetometer: times (k,), fields (k, 3) (T).

        Columns of axes that the site does not declare are ignored.

        Parameters
        ----------
        magnetometer : str, optional
            Name of one of several, which stamps its own samples.

        Raises
        ------
        InputError
            If a number is not finite, the clock jumped, or the site has no such magnetometer.
        """
        given = time, measured_sensor, magnetometer
        self._arrived.add_magnetometer(*given)
        self._history.add(self.site.platform.on_drive_clock(time), "add_magnetometer", *given)
        self._advance_with_motion_prior()

    def add_drive(self, samples: DriveSamples) -> None:
        """Add currents of coils, before the magnetometer samples of the same time.

        Raises
        ------
        InputError
            As `magfusion.receiver.drive.DriveReceiver`.
        """
        self._currents.push(samples)
        self._drives.discard_old()
        self._running.update.of_currents = tuple(drive_findings(self._currents, self.site))

    def add_marks(self, marks: Marks) -> None:
        """Add bursts of coils with marked slots, with their samples or up to 0.5 s later.

        Raises
        ------
        InputError
            If they do not follow the previous ones, a slot is of no coil, or the clock jumped.
        """
        self._arrived.add_marks(marks)
        self._history.add(marks.end, "add_marks", marks)
        self.advance()

    def add_slots(self, time: Array, slot: IntArray) -> None:
        """Add the driven slot of each sample (k,), before the samples themselves.

        ``magfusion.model.marks.SILENT`` where none is driven, ``UNKNOWN_SLOT`` where it is unknown.

        Raises
        ------
        InputError
            As `add_marks`.
        """
        self._arrived.add_slots(time, slot)
        self._history.add(time, "add_slots", time, slot)

    def add_temperature(self, part: str, time: float, degc: float) -> None:
        """Set the temperature of a beacon, or of the ``magnetometer``, for later samples."""
        self._degrees.add_reading(part, time, degc)

    def add_fields(self, samples: FieldSamples, steady: SteadyFields | None = None) -> None:
        """Add demodulated phasors, channels in the site's order, with their static fields.

        Raises
        ------
        InputError
            If the clock jumped.
        """
        steady_used = steady if self.settings.earth else None
        late = self._arrived.add_fields(samples, steady_used, self.time)
        if late:
            self.counts["field too late"] += late
        self._history.add(samples.time, "add_fields", samples, steady)
        self._advance_with_motion_prior()

    def _advance_with_motion_prior(self) -> None:
        if not self.site.platform.inertial:  # the fields have advanced it
            self._now.reach(self._arrived.imu)
        self.advance()

    def add_measurement(self, time: float, measurement: Measurement) -> None:
        """Add any other measurement of one epoch: a state is created at its time (s).

        It bypasses the gate; it may have a robust loss of its own.

        Raises
        ------
        InputError
            If the clock jumped.
        """
        if not self._arrived.add_measurement(time, measurement, self.time):
            self.counts["measurement too late"] += 1
        self._history.add(time, "add_measurement", time, measurement)
        self.advance()

    def add_aiding(self, sensor: str, samples: AidingSamples) -> None:
        """Add samples of an aiding sensor of the site; a state is created at each that is used.

        Raises
        ------
        InputError
            If the site has no such sensor, they are of another kind, or the clock jumped.
        """
        unused = self._arrived.add_aiding(sensor, samples, self.time)
        self.counts.update(unused)
        self._history.add(samples.time, "add_aiding", sensor, samples)
        self.advance()

    def add_factor(
        self,
        factor: gtsam.NonlinearFactor | gtsam.NonlinearFactorGraph,
        times: Sequence[float] | Array,
        values: gtsam.Values | None = None,
    ) -> None:
        """Add GTSAM factors on the states of some times (s).

        A factor on the state of one time to come creates it, as `add_measurement` does.  Others
        create states in the smoother's window, and enter with the next epoch after the last time.

        Parameters
        ----------
        factor : gtsam.NonlinearFactor or gtsam.NonlinearFactorGraph
            On X(j), V(j), B(j) of the j-th time, and on keys of their own, which are variables of
            this call.
        times : sequence of float
            Ascending, within the lag; one for the filter.
        values : gtsam.Values, optional
            Initial values of their own keys.

        Raises
        ------
        InputError
            If a key is unknown, a state is not one of the estimator's, or the clock jumped.
        """
        factors = UserFactors.of(factor, values, times)
        self._running.check_factor_times(factors.time)
        check_clock("factor", factors.time, self._arrived.newest)
        self.receive_factors(factors)

    def receive_factors(self, factors: UserFactors) -> None:
        """Add checked factors; those that are too late by now are counted."""
        if self._running.is_to_come(factors.time):
            self.add_measurement(float(factors.time[0]), state_factor(factors))
            return
        self._history.add(factors.time, "receive_factors", factors)
        self._running.add_factors(factors)

    # Output

    @property
    def started(self) -> bool:
        """Whether there is a state."""
        return self._running.estimator is not None

    @property
    def time(self) -> float:
        """Time of the newest estimate (s); minus infinity before the first."""
        return self._running.time

    @property
    def judgement(self) -> Judgement:
        """Judgement of the newest state."""
        return self._reports.judgement

    @property
    def summary(self) -> Summary:
        """Summary of all states up to now."""
        return self._reports.summary

    @property
    def why_no_start(self) -> NoStart:
        """Why there is no state yet."""
        return self._search.why

    def take(self) -> list[JudgedState]:
        """Return the states since the last call.

        The pose of a lost state is a guess and must not be used.
        """
        return self._reports.take()

    def take_propagated(self) -> list[PropagatedState]:
        """Return the propagated states between epochs, at the rate of the settings."""
        built, self._now.pending = self._now.pending, []
        return built

    def state(self, time: float | None = None) -> JudgedState:
        """Return the state at a time, propagated by the inertial stream from the last epoch.

        Parameters
        ----------
        time : float, optional
            (s); the newest inertial sample where it is not given.

        Raises
        ------
        EstimationError
            Before there is a state.
        """
        if self._running.estimator is None:
            raise EstimationError("there is no state yet: the navigator is still gathering data")
        last, imu = self._running.estimator.state, self._arrived.imu
        wanted = imu.reached if time is None else time
        return self._reports.judged(last) if wanted <= last.time else self._now.at(imu, wanted)

    @property
    def of_currents(self) -> tuple[Finding, ...]:
        """Findings on the currents of coils; every state includes them."""
        return self._running.update.of_currents

    @property
    def distortion(self) -> dict[str, float]:
        """By beacon, running mean of the squared innovation over its expectation."""
        return self._running.update.gate.distortion

    @property
    def lagged(self) -> State | None:
        """State that left the smoother's window last; for the filter, the current one."""
        return None if self._running.estimator is None else self._running.estimator.lagged

    def take_lagged(self) -> list[JudgedState]:
        """Return the states that left the smoother's window since the last call.

        Each has the judgement of its own time.  A filter has none.
        """
        window = self._running.estimator
        if not isinstance(window, SlidingWindow):
            return []
        outgoing, window.outgoing = window.outgoing, []
        return [self._reports.judged_then(state) for state in outgoing]

    def restarted(self) -> "Navigator":
        """Return a navigator that starts again, where the clock has stepped or all was silent.

        It keeps the biases and the calibration of a trustworthy state, with their random walks.
        """
        declared = replace(self.declared, temperatures=self._degrees, drives=self._drives)
        result = Navigator(declared, self.settings)
        result._reports.discontinuities = self._reports.discontinuities
        result._reports.summary = self._reports.summary
        result._reports.discontinuities.counter += self.started
        result.counts.update(self.counts)
        result.counts["started again"] += 1
        trusted = self.judgement.verdict is Verdict.TRUSTWORTHY and not self.corrected
        if self._running.estimator is None:
            result._search.earlier = self._search.earlier
        elif trusted:
            result._search.earlier = _on_site(self._running.estimator.state, result.site)
        return result

    def is_after_silence(self, time: float) -> bool:
        """Return whether all streams were silent for so long before a time (s) that it restarts."""
        return -np.inf < self._arrived.newest < time - LARGEST_JUMP

    # Corrections

    @property
    def corrected(self) -> tuple[Finding, ...]:
        """Mistakes of the declared site that are undone in this one."""
        return self._corrections.findings

    def take_corrections(self) -> tuple[Correction, ...]:
        """Return what may be wrong with the site, the most likely first; seldom, as each costs."""
        possible, self._possible = self._possible, ()
        return possible if possible and self._corrections.due(self._history.newest) else ()

    def with_correction(self, correction: Correction) -> "Navigator":
        """Return a navigator of a corrected site that has processed the newest input again.

        It returns no state that this one has returned.
        """
        result = Navigator(correction.site, self.settings)
        reasons = (*self.judgement.reasons, *self.why_no_start.trust.reasons)
        result.declared, result._tried = self.declared, correction
        result._corrections = self._corrections.further(correction, self.declared, reasons)
        jumped = self._reports.until > -np.inf
        result._reports.discontinuities.counter = self._reports.reset_counter + jumped
        result._search.needed = max(result._search.needed, self._history.span - MARGIN)
        self._history.replay(result)
        result._reports.drop_until(self._reports.until)
        return result

    @property
    def counts(self) -> Counter[str]:
        """Numbers of rejections, losses and recoveries, by reason."""
        return self._running.update.gate.counts

    @property
    def losses(self) -> dict[str, int]:
        """All rejections, losses and recoveries by reason: `counts`, windows, samples."""
        window = self._running.estimator
        dropped = window.dropped if isinstance(window, SlidingWindow) else 0
        of_factors = {"factors dropped": dropped} if dropped else {}
        return {**self.counts, **of_factors, **self._arrived.losses}

    def checkpoint(self) -> dict[str, Any]:
        """Return the complete state as plain data, from which `restored` makes a navigator."""
        rules = navigator_rules(self.site, self.blocks)
        self._arrived.settle()
        self._running.update.score.settle()
        own = to_plain(self._running.estimator, rules)
        return {"parts": to_plain(self, rules), "estimator": own}

    def go_on_from(self, data: Any, rules: Rules) -> None:
        """Load the state of a checkpoint; see `magfusion.estimation.online.restored`."""
        if not isinstance(data, dict) or data.keys() != {"parts", "estimator"}:
            raise InputError("contains no state of a navigator; run without --resume")
        resume(self, data["parts"], "navigator", rules)
        own = data["estimator"]
        if own is not None:
            state = own.get("state") if isinstance(own, dict) else None
            self._running.start_at(from_plain(State, state, "estimator.state", rules))
            resume(self._running.estimator, own, "estimator", rules)
            self._restart_propagation()

    # Processing

    def advance(self) -> None:
        """Process all complete data; the methods that add data call it."""
        changed = not self.started and self._begin()
        while self._step():
            changed = True
        if changed:
            self._restart_propagation()

    def _restart_propagation(self) -> None:
        """Propagate the newest estimate from here on."""
        imu, reports = self._arrived.imu, self._reports
        report = EpochReport(reports.judgement, reports.reset_counter, self._running.update.bank)
        self._now.restart_from(self._running.propagation_start(imu), report, imu)

    def _begin(self) -> bool:
        """Find the first state, once enough data have arrived."""
        search, running = self._search, self._running
        attempt = search.attempt(self._arrived, diagnose=self._tried is None)
        if attempt is None:
            return False
        self._possible = attempt.corrections
        start = search.accepted(attempt, self._arrived)
        if start is None:
            return False
        start = search.with_earlier(start, running.estimated, running.process_noise)
        running.begin(start, self._arrived.imu)
        self._arrived.start(start, self.settings.delay)
        self.rival_chi_square = start.rival_chi_square
        if self._tried is not None:
            self._corrections.widen(spread_of(self._tried, start.score)[-1])
            self.remainder = continued(self._tried, start.score)
        self.summary.unverified = start.trust.unverified
        self._store(start.state, running.update.begin(start))
        return True

    def _step(self) -> bool:
        """Process the next epoch, if all its data have arrived."""
        running = self._running
        if running.estimator is None:
            return False
        separate = running.update.recovery.needs_separate_beacons
        epoch = next_epoch(self._arrived, running.estimator.state, self.settings, separate)
        if isinstance(epoch, TooLate):
            self.counts[epoch.reason] += epoch.number
        elif epoch is not None:
            self._process(running.estimator, epoch)
        return epoch is not None

    def _process(self, estimator: Estimator, epoch: NextEpoch) -> None:
        """Propagate to an epoch, process its measurements, and report its state."""
        predicted, judgement = self._running.process(epoch.time, epoch.samples, self._arrived)
        if (correction := self._running.update.score.correction) is not None:
            self._possible = (correction,)
        state, counts = estimator.state, self.counts
        restarts = counts["lost and found again"]
        if self.site.platform.inertial:  # a motion prior may be uncertain, with regular fixes
            restarts += counts["found by a fix"]
        before = self.judgement
        self._reports.discontinuities.update(predicted.state, state, before, judgement, restarts)
        self._store(state, judgement)
        lag = self._arrived.imu.reapply_offset(state, self.blocks)
        if lag:
            estimator.replace_state(replace(state, time=state.time + lag))
            counts["time offset updated"] += 1
        self._arrived.discard_before(self.time)

    def _store(self, state: State, judgement: Judgement) -> None:
        self._reports.store(state, self._corrections.doubted(judgement))


def _on_site(state: State, site: Site) -> State:
    """Return a state whose calibration shares the readings of temperature and current of a site."""
    shared = replace(state.calibration.site, temperatures=site.temperatures, drives=site.drives)
    return replace(state, calibration=replace(state.calibration, site=shared))
