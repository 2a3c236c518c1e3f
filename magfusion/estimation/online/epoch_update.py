"""Update of a running estimate by one epoch: gate, update, loss and recovery, and judgement."""

from dataclasses import replace

import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.propagation import Propagated
from magfusion.estimation.graph.state import State
from magfusion.estimation.initialization.online import OnlineStart
from magfusion.estimation.measurements.earth import EarthField, EarthWeight, speed_sigma
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.measurements.zero_velocity import zero_velocity
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online.fix_comparison import FixComparison
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.online.loss_recovery import LossRecovery
from magfusion.estimation.online.queue.arrivals import Arrivals
from magfusion.estimation.online.queue.epoch_measurements import (
    EpochMeasurements,
    is_stationary,
    with_inertial,
)
from magfusion.estimation.online_integrity.aiding_gate import AidingGate
from magfusion.estimation.online_integrity.bank import SubsetBank
from magfusion.estimation.online_integrity.dead_reckoning_check import DeadReckoningCheck
from magfusion.estimation.online_integrity.gate import Gate
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.magnetometer_watch import MagnetometerWatch
from magfusion.estimation.online_integrity.near_metal import NearMetal
from magfusion.estimation.online_integrity.online import EpochSummary, OnlineMonitor
from magfusion.estimation.online_integrity.open_roll import roll_findings
from magfusion.estimation.online_integrity.score_online import OnlineScore
from magfusion.estimation.online_integrity.settlement import SettlementTest
from magfusion.estimation.snapshot.region_test import of_place
from magfusion.model.parameters import Block
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trust import Finding

NOW = np.zeros(1, dtype=np.int64)  # the single epoch of a measurement

Estimator = SlidingWindow | ErrorStateFilter


class EpochUpdate:
    """Processes epochs one by one.

    Parameters
    ----------
    estimated, blocks : tuple of Block
        Calibration parameters that are estimated, and all in the states' tangent.
    earth : bool
        Whether the static field is a measurement.
    lost_beyond : float
        As of `magfusion.estimation.online.navigator_settings.NavigatorSettings` (m).
    bank : SubsetBank, optional
        Filters that exclude each beacon; without it there are no protection levels.
    """

    gate: Gate
    aiding: AidingGate
    monitor: OnlineMonitor
    score: OnlineScore
    settlement: SettlementTest
    metal: NearMetal
    _dead_reckoning: DeadReckoningCheck
    recovery: LossRecovery
    _comparison: FixComparison
    _earth: EarthWeight | None
    bank: SubsetBank | None

    def __init__(
        self,
        site: Site,
        estimated: tuple[Block, ...],
        blocks: tuple[Block, ...],
        earth: bool,
        lost_beyond: float,
        bank: SubsetBank | None = None,
    ) -> None:
        self.site, self.blocks, self.bank = site, blocks, bank
        self.gate = Gate(site.channels, blocks, MagnetometerWatch(site))
        self.aiding = AidingGate(site, blocks, self.gate.counts)
        self.of_currents: tuple[Finding, ...] = ()
        self._roll = roll_findings(site)
        self.metal, self._dead_reckoning = NearMetal(site, blocks), DeadReckoningCheck(blocks)
        self.monitor = OnlineMonitor(site, estimated)
        self.score = OnlineScore(site, estimated, blocks[len(estimated) :], static=earth)
        self.settlement = SettlementTest(site)
        self.recovery = LossRecovery(self.gate, blocks, lost_beyond)
        self._comparison = FixComparison()
        self._earth = EarthWeight(blocks) if earth else None

    def begin(self, start: OnlineStart) -> Judgement:
        """Judge a first state."""
        findings = Judgement(start.trust.reasons, turn=start.turn, shift=start.shift)
        self.gate.begin(start.noise_freedom)
        self.metal.begin(start.noise_freedom)
        self.gate.watch.begin(start.excluded, start.findings)
        known = start.shared_offsets, start.noise_freedom
        self.monitor.begin(start.state.time, findings, *known)
        self.score.begin(start.score, start.state)
        self.recovery.detected_at = start.state.time
        fitted = [f for f in start.trust.remarks if f.code == "fitted_line" and start.extra_lines]
        return self._judge_state(start.state, None).with_findings(*fitted)

    def process_epoch(
        self,
        estimator: Estimator,
        arrived: Arrivals,
        predicted: Propagated,
        samples: FieldSamples | None,
    ) -> Judgement:
        """Process the measurements at a prediction, and judge the state.

        `samples`: of this epoch; None where it may have a window.
        """
        before, state = estimator.state, predicted.state
        if predicted.gap_bridged:
            self.gate.counts["inertial gap bridged"] += 1
        step = max(state.time - arrived.last_epoch, 1e-6)
        earth, standing = self._earth is not None, is_stationary(state, arrived.imu)
        lost_epochs = self.recovery.needs_fix(state)
        result = arrived.measured(
            before, state, samples, step, earth=earth, standing=standing, is_lost=lost_epochs
        )
        others = arrived.others.take(state.time)
        own = self.site, self.blocks, arrived.imu
        others = [with_inertial(one, state, *own) for one in others]
        measurements = self.aiding.passed(others, state)
        if standing:
            measurements.append(zero_velocity(NOW, self.site.platform.motion.rest_speed_sigma))
        point = None
        if result is None or not np.any(result.samples.valid):
            self.gate.nothing_measured()
        else:
            passed = self._passed(estimator, predicted, result, is_lost=lost_epochs)
            if isinstance(passed, Judgement):  # nothing of it is to be used
                return passed
            result, point = passed
            self.recovery.detected_at = state.time
        if result is not None:
            known = state if point is None else replace(point, cov=state.cov)
            measurements += self._of_fields(result, known, step)
        self._score_epoch(arrived, before, predicted, measurements, point)
        absorbed = self._absorbed(estimator, predicted, measurements, point)
        linear = predicted if absorbed and point is None else None
        self._separate(linear, measurements, estimator.state)
        self._update_monitor(before, predicted, estimator.state, result)
        if result is not None and isinstance(result.phasors, FieldPhasors):
            self.settlement.update(result.phasors, result.samples, estimator.state)
            self._compare(result.phasors, result.samples, estimator.state)
        verdicts = self._judge_state(estimator.state, self._lost_since(estimator.state))
        return verdicts if result is None else replace(verdicts, detected=result.detected)

    def _without_the_last(self, estimator: Estimator, predicted: Propagated) -> Judgement:
        """Continue with a prediction without the measurements of an interference's onset."""
        estimator.replace_state(self._dead_reckoning.taken_back(predicted))
        self._dead_reckoning.reset()
        self.score.end()
        return self._judge_state(estimator.state, self._lost_since(estimator.state))

    # What was measured

    def _weighed_phasors(
        self, measured: EpochMeasurements, explained: State, *, requested: bool
    ) -> FieldPhasors | JointPhasors:
        """Weight phasors for nearby metal; all predictions that the score needs are shared."""
        if isinstance(measured.phasors, JointPhasors):  # of two beacons or more
            return measured.phasors
        if requested:
            self.score.foresee(measured.phasors, explained)
        return self.metal.weighed(measured.phasors, explained, measured.samples.valid[0])

    def _of_fields(
        self, measured: EpochMeasurements, known: State, step: float
    ) -> list[Measurement]:
        measurements: list[Measurement] = [measured.phasors]
        if measured.earth is not None:
            measurements.append(self._weighed(measured.earth, known))
            if isinstance(measured.phasors, FieldPhasors) and not np.any(
                measured.phasors.sqrt_information
            ):
                sigma = speed_sigma(step, self.site.platform.motion)
                measurements.append(zero_velocity(NOW, sigma))
        return measurements

    def _weighed(self, field: EarthField, known: State) -> EarthField:
        assert self._earth is not None
        weighed, disturbed = self._earth.weighed(field, known)
        self.gate.counts["Earth field disturbed"] += disturbed
        return weighed

    # Judgement

    def _score_epoch(
        self,
        arrived: Arrivals,
        before: State,
        predicted: Propagated,
        measurements: list[Measurement],
        point: State | None,
    ) -> None:
        """Pass an epoch to the score; end the score if the linearization point is elsewhere."""
        if point is not None:
            self.score.end()
            return
        state, offset = predicted.state, arrived.imu.offset
        imu = arrived.imu.measured(before.time - offset, state.time - offset)
        self.score.predict(before, state, predicted.transition, predicted.noise, imu)
        self.score.measured(measurements, state, self.aiding.rejected)

    def _update_monitor(
        self, before: State, predicted: Propagated, state: State, measured: EpochMeasurements | None
    ) -> None:
        if self.metal.single and not self.metal.near:
            self._dead_reckoning.update(before, predicted, state)
        elapsed, accel = predicted.state.time - before.time, None
        if elapsed > 0.0 and not predicted.gap_bridged:
            gained = predicted.state.velocity_world - before.velocity_world
            accel = gained / elapsed + before.world_from_body @ before.accel_bias_body
        static = None if measured is None else measured.static
        repeats = 1.0 if measured is None else measured.repeats
        self.monitor.update(state, self.gate, EpochSummary(accel, elapsed, static, repeats))

    def _separate(
        self, predicted: Propagated | None, measurements: list[Measurement], state: State
    ) -> None:
        """Propagate the filters without each beacon; without a prediction they start again."""
        if self.bank is None:
            return
        if predicted is None:
            self.bank.reset()
        else:
            self.bank.absorb(predicted, measurements, state)

    def _judge_state(self, state: State, lost_since: float | None) -> Judgement:
        fixed = self.score.judgement_of(state)
        findings = self.monitor.judgement(state, self.gate, lost_since, fixed)
        findings = findings.with_findings(
            *self.metal.judgement().findings,
            *self.of_currents,
            *self.gate.watch.findings(),
            *self.settlement.findings(),
            *_of_place(self.site, state),
            *self._roll,
        )
        findings = self.aiding.assessed(findings, state.time, self.score.named)
        return findings if self.bank is None else self.bank.with_levels(findings, state)

    def _compare(self, measured: FieldPhasors, samples: FieldSamples, state: State) -> None:
        """Compare the state with a fix from time to time."""
        if self.metal.near:
            return
        requested = self.monitor.needs_second_fix
        if (
            distance := self._comparison.compare(measured, samples, state, requested=requested)
        ) is not None:
            self.monitor.compared(*distance)

    # Loss and recovery

    def _passed(
        self,
        estimator: Estimator,
        predicted: Propagated,
        measured: EpochMeasurements,
        *,
        is_lost: bool,
    ) -> tuple[EpochMeasurements, State | None] | Judgement:
        """Return fields that pass the gate, and the fix where they are linearised, if any.

        If they restart the state, or the last epochs are undone, return the judgement instead.
        `is_lost`: whether the state was lost before.
        """
        state = predicted.state
        if is_lost and self._found_again(estimator, measured, predicted):
            return self._judge_state(estimator.state, None)
        measured, point, refused = self.recovery.linearization_point(measured, state)
        explained, valid = state if point is None else point, measured.samples.valid[0]
        phasors = self._weighed_phasors(measured, explained, requested=point is None)
        if self.metal.comes:
            return self._without_the_last(estimator, predicted)
        phasors = self.gate.passed(phasors, explained, valid, refused)
        measured = replace(measured, phasors=phasors)
        if self.gate.is_lost and self._found_again(estimator, measured, predicted):
            return self._judge_state(estimator.state, None)
        return measured, point

    def _absorbed(
        self,
        estimator: Estimator,
        predicted: Propagated,
        measurements: list[Measurement],
        point: State | None,
    ) -> bool:
        """Update with measurements; if that fails, the state stays as predicted."""
        try:
            estimator.absorb(predicted, measurements, point)
        except EstimationError:
            self.gate.counts["update failed"] += 1
            self.gate.refused_in_a_row += 1
            self.monitor.uncertain("update_failed", predicted.state.time)
            self.score.end()
            estimator.replace_state(predicted.state)
            return False
        return True

    def _found_again(
        self, estimator: Estimator, measured: EpochMeasurements, predicted: Propagated
    ) -> bool:
        """Restart from a fix, if the pose explains no measurement any more."""
        state = self.recovery.restarted(measured, predicted.state)
        if state is None:
            return False
        estimator.replace_state(state)
        self._dead_reckoning.reset()
        self.monitor.reset_motion()
        self.score.end()
        self._separate(None, [], state)
        self._end_loss(predicted.state.time)
        return True

    def _lost_since(self, state: State) -> float | None:
        lost_since, ended = self.recovery.lost_since(state)
        if ended:
            self._end_loss(state.time)
        return lost_since

    def _end_loss(self, time: float) -> None:
        self.recovery.over()
        self.monitor.uncertain("found_again", time)


def _of_place(site: Site, state: State) -> tuple[Finding, ...]:
    if site.bounds is None:
        return ()
    at = np.array([state.time]), state.world_from_body[None], state.position_world[None]
    return of_place(site, *at, state.cov[None, :6, :6])
