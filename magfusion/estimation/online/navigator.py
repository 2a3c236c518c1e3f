"""Navigation as the data arrive: one interface for the fixed-lag smoother and the filter.

`Navigator` reads no files.  It takes samples as they arrive; it returns a state at every field
epoch, and on request at any later time.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.stream_buffer import MAX_JUMP, check_clock
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.initialization.online import NoStart
from magfusion.estimation.integrity.correction import Correction, released
from magfusion.estimation.measurements.earth import check_earth
from magfusion.estimation.measurements.factor_of_state import state_factor
from magfusion.estimation.online.estimation_loop import EstimationLoop
from magfusion.estimation.online.input_history import InputHistory
from magfusion.estimation.online.navigator_data import navigator_rules
from magfusion.estimation.online.navigator_settings import NavigatorSettings as NavigatorSettings
from magfusion.estimation.online.site_readings import SiteReadings
from magfusion.estimation.online.state_of_now import PropagatedState
from magfusion.estimation.online_integrity.judgement import JudgedState, Judgement
from magfusion.estimation.online_integrity.summary import Summary
from magfusion.files.blas_threads import warn_about_threads
from magfusion.files.plain_data import Rules, resume, to_plain
from magfusion.model.aiding import AidingSamples
from magfusion.model.arguments import check_arguments
from magfusion.model.drive import DriveSamples
from magfusion.model.marks import Marks
from magfusion.model.platform_motion import NO_IMU
from magfusion.model.samples import FieldSamples, StaticFields
from magfusion.model.site import Site
from magfusion.model.trust import Finding
from magfusion.model.without_imu import on_motion_prior, require_motion_prior
from magfusion.units import Array, IntArray


class Navigator:
    """A running estimate of the platform's motion.

    Attributes
    ----------
    declared : Site
        As given, without the corrections of ``site``.

    Raises
    ------
    TypeError
        If the first argument is no site.
    InputError
        If the Earth field is to be measured but the site declares none.
    """

    # Contents of a checkpoint, besides the estimator.
    _loop: EstimationLoop
    _readings: SiteReadings

    def __init__(self, site: Site, settings: NavigatorSettings | None = None) -> None:
        check_arguments("Navigator", site=(site, Site))
        warn_about_threads()
        if site.platform.imu == NO_IMU:
            site = on_motion_prior(site)
        require_motion_prior(site)
        self._readings = SiteReadings(site)
        site = self._readings.on(site)
        self.site = self.declared = site
        self.settings = settings = NavigatorSettings() if settings is None else settings
        if settings.earth:
            check_earth(site)
        self._loop, self._history = EstimationLoop(site, settings), InputHistory()
        self.blocks = self._loop.running.blocks

    # Input

    def add_imu(self, time: Array, gyro_body: Array, accel_body: Array) -> None:
        """Add samples: times (k,) (s), rates (rad/s), specific forces (m/s^2), body axes (k, 3).

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
        self._loop.arrived.add_imu(time, gyro_body, accel_body)
        self._history.add(time, "propagate_imu", time, gyro_body, accel_body)
        self._loop.now.reach(self._loop.arrived.imu)

    def add_magnetometer(
        self, time: Array, measured_sensor: Array, magnetometer: str | None = None
    ) -> None:
        """Add raw samples of a magnetometer: times (k,) (s), fields (k, 3) (T, sensor axes).

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
        self._loop.arrived.add_magnetometer(*given)
        self._history.add(self.site.platform.on_drive_clock(time), "add_magnetometer", *given)
        self._advance_with_motion_prior()

    def add_drive(self, samples: DriveSamples) -> None:
        """Add currents of coils (A), before the magnetometer samples of the same time (s).

        Raises
        ------
        InputError
            As `magfusion.receiver.drive.DriveReceiver`.
        """
        self._loop.running.update.of_currents = self._readings.add_currents(samples, self.site)

    def add_marks(self, marks: Marks) -> None:
        """Add bursts of coils with marked slots, with their samples or up to 0.5 s later.

        Raises
        ------
        InputError
            If they do not follow the previous ones, a slot is of no coil, or the clock jumped.
        """
        self._loop.arrived.add_marks(marks)
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
        self._loop.arrived.add_slots(time, slot)
        self._history.add(time, "add_slots", time, slot)

    def add_temperature(self, part: str, time: float, degc: float) -> None:
        """Set the temperature (deg C) at a time (s) of a beacon or the ``magnetometer``."""
        self._readings.temperatures.add_reading(part, time, degc)

    def add_fields(self, samples: FieldSamples, static: StaticFields | None = None) -> None:
        """Add phasors (T), channels in the site's order, with static fields (T) if measured.

        Raises
        ------
        InputError
            If the clock jumped.
        """
        static_used = static if self.settings.earth else None
        late = self._loop.arrived.add_fields(samples, static_used, self.time)
        if late:
            self.counts["field too late"] += late
        self._history.add(samples.time, "add_fields", samples, static)
        self._advance_with_motion_prior()

    def _advance_with_motion_prior(self) -> None:
        if not self.site.platform.inertial:  # the fields have advanced it
            self._loop.now.reach(self._loop.arrived.imu)
        self.advance()

    def add_measurement(self, time: float, measurement: Measurement) -> None:
        """Add any other measurement of one epoch: a state is created at its time (s).

        It bypasses the gate; it may have a robust loss of its own.

        Raises
        ------
        InputError
            If the clock jumped.
        """
        if not self._loop.arrived.add_measurement(time, measurement, self.time):
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
        unused = self._loop.arrived.add_aiding(sensor, samples, self.time)
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
        self._loop.running.check_factor_times(factors.time)
        check_clock("factor", factors.time, self.newest)
        self.receive_factors(factors)

    def receive_factors(self, factors: UserFactors) -> None:
        """Add checked factors; those that are too late by now are counted."""
        if self._loop.running.is_to_come(factors.time):
            self.add_measurement(float(factors.time[0]), state_factor(factors))
            return
        self._history.add(factors.time, "receive_factors", factors)
        self._loop.running.add_factors(factors)

    # Output

    @property
    def started(self) -> bool:
        """Whether there is a state."""
        return self._loop.running.estimator is not None

    @property
    def time(self) -> float:
        """Time of the newest estimate (s); minus infinity before the first."""
        return self._loop.running.time

    @property
    def newest(self) -> float:
        """Newest time of its input (s); minus infinity before any."""
        return self._loop.arrived.newest

    @property
    def judgement(self) -> Judgement:
        """Judgement of the newest state."""
        return self._loop.reports.judgement

    @property
    def summary(self) -> Summary:
        """Summary of all states up to now."""
        return self._loop.reports.summary

    @property
    def why_no_start(self) -> NoStart:
        """Why there is no state yet."""
        return self._loop.search.why

    @property
    def rival_chi_square(self) -> float | None:
        """Of the start's closest other hypothesis; None where there was none."""
        return self._loop.rival_chi_square

    def take(self) -> list[JudgedState]:
        """Return the states since the last call.

        The pose of a lost state is a guess and must not be used.
        """
        return self._loop.reports.take()

    def take_propagated(self) -> list[PropagatedState]:
        """Return the propagated states between epochs, at the rate of the settings."""
        built, self._loop.now.pending = self._loop.now.pending, []
        return built

    def state(self, time: float | None = None) -> JudgedState:
        """Return the newest state, or its propagation by the IMU to a later time.

        Parameters
        ----------
        time : float, optional
            (s), on the log's clock; the newest inertial sample where it is not given.

        Raises
        ------
        EstimationError
            Before there is a state.
        """
        return self._loop.state_at(time)

    @property
    def of_currents(self) -> tuple[Finding, ...]:
        """Findings on the currents of coils; every state includes them."""
        return self._loop.running.update.of_currents

    @property
    def distortion(self) -> dict[str, float]:
        """By beacon, running mean of the squared innovation over its expectation; 1 expected."""
        return self._loop.running.update.gate.distortion

    def take_lagged(self) -> list[JudgedState]:
        """Return the states that left the smoother's window since the last call.

        Each has the judgement of its own time.  A filter has none.
        """
        return self._loop.take_lagged()

    def restarted(self, *, without_prior: bool = False) -> "Navigator":
        """Return a navigator that starts again, where the clock has stepped or all was silent.

        It keeps the biases and the calibration of a trustworthy state, with their random walks, or
        none of them (``without_prior``), where it is unknown how long ago they were estimated.
        """
        result = Navigator(self._readings.on(self.declared), self.settings)
        result._loop.follow(self._loop)
        if without_prior:
            result._loop.search.earlier = None
        return result

    def is_after_silence(self, time: float) -> bool:
        """Return whether all streams were silent for so long before a time (s) that it restarts."""
        return -np.inf < self.newest < time - MAX_JUMP

    # Corrections

    @property
    def corrected(self) -> tuple[Finding, ...]:
        """Mistakes of ``declared`` that are undone in ``site``, each with its remedy."""
        return self._loop.corrections.findings

    @property
    def remainder(self) -> Correction | None:
        """Further correction of a corrected parameter that the newest data suggest, if any."""
        return self._loop.remainder

    def take_corrections(self) -> tuple[Correction, ...]:
        """Return what may be wrong with the site, the most likely first; seldom, as each costs."""
        possible, self._loop.possible = self._loop.possible, ()
        applied, restarts = self._loop.corrections, self._loop.is_lost_repeatedly
        if not (possible or restarts) or not applied.due(self._history.newest):
            return ()
        return applied.offered((*(self._by_a_new_start() if restarts else ()), *possible))

    def _by_a_new_start(self) -> tuple[Correction, ...]:
        """Return what a start on the newest input shows to be wrong with the site."""
        again = Navigator(self.site, self.settings)
        again._loop.search.wait_for(self._history.span)
        try:
            self._history.replay(again)
        except (RuntimeError, InputError, np.linalg.LinAlgError):
            return ()  # that is no reason to end
        return again._loop.possible

    def with_correction(self, correction: Correction) -> "Navigator":
        """Return a navigator of a corrected site that has processed the newest input again.

        It returns no state that this one has returned.
        """
        correction = released(correction, self.site, self.settings.estimate)
        result = Navigator(correction.site, self.settings)
        result.declared = self.declared
        result._loop.try_correction(correction, self._loop, self.declared, self._history.span)
        self._history.replay(result)
        result._loop.reports.drop_until(self._loop.reports.until)
        return result

    @property
    def counts(self) -> Counter[str]:
        """Numbers of rejected channels, losses and recoveries so far, by reason."""
        return self._loop.counts

    @property
    def losses(self) -> dict[str, int]:
        """`counts`, and numbers of windows, samples and factors that are not used, by reason."""
        return self._loop.losses

    def checkpoint(self) -> dict[str, Any]:
        """Return the complete state as plain data, from which `restored` makes a navigator."""
        rules = navigator_rules(self.site, self.blocks)
        own = self._loop.plain_estimator(rules)
        return {"parts": to_plain(self, rules), "estimator": own}

    def go_on_from(self, data: Any, rules: Rules) -> None:
        """Load the state of a checkpoint; see `magfusion.estimation.online.restored`."""
        if not isinstance(data, dict) or data.keys() != {"parts", "estimator"}:
            raise InputError("contains no state of a navigator; run without --resume")
        resume(self, data["parts"], "navigator", rules)
        if data["estimator"] is not None:
            self._loop.resume_estimator(data["estimator"], rules)

    def advance(self) -> None:
        """Process all complete data; the methods that add data call it."""
        self._loop.advance()
