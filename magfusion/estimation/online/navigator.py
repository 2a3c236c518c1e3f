"""Navigation as the data arrive: one interface for the fixed-lag smoother and the filter.

`Navigator` knows no files.  Samples go in as they come; a state comes out at every field epoch, and
on request at any time since.
"""

from collections import Counter, deque
from dataclasses import replace
from typing import Any

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.freeze import imu_remarks
from magfusion.estimation.data_checks.inertial_noise import measured_noise, with_white_noise
from magfusion.estimation.demodulation.as_heard import fields_heard, samples_heard
from magfusion.estimation.demodulation.drive_reference import drive_findings
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.process_noise import calibration_process_noise
from magfusion.estimation.graph.propagation import Propagated, propagate
from magfusion.estimation.graph.state import State
from magfusion.estimation.initialization.early import first_try, is_clear, next_try, open_start
from magfusion.estimation.initialization.online import NoStart, OnlineStart
from magfusion.estimation.measurements.earth import check_earth
from magfusion.estimation.online.arrivals import arrivals_of
from magfusion.estimation.online.carried import Departure
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.epoch_update import EpochUpdate, Estimator
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.online.input_queue import Arrivals
from magfusion.estimation.online.navigator_data import navigator_rules
from magfusion.estimation.online.navigator_settings import NavigatorSettings as NavigatorSettings
from magfusion.estimation.online.short_windows import ShortWindows
from magfusion.estimation.online.state_of_now import CarriedState, Said, StateOfNow
from magfusion.estimation.online.still_samples import StillSamples
from magfusion.estimation.online_integrity.bank import SubsetBank
from magfusion.estimation.online_integrity.judgement import (
    JudgedState,
    Judgement,
    Told,
    judged_state,
)
from magfusion.estimation.online_integrity.resets import Resets
from magfusion.estimation.online_integrity.summary import Summary
from magfusion.files.blas_threads import warn_about_threads
from magfusion.files.plain_data import Rules, from_plain, resume, to_plain
from magfusion.model.arguments import check_arguments
from magfusion.model.drive import DriveSamples, DriveShares
from magfusion.model.marks import Marks
from magfusion.model.parameters import dimension, inertial_blocks, placed
from magfusion.model.platform_motion import NO_IMU
from magfusion.model.samples import FieldSamples, SteadyFields
from magfusion.model.site import Site
from magfusion.model.temperature import Temperatures
from magfusion.model.trust import Finding
from magfusion.model.without_imu import on_motion_prior, require_motion_prior
from magfusion.receiver.drive import DriveReceiver
from magfusion.units import Array, IntArray


class Navigator:
    """A running estimate of the platform's motion.

    Raises
    ------
    TypeError
        Where the first argument is no site.
    InputError
        Where the Earth field is to be measured but the site has none.
    """

    # What a checkpoint holds, beside the estimator.
    _arrived: Arrivals
    _update: EpochUpdate
    _next_start: float
    _judgement: Judgement
    _made: list[JudgedState]
    _told: deque[Told]
    _white: list[float]
    _resets: Resets
    _now: StateOfNow
    _still: StillSamples
    _degrees: Temperatures
    _drives: DriveShares
    _currents: DriveReceiver
    summary: Summary
    why_no_start: NoStart
    rival_chi_square: float | None

    def __init__(self, site: Site, settings: NavigatorSettings | None = None) -> None:
        check_arguments("Navigator", site=(site, Site))
        warn_about_threads()
        if site.platform.imu == NO_IMU:
            site = on_motion_prior(site)
        require_motion_prior(site)
        # Readings of its own: those to come are no other navigator's.
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
        # In the estimator's tangent what is estimated comes first, then what is only considered.
        estimated, considered = self.settings.blocks(site)
        self.blocks = (*estimated, *placed(considered, dimension(estimated)))
        self._considered = dimension(considered)
        self._of_imu = self.blocks if inertial_blocks(self.blocks) else ()
        risk, bank = self.settings.risk, None
        # Without its only beacon there is nothing to compare with.
        if risk is not None and len(site.beacons) > 1:
            bank = SubsetBank(site, self.blocks, self._considered, risk)
        self._update = EpochUpdate(site, estimated, self.blocks, self.settings.earth, bank)
        self._process_noise = calibration_process_noise(site, self.blocks, self._considered)
        self._arrived = arrivals_of(site, self.settings.lockin)
        if not self.settings.earth:  # of short windows there is no steady field
            self._arrived.short = ShortWindows.of(site, self.settings.lockin)
        self._estimator: Estimator | None = None
        self._next_start = first_try(self.site, self.settings.start_duration)
        imu = site.platform.imu
        self._white = [imu.gyro_noise, imu.accel_noise]  # what states are carried with
        self._judgement, self._made, self._told = Judgement(), [], deque()
        self._resets, self.summary = Resets(), Summary()
        self._now = StateOfNow(self.settings)
        self.why_no_start = NoStart()
        self.rival_chi_square = None

    # What goes in

    def add_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Take inertial samples: times (k,), rates and specific forces (k, 3).

        Raises
        ------
        InputError
            Where a number is not finite or the clock jumped, or the site describes no IMU.
        """
        self.hear_imu(time, gyro_body, accel_body)
        self.advance()

    def hear_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Take inertial samples as `add_imu`, and carry the state to them; leave all else.

        What takes longer is for `advance`, so that the state of now need not wait for it.
        """
        if not self.site.platform.inertial:
            raise InputError(
                "imu: the site has a motion prior in its place; describe platform.imu, or leave the"
                " inertial samples out"
            )
        self._arrived.add_imu(time, gyro_body, accel_body)
        self._now.reach(self._arrived)

    def add_magnetometer(
        self, time: Array, measured_sensor: Array, magnetometer: str | None = None
    ) -> None:
        """Take raw samples of a magnetometer: times (k,), fields (k, 3) (T).

        What stands in the columns of axes that the site does not declare is not looked at.

        Parameters
        ----------
        magnetometer : str, optional
            Which of several took them, by its own stamps.

        Raises
        ------
        InputError
            Where a number is not finite or the clock jumped, or the site has no such magnetometer.
        """
        samples = samples_heard(self.site, time, measured_sensor)
        self._arrived.add_magnetometer(time, samples, magnetometer)
        self._stand_still(np.atleast_1d(time), raw=True)
        self.advance()

    def add_drive(self, samples: DriveSamples) -> None:
        """Take currents of coils, before the samples of the magnetometer that they go with.

        Raises
        ------
        InputError
            As `magfusion.receiver.drive.DriveReceiver`.
        """
        self._currents.push(samples)
        self._drives.forget()
        self._update.of_currents = tuple(drive_findings(self._currents, self.site))

    def add_marks(self, marks: Marks) -> None:
        """Take bursts of coils whose slots are marked, with their samples or up to 0.5 s later.

        Raises
        ------
        InputError
            Where they do not follow those that came, a slot is of no coil, or the clock jumped.
        """
        self._arrived.add_marks(marks)
        self.advance()

    def add_slots(self, time: Array, slot: IntArray) -> None:
        """Take the slot that is driven at each sample (k,), before the samples themselves.

        ``magfusion.model.marks.SILENT`` where none is, ``UNTOLD`` where nothing is said.

        Raises
        ------
        InputError
            As `add_marks`.
        """
        self._arrived.add_slots(time, slot)

    def add_temperature(self, part: str, time: float, degc: float) -> None:
        """Take the temperature of a beacon, or of the ``magnetometer``: of what comes after it."""
        self._degrees.hear(part, time, degc)

    def add_fields(self, samples: FieldSamples, steady: SteadyFields | None = None) -> None:
        """Take demodulated phasors, channels in the site's order, and the steady fields with them.

        Raises
        ------
        InputError
            Where the clock jumped.
        """
        samples = fields_heard(self.site, samples)
        after = -np.inf if self._estimator is None else self._estimator.state.time
        late = self._arrived.add_fields(samples, steady if self.settings.earth else None, after)
        if late:
            self.counts["field too late"] += late
        heard = np.append([s.time[0] for s in self._arrived.fields], samples.time)
        self._stand_still(np.unique(heard), raw=False)
        self.advance()

    def add_measurement(self, time: float, measurement: Measurement) -> None:
        """Take in anything else that was measured, of one epoch: a state is made at its time (s).

        It passes no gate; a robust loss is its own.

        Raises
        ------
        InputError
            Where the clock jumped.
        """
        after = -np.inf if self._estimator is None else self._estimator.state.time
        if not self._arrived.add_measurement(time, measurement, after):
            self.counts["measurement too late"] += 1
        self.advance()

    def _stand_still(self, time: Array, *, raw: bool) -> None:
        """Go on with a motion prior to where the fields have come (s), where it has no IMU."""
        if self.site.platform.inertial:
            return
        made = self._still.stamps(time, raw=raw)
        if len(made):
            nothing = np.zeros((len(made), 3))
            self._arrived.add_imu(made, nothing, nothing)
            self._now.reach(self._arrived)

    # What comes out

    @property
    def started(self) -> bool:
        """Whether there is a state."""
        return self._estimator is not None

    @property
    def judgement(self) -> Judgement:
        """What is said of the newest state."""
        return self._judgement

    def take(self) -> list[JudgedState]:
        """Return the states made since this was last asked.

        Of one that is lost the pose is a guess that nobody should use.
        """
        made, self._made = self._made, []
        return made

    def take_carried(self) -> list[CarriedState]:
        """Return the states carried on between epochs, at the rate that the settings ask for."""
        made, self._now.made = self._now.made, []
        return made

    def state(self, time: float | None = None) -> JudgedState:
        """Return the state at a time, carried on by the inertial stream from the last epoch.

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
            return judged_state(last, self._judgement, self._resets.counter)
        return self._now.at(self._arrived, wanted)

    @property
    def of_currents(self) -> tuple[Finding, ...]:
        """What is said of the currents of coils; every state says it, too."""
        return self._update.of_currents

    @property
    def distortion(self) -> dict[str, float]:
        """By beacon, running mean of the squared innovation in units of its expectation."""
        return self._update.gate.distortion

    @property
    def lagged(self) -> State | None:
        """State that left the smoother's window last; that of the filter is of now."""
        return None if self._estimator is None else self._estimator.lagged

    def take_lagged(self) -> list[JudgedState]:
        """Return the states that left the smoother's window since this was last asked.

        Each is judged as the state of now was at its time.  A filter has none.
        """
        if not isinstance(self._estimator, SlidingWindow):
            return []
        left, self._estimator.left = self._estimator.left, []
        told = [(state, self._told_at(state.time)) for state in left]
        return [judged_state(state, t.judgement, t.reset_counter) for state, t in told]

    def _told_at(self, time: float) -> Told:
        """Return what was said of a time, and forget what was said before."""
        while len(self._told) > 1 and self._told[1].time <= time:
            self._told.popleft()
        return self._told[0] if self._told else Told(time, Judgement())

    @property
    def counts(self) -> Counter[str]:
        """What was refused, lost and recovered, with the reason."""
        return self._update.gate.counts

    @property
    def losses(self) -> dict[str, int]:
        """All that was refused, lost or recovered, with the reason: `counts`, windows, samples."""
        return {**self.counts, **self._arrived.losses}

    def checkpoint(self) -> dict[str, Any]:
        """Return everything needed to go on as plain data: `restored` makes a navigator of it."""
        rules = navigator_rules(self.site, self.blocks)
        self._arrived.settle()
        self._update.score.settle()
        return {"parts": to_plain(self, rules), "estimator": to_plain(self._estimator, rules)}

    def go_on_from(self, data: Any, rules: Rules) -> None:
        """Take the state that a checkpoint holds; see `magfusion.estimation.online.restored`."""
        if not isinstance(data, dict) or data.keys() != {"parts", "estimator"}:
            raise InputError("holds no state of a navigator; run without --resume")
        resume(self, data["parts"], "navigator", rules)
        own = data["estimator"]
        if own is not None:
            state = own.get("state") if isinstance(own, dict) else None
            self._start_at(from_plain(State, state, "estimator.state", rules))
            resume(self._estimator, own, "estimator", rules)
            self._depart()

    # How it goes on

    def advance(self) -> None:
        """Take in all that has come, as far as it is complete; whatever is added does so itself."""
        changed = self._estimator is None and self._begin()
        if self._estimator is None:
            return
        while self._step():
            changed = True
        if changed:
            self._depart()

    def _depart(self) -> None:
        """Carry the newest estimate from now on."""
        assert self._estimator is not None
        assert self._arrived.usual is not None
        departure = Departure(
            self._estimator.state,
            with_white_noise(self.site, *self._white),
            self.blocks,
            self._process_noise,
            self._arrived.applied_offset,
            self._arrived.usual,
        )
        said = Said(self._judgement, self._resets.counter, self._update.bank)
        self._now.depart(departure, said, self._arrived)

    def _begin(self) -> bool:
        """Find the first state, once enough has come."""
        arrived = self._arrived
        until = arrived.gathered(self.settings.delay, self._next_start)
        if until is None:
            return False
        start = arrived.first_state(until, self.settings)
        longest = 4.0 * self.settings.start_duration
        if self._next_start < self.settings.start_duration and not is_clear(start):
            if isinstance(start, OnlineStart) and start.ambiguous:
                self.why_no_start = open_start(start)
            self._next_start = next_try(self._next_start, self.settings.start_duration)
            return False
        if isinstance(start, NoStart):
            self.why_no_start = start
            self._next_start *= 2.0 if start.trust.findings else 1.5
            arrived.forget_before_start(longest)
            return False
        if start.ambiguous and self._next_start < longest:
            self.why_no_start = open_start(start)
            self._next_start += 0.5 * self.settings.start_duration
            return False
        imu, _ = measured_noise(arrived.inertial_samples(), self.site.platform.imu)
        self._white = [imu.gyro_noise, imu.accel_noise]
        self._arrived.start(start, self.settings.delay)
        self.rival_chi_square = start.rival_chi_square
        self._start_at(start.state)
        self.summary.unverified = start.trust.unverified
        self._tell(start.state, self._update.begin(start))
        return True

    def _start_at(self, state: State) -> None:
        if self.settings.estimator == "ekf":
            self._estimator = ErrorStateFilter(state, self.blocks, self._considered)
        else:
            self._estimator = SlidingWindow(
                state, self.blocks, self.settings.lag, self._process_noise, self._considered
            )

    def _step(self) -> bool:
        """Process the next epoch, if all that it needs has come."""
        assert self._estimator is not None
        state = self._estimator.state
        now = state.time
        arrived, delay = self._arrived, self.settings.delay
        arrived.receive(state, delay)
        inertial, other = arrived.awaited - delay, arrived.next_other
        if other <= now:
            self.counts["measurement too late"] += len(arrived.others_at(other))
            return True
        if other <= inertial and other < arrived.next_field:
            self._absorb(other, None)
            return True
        apart = arrived.short is not None and self._update.asks_for_each(state)
        centre = arrived.next_window(state, lost=apart)
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
        """Go on to a time and take in what was measured there."""
        assert self._estimator is not None
        if samples is None:
            self._arrived.fill_silence(self._estimator.state, time)
        before, predicted = self._estimator.state.time, self._propagated(time)
        judgement = self._update.take_in(self._estimator, self._arrived, predicted, samples)
        hung_since, bridged = self._arrived.hung_since, predicted.bridged
        judgement = judgement.beside(*imu_remarks(hung_since, before, time, bridged=bridged))
        judgement = judgement.beside(*self._arrived.remarks)
        state, counts = self._estimator.state, self.counts
        restarts = counts["lost and found again"]
        if self.site.platform.inertial:  # a motion prior may be wide, and a fix its rule
            restarts += counts["found by a fix"]
        self._resets.hear(predicted.state, state, self._judgement, judgement, restarts)
        self._tell(state, judgement)
        lag = self._arrived.apply_offset_anew(state, self.blocks)
        if lag:
            self._estimator.replace_state(replace(state, time=state.time + lag))
            self.counts["time offset applied anew"] += 1
        self._arrived.forget(self._estimator.state.time)

    def _tell(self, state: State, judgement: Judgement) -> None:
        self._judgement = judgement
        counter = self._resets.counter
        self._made.append(judged_state(state, judgement, counter))
        self.summary.note(state.time, judgement)
        if self.settings.estimator == "smoother":
            self._told.append(Told(state.time, judgement, counter))

    def _propagated(self, time: float) -> Propagated:
        assert self._estimator is not None
        state = self._estimator.state
        offset, usual = self._arrived.applied_offset, self._arrived.usual
        imu = self._arrived.motion_samples(state.time - offset, time - offset)
        blind = self._arrived.stand_in.covers(state.time - offset, time - offset)
        noise, site = self._process_noise, with_white_noise(self.site, *self._white)
        blocks = self._of_imu
        return propagate(state, imu, time, site, offset, noise, usual, blocks, blind=blind)
