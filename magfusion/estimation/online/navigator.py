"""Navigation as the data arrive: one interface for the fixed-lag smoother and the filter.

`Navigator` reads no files.  It takes samples as they arrive; it returns a state at every field
epoch, and on request at any later time.
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.freeze import imu_remarks
from magfusion.estimation.data_checks.inertial_noise import measured_noise, with_white_noise
from magfusion.estimation.data_checks.stream_buffer import LARGEST_JUMP, check_clock
from magfusion.estimation.demodulation.drive_reference import drive_findings
from magfusion.estimation.demodulation.sensor_frame_samples import (
    sensor_frame_phasors,
    sensor_frame_samples,
)
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.process_noise import calibration_process_noise
from magfusion.estimation.graph.propagation import Propagated, propagate
from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.estimation.graph.state import State
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.initialization.earlier_state import with_earlier
from magfusion.estimation.initialization.early import (
    first_try,
    is_clear,
    is_open,
    next_try,
    open_start,
)
from magfusion.estimation.initialization.online import NoStart, OnlineStart
from magfusion.estimation.integrity.correction import Correction, continued, spread_of
from magfusion.estimation.measurements.aiding_samples import (
    aiding_measurement,
    measured_time,
    thinned,
)
from magfusion.estimation.measurements.earth import check_earth
from magfusion.estimation.measurements.factor_of_state import state_factor
from magfusion.estimation.online.applied_corrections import AppliedCorrections
from magfusion.estimation.online.arrivals import arrivals_of
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.epoch_update import EpochUpdate, Estimator
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.online.input_history import InputHistory
from magfusion.estimation.online.input_queue import Arrivals
from magfusion.estimation.online.navigator_data import navigator_rules
from magfusion.estimation.online.navigator_settings import NavigatorSettings as NavigatorSettings
from magfusion.estimation.online.propagated import PropagationStart
from magfusion.estimation.online.short_windows import ShortWindows
from magfusion.estimation.online.state_of_now import EpochReport, PropagatedState, StateOfNow
from magfusion.estimation.online.still_samples import StillSamples
from magfusion.estimation.online_integrity.bank import SubsetBank
from magfusion.estimation.online_integrity.discontinuity_counter import DiscontinuityCounter
from magfusion.estimation.online_integrity.judgement import (
    JudgedState,
    Judgement,
    TimedJudgement,
    judged_state,
)
from magfusion.estimation.online_integrity.summary import Summary
from magfusion.files.blas_threads import warn_about_threads
from magfusion.files.plain_data import Rules, from_plain, resume, to_plain
from magfusion.model.aiding import AidingSamples, sensor_named
from magfusion.model.arguments import check_arguments
from magfusion.model.drive import DriveSamples, DriveShares
from magfusion.model.marks import Marks
from magfusion.model.parameters import dimension, inertial_blocks, placed
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
    _update: EpochUpdate
    _next_start: float
    _judgement: Judgement
    _pending: list[JudgedState]
    _timed_judgements: deque[TimedJudgement]
    _white: list[float]
    _discontinuities: DiscontinuityCounter
    _now: StateOfNow
    _still: StillSamples
    _degrees: Temperatures
    _drives: DriveShares
    _currents: DriveReceiver
    summary: Summary
    why_no_start: NoStart
    rival_chi_square: float | None
    _corrections: AppliedCorrections
    _reported_until: float
    _earlier: State | None
    _aiding_until: dict[str, float]  # time of each sensor's last sample (s)
    _early: list[UserFactors]

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
        self.site, self._still = site, StillSamples()
        self.settings = NavigatorSettings() if settings is None else settings
        if self.settings.earth:
            check_earth(site)
        # In the estimator's tangent, estimated parameters precede considered ones.
        estimated, considered = self.settings.blocks(site)
        self.blocks = (*estimated, *placed(considered, dimension(estimated)))
        self._considered = dimension(considered)
        self._of_imu = self.blocks if inertial_blocks(self.blocks) else ()
        risk, bank = self.settings.risk, None
        # Without its only beacon nothing can be compared.
        if risk is not None and len(site.beacons) > 1:
            bank = SubsetBank(site, self.blocks, self._considered, risk)
        self._update = EpochUpdate(
            site, estimated, self.blocks, self.settings.earth, self.settings.lost_beyond, bank
        )
        self._process_noise = calibration_process_noise(site, self.blocks, self._considered)
        self._arrived = arrivals_of(site, self.settings.lockin)
        if not self.settings.earth:  # short windows contain no static field
            self._arrived.short = ShortWindows.of(site, self.settings.lockin)
        self._estimator: Estimator | None = None
        self._next_start = first_try(self.site, self.settings.start_duration)
        imu = site.platform.imu
        self._white = [imu.gyro_noise, imu.accel_noise]  # for the propagation
        self._judgement, self._pending, self._timed_judgements = Judgement(), [], deque()
        self._discontinuities, self.summary = DiscontinuityCounter(), Summary()
        self._now = StateOfNow(self.settings)
        self.why_no_start = NoStart()
        self.rival_chi_square = None
        self.declared, self._history = site, InputHistory()
        self._corrections, self._reported_until = AppliedCorrections(), -np.inf
        self._earlier, self._early, self._aiding_until = None, [], {}
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
        samples = self.site.platform.corrected_imu(gyro_body, accel_body)
        self._arrived.add_imu(time, *samples)
        self._history.add(time, "propagate_imu", time, gyro_body, accel_body)
        self._now.reach(self._arrived)

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
        time = self.site.platform.on_drive_clock(time)
        samples = sensor_frame_samples(self.site, time, measured_sensor)
        self._arrived.add_magnetometer(time, samples, magnetometer)
        self._history.add(time, "add_magnetometer", *given)
        self._stand_still(np.atleast_1d(time), raw=True)
        self.advance()

    def add_drive(self, samples: DriveSamples) -> None:
        """Add currents of coils, before the magnetometer samples of the same time.

        Raises
        ------
        InputError
            As `magfusion.receiver.drive.DriveReceiver`.
        """
        self._currents.push(samples)
        self._drives.discard_old()
        self._update.of_currents = tuple(drive_findings(self._currents, self.site))

    def add_marks(self, marks: Marks) -> None:
        """Add bursts of coils with marked slots, with their samples or up to 0.5 s later.

        Raises
        ------
        InputError
            If they do not follow the previous ones, a slot is of no coil, or the clock jumped.
        """
        clock = self.site.platform.on_drive_clock
        self._arrived.add_marks(Marks(clock(marks.begin), clock(marks.end), marks.slot))
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
        self._arrived.add_slots(self.site.platform.on_drive_clock(time), slot)
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
        given, samples = samples, sensor_frame_phasors(self.site, samples)
        self._history.add(samples.time, "add_fields", given, steady)
        after = -np.inf if self._estimator is None else self._estimator.state.time
        late = self._arrived.add_fields(samples, steady if self.settings.earth else None, after)
        if late:
            self.counts["field too late"] += late
        detected = np.append([s.time[0] for s in self._arrived.fields], samples.time)
        self._stand_still(np.unique(detected), raw=False)
        self.advance()

    def add_measurement(self, time: float, measurement: Measurement) -> None:
        """Add any other measurement of one epoch: a state is created at its time (s).

        It bypasses the gate; it may have a robust loss of its own.

        Raises
        ------
        InputError
            If the clock jumped.
        """
        after = -np.inf if self._estimator is None else self._estimator.state.time
        if not self._arrived.add_measurement(time, measurement, after):
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
        declared = sensor_named(self.site.aiding, sensor, samples.quantity)
        self._history.add(samples.time, "add_aiding", sensor, samples)
        after = -np.inf if self._estimator is None else self._estimator.state.time
        used = thinned(declared, samples, self._aiding_until.get(sensor, -np.inf))
        if len(used) < len(samples):
            self.counts[f"{sensor} sample beyond its rate"] += len(samples) - len(used)
        if len(samples):
            self._aiding_until[sensor] = float(samples.time[-1])
        measurement = aiding_measurement(declared, used)
        for i, time in enumerate(measured_time(declared, used).tolist()):
            if not self._arrived.add_measurement(time, measurement.rows(slice(i, i + 1)), after):
                self.counts["measurement too late"] += 1
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
        self._check_states(factors.time)
        check_clock("factor", factors.time, self._arrived.newest)
        self.receive_factors(factors)

    def _check_states(self, time: Array) -> None:
        """Refuse factors on states (s) that the estimator does not have and will not make."""
        name = ", ".join(f"{t:g}" for t in time)
        if len(time) == 0 or np.any(np.diff(time) < 2.0 * SAME_TIME):
            raise InputError(
                f"a factor is at times ({name}) that are none or too close; give one for each state"
            )
        coming = len(time) == 1 and time[0] > self.time
        if self.settings.estimator == "ekf" and not coming:
            raise InputError(
                f"a factor is at {name} s, but the filter has only the state of one time, from now"
                " on; use the smoother, or magfusion.smooth(factors=...)"
            )
        if not coming and self._of_imu:
            raise InputError(
                f"a factor is at {name} s, but parameters of the IMU allow only one time to come;"
                " use magfusion.smooth(factors=...)"
            )
        window, lag = self._estimator, self.settings.lag
        oldest = window.oldest if isinstance(window, SlidingWindow) else -np.inf
        if time[-1] - time[0] > lag or time[0] < oldest - SAME_TIME:
            raise InputError(
                f"a factor is at {name} s, not within the smoother's lag of {lag:g} s;"
                " increase NavigatorSettings.lag, or use magfusion.smooth(factors=...)"
            )

    def receive_factors(self, factors: UserFactors) -> None:
        """Add checked factors; those that are too late by now are counted."""
        if len(factors.time) == 1 and factors.time[0] > self.time:
            self.add_measurement(float(factors.time[0]), state_factor(factors))
            return
        self._history.add(factors.time, "receive_factors", factors)
        if self._estimator is None:
            self._early.append(factors)
        elif isinstance(self._estimator, SlidingWindow):
            self._estimator.waiting = [*self._estimator.waiting, factors]

    def _stand_still(self, time: Array, *, raw: bool) -> None:
        """Advance a motion prior to the newest fields (s), where the site has no IMU."""
        if self.site.platform.inertial:
            return
        built = self._still.stamps(time, raw=raw)
        if len(built):
            nothing = np.zeros((len(built), 3))
            self._arrived.add_imu(built, nothing, nothing)
            self._now.reach(self._arrived)

    # Output

    @property
    def started(self) -> bool:
        """Whether there is a state."""
        return self._estimator is not None

    @property
    def time(self) -> float:
        """Time of the newest estimate (s); minus infinity before the first."""
        return -np.inf if self._estimator is None else self._estimator.state.time

    @property
    def judgement(self) -> Judgement:
        """Judgement of the newest state."""
        return self._judgement

    def take(self) -> list[JudgedState]:
        """Return the states since the last call.

        The pose of a lost state is a guess and must not be used.
        """
        built, self._pending = self._pending, []
        self._reported_until = built[-1].time if built else self._reported_until
        return built

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
        if self._estimator is None:
            raise EstimationError("there is no state yet: the navigator is still gathering data")
        last = self._estimator.state
        wanted = self._arrived.inertial if time is None else time
        if wanted <= last.time:
            return judged_state(last, self._judgement, self._discontinuities.counter)
        return self._now.at(self._arrived, wanted)

    @property
    def of_currents(self) -> tuple[Finding, ...]:
        """Findings on the currents of coils; every state includes them."""
        return self._update.of_currents

    @property
    def distortion(self) -> dict[str, float]:
        """By beacon, running mean of the squared innovation over its expectation."""
        return self._update.gate.distortion

    @property
    def lagged(self) -> State | None:
        """State that left the smoother's window last; for the filter, the current one."""
        return None if self._estimator is None else self._estimator.lagged

    def take_lagged(self) -> list[JudgedState]:
        """Return the states that left the smoother's window since the last call.

        Each has the judgement of its own time.  A filter has none.
        """
        if not isinstance(self._estimator, SlidingWindow):
            return []
        outgoing, self._estimator.outgoing = self._estimator.outgoing, []
        reported = [(state, self._judgement_at(state.time)) for state in outgoing]
        return [judged_state(state, t.judgement, t.reset_counter) for state, t in reported]

    def _judgement_at(self, time: float) -> TimedJudgement:
        """Return the judgement of a time, and discard earlier ones."""
        while len(self._timed_judgements) > 1 and self._timed_judgements[1].time <= time:
            self._timed_judgements.popleft()
        return (
            self._timed_judgements[0]
            if self._timed_judgements
            else TimedJudgement(time, Judgement())
        )

    def restarted(self) -> "Navigator":
        """Return a navigator that starts again, where the clock has stepped or all was silent.

        It keeps the biases and the calibration of a trustworthy state, with their random walks.
        """
        declared = replace(self.declared, temperatures=self._degrees, drives=self._drives)
        result = Navigator(declared, self.settings)
        result._discontinuities, result.summary = self._discontinuities, self.summary
        result._discontinuities.counter += self.started
        result.counts.update(self.counts)
        result.counts["started again"] += 1
        trusted = self._judgement.verdict is Verdict.TRUSTWORTHY and not self.corrected
        if self._estimator is None:
            result._earlier = self._earlier
        elif trusted:
            result._earlier = _on_site(self._estimator.state, result.site)
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
        jumped = self._reported_until > -np.inf
        result._discontinuities.counter = self._discontinuities.counter + jumped
        result._next_start = max(result._next_start, self._history.span - MARGIN)
        self._history.replay(result)
        result._pending = [state for state in result._pending if state.time > self._reported_until]
        return result

    @property
    def counts(self) -> Counter[str]:
        """Numbers of rejections, losses and recoveries, by reason."""
        return self._update.gate.counts

    @property
    def losses(self) -> dict[str, int]:
        """All rejections, losses and recoveries by reason: `counts`, windows, samples."""
        window = self._estimator
        dropped = window.dropped if isinstance(window, SlidingWindow) else 0
        of_factors = {"factors dropped": dropped} if dropped else {}
        return {**self.counts, **of_factors, **self._arrived.losses}

    def checkpoint(self) -> dict[str, Any]:
        """Return the complete state as plain data, from which `restored` makes a navigator."""
        rules = navigator_rules(self.site, self.blocks)
        self._arrived.settle()
        self._update.score.settle()
        return {"parts": to_plain(self, rules), "estimator": to_plain(self._estimator, rules)}

    def go_on_from(self, data: Any, rules: Rules) -> None:
        """Load the state of a checkpoint; see `magfusion.estimation.online.restored`."""
        if not isinstance(data, dict) or data.keys() != {"parts", "estimator"}:
            raise InputError("contains no state of a navigator; run without --resume")
        resume(self, data["parts"], "navigator", rules)
        own = data["estimator"]
        if own is not None:
            state = own.get("state") if isinstance(own, dict) else None
            self._start_at(from_plain(State, state, "estimator.state", rules))
            resume(self._estimator, own, "estimator", rules)
            self._restart_propagation()

    # Processing

    def advance(self) -> None:
        """Process all complete data; the methods that add data call it."""
        changed = self._estimator is None and self._begin()
        if self._estimator is None:
            return
        while self._step():
            changed = True
        if changed:
            self._restart_propagation()

    def _restart_propagation(self) -> None:
        """Propagate the newest estimate from here on."""
        assert self._estimator is not None
        assert self._arrived.usual is not None
        start = PropagationStart(
            self._estimator.state,
            with_white_noise(self.site, *self._white),
            self.blocks,
            self._process_noise,
            self._arrived.applied_offset,
            self._arrived.usual,
        )
        findings = EpochReport(self._judgement, self._discontinuities.counter, self._update.bank)
        self._now.restart_from(start, findings, self._arrived)

    def _begin(self) -> bool:
        """Find the first state, once enough data have arrived."""
        arrived = self._arrived
        until = arrived.gathered(self.settings.delay, self._next_start)
        if until is None:
            return False
        start = arrived.first_state(until, self.settings, diagnose=self._tried is None)
        self._possible = start.corrections
        longest = 4.0 * self.settings.start_duration
        usual, several = self.settings.start_duration, len(self.site.beacons) > 1
        early, later = self._next_start < usual, next_try(self._next_start, usual)
        if early and not is_clear(start, several=several, last=later >= usual):
            if isinstance(start, OnlineStart) and start.ambiguous:
                self.why_no_start = open_start(start)
            self._next_start = later
            return False
        if isinstance(start, NoStart):
            self.why_no_start = start
            self._next_start *= 2.0 if start.trust.findings else 1.5
            arrived.limit_history(longest)
            return False
        if is_open(start) and self._next_start < longest:
            self.why_no_start = open_start(start)
            self._next_start += 0.5 * self.settings.start_duration
            return False
        if self._earlier is not None:
            estimated = self.blocks[: len(self.settings.blocks(self.site)[0])]
            parts = self._earlier, self.site, estimated, self._process_noise
            start, self._earlier = replace(start, state=with_earlier(start.state, *parts)), None
        imu, _ = measured_noise(arrived.inertial_samples(), self.site.platform.imu)
        self._white = [imu.gyro_noise, imu.accel_noise]
        self._arrived.start(start, self.settings.delay)
        self.rival_chi_square = start.rival_chi_square
        self._start_at(start.state)
        if self._tried is not None:
            self._corrections.widen(spread_of(self._tried, start.score)[-1])
            self.remainder = continued(self._tried, start.score)
        self.summary.unverified = start.trust.unverified
        self._store(start.state, self._update.begin(start))
        return True

    def _start_at(self, state: State) -> None:
        if self.settings.estimator == "ekf":
            self._estimator = ErrorStateFilter(state, self.blocks, self._considered)
        else:
            self._estimator = SlidingWindow(
                state,
                self.blocks,
                self.settings.lag,
                self._process_noise,
                self._considered,
                with_white_noise(self.site, *self._white),
            )
            self._estimator.waiting, self._early = self._early, []

    def _step(self) -> bool:
        """Process the next epoch, if all its data have arrived."""
        assert self._estimator is not None
        state = self._estimator.state
        now = state.time
        arrived, delay = self._arrived, self.settings.delay
        arrived.receive(state, delay)
        inertial, other = arrived.awaited - delay, arrived.next_other
        if other <= now + SAME_TIME:
            self.counts["measurement too late"] += len(arrived.others_at(other))
            return True
        if other <= inertial and other < arrived.next_field - SAME_TIME:
            self._absorb(other, None)
            return True
        separate = arrived.short is not None and self._update.needs_separate_beacons(state)
        centre = arrived.next_window(state, is_lost=separate)
        if centre is not None:
            self._step_window(centre)
            return True
        if arrived.due(inertial):
            return self._step_fields(arrived.fields.pop(0))
        if arrived.window_to_come:
            return False
        if inertial - now >= self.settings.longest_step:
            self._absorb(now + self.settings.longest_step, None)
            return True
        return False

    def _step_window(self, centre: float) -> None:
        assert self._estimator is not None
        if centre <= self._estimator.state.time:
            self.counts["window too late"] += 1
        else:
            self._absorb(centre, None)

    def _step_fields(self, samples: FieldSamples) -> bool:
        assert self._estimator is not None
        if samples.time[0] <= self._estimator.state.time:
            self.counts["field too late"] += 1
            self._arrived.steady.pop(float(samples.time[0]), None)
            return True
        self._absorb(float(samples.time[0]), samples)
        return True

    def _absorb(self, time: float, samples: FieldSamples | None) -> None:
        """Propagate to a time and process its measurements."""
        assert self._estimator is not None
        if samples is None:
            self._arrived.fill_silence(self._estimator.state, time)
        before, predicted = self._estimator.state.time, self._propagated(time)
        judgement = self._update.process_epoch(self._estimator, self._arrived, predicted, samples)
        hung_since, gap_bridged = self._arrived.hung_since, predicted.gap_bridged
        judgement = judgement.with_findings(
            *imu_remarks(hung_since, before, time, gap_bridged=gap_bridged)
        )
        judgement = judgement.with_findings(*self._arrived.remarks)
        if (correction := self._update.score.correction) is not None:
            self._possible = (correction,)
        state, counts = self._estimator.state, self.counts
        restarts = counts["lost and found again"]
        if self.site.platform.inertial:  # a motion prior may be uncertain, with regular fixes
            restarts += counts["found by a fix"]
        self._discontinuities.update(predicted.state, state, self._judgement, judgement, restarts)
        self._store(state, judgement)
        lag = self._arrived.reapply_time_offset(state, self.blocks)
        if lag:
            self._estimator.replace_state(replace(state, time=state.time + lag))
            self.counts["time offset updated"] += 1
        self._arrived.discard_before(self._estimator.state.time)

    def _store(self, state: State, judgement: Judgement) -> None:
        self._judgement = judgement = self._corrections.doubted(judgement)
        counter = self._discontinuities.counter
        self._pending.append(judged_state(state, judgement, counter))
        self.summary.note(state.time, judgement)
        if self.settings.estimator == "smoother":
            self._timed_judgements.append(TimedJudgement(state.time, judgement, counter))

    def _propagated(self, time: float) -> Propagated:
        assert self._estimator is not None
        state = self._estimator.state
        offset, usual = self._arrived.applied_offset, self._arrived.usual
        imu = self._arrived.motion_samples(state.time - offset, time - offset)
        blind = self._arrived.imu_filler.covers(state.time - offset, time - offset)
        noise, site = self._process_noise, with_white_noise(self.site, *self._white)
        blocks = self._of_imu
        return propagate(state, imu, time, site, offset, noise, usual, blocks, blind=blind)


def _on_site(state: State, site: Site) -> State:
    """Return a state whose calibration shares the readings of temperature and current of a site."""
    shared = replace(state.calibration.site, temperatures=site.temperatures, drives=site.drives)
    return replace(state, calibration=replace(state.calibration, site=shared))
