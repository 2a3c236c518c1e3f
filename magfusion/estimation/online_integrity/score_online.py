"""Online score test: tests the fixed parameters of a running estimate at every epoch.

An error of a fixed parameter enters the state through the gain, epoch after epoch, and has a
signature of its own in the innovations (the generalised likelihood ratio of Willsky and Jones 1976,
doi 10.1109/TAC.1976.1101146).  This response is propagated with the state; the innovations then
yield the information and gradient that `magfusion.estimation.integrity.score` has of a whole log,
for one more matrix product.  Epochs are pending until a result is requested.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.state import MOTION, POSITION, ROTATION, State, states_of
from magfusion.estimation.integrity.change_detection import CHANGED, change_finding
from magfusion.estimation.integrity.corrected_site import with_bias_walk
from magfusion.estimation.integrity.correction import Correction, Rival, corrections, open_rivals
from magfusion.estimation.integrity.fault_candidates import FaultCandidate
from magfusion.estimation.integrity.fixed_parameter_test import (
    MIN_EVIDENCE,
    NamedCause,
    causes_of,
    finding_of,
)
from magfusion.estimation.integrity.released_fault import ReleasedFault
from magfusion.estimation.integrity.score import Score
from magfusion.estimation.integrity.steel_test import STEEL, steel_of_score
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.measurements.steel import region_modes
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.recent_steps import RecentSteps
from magfusion.estimation.online_integrity.score_epochs import (
    MEMORY,
    Epoch,
    Sums,
    add_epochs,
    new_sums,
    passed,
)
from magfusion.estimation.online_integrity.score_targets import (
    ScoreTargets,
    beacons_in,
    of_beacons_named,
)
from magfusion.model.detection_range import are_many
from magfusion.model.parameters import CLOCK_RATE, TIME_OFFSET, BeaconParameter, Block, prior_sigma
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.units import Array

MIN_SCORE_INTERVAL, MAX_SCORE_INTERVAL = 1.0, 20.0  # s; shortest and longest interval of results
ENOUGH = 4  # epochs for the shortest interval
MAX_WAITING = 10  # epochs; larger batches would delay an update


class OnlineScore:
    """Score test of a running estimate's fixed parameters; of many beacons, of detected ones.

    `estimated`, `considered`: calibration parameters in the state's tangent. `static`: whether the
    static field is measured. Attribute `correction`: of the cause in the last result, if there is
    one.
    """

    _sums: Sums | None
    _detected_at: dict[str, float]
    _scored_at: float
    _epochs_since_score: int  # epochs since the last result
    _judgement: Judgement
    # owners of the parameters in the last result: of the cause, and what explains it as well
    named: tuple[str, ...]

    def __init__(
        self,
        site: Site,
        estimated: tuple[Block, ...],
        considered: tuple[Block, ...],
        *,
        static: bool,
    ) -> None:
        self.site, self._tangent, self._static = site, (estimated, considered), static
        self._each_alone = any(b.parameter not in (TIME_OFFSET, CLOCK_RATE) for b in estimated)
        self._sums, self._scored_at, self._judgement = None, -np.inf, Judgement()
        self._waiting: list[Epoch] = []
        self._epochs_since_score = 0
        self._result: tuple[Sums, Score] | None = None  # the last
        self._evidence: tuple[Array, Array] | None = None  # of it, once requested
        self._detected_at = {}
        self.correction: Correction | None = None
        self.named = ()
        self._steps, self._steel = RecentSteps(site, estimated), region_modes(site)
        self._targets = self._targets_of(() if are_many(site) else [b.name for b in site.beacons])

    @property
    def is_steel(self) -> bool:
        """Whether the last result is steel."""
        return any(finding.code == STEEL for finding in self._judgement.findings)

    @property
    def targets(self) -> ScoreTargets:
        """Parameters that are tested at present."""
        if are_many(self.site) and self._targets.names != tuple(self._detected_at):
            self._targets = self._targets_of(self._detected_at)
        return self._targets

    def _targets_of(self, names: Iterable[str]) -> ScoreTargets:
        estimated, considered = self._tangent
        site = of_beacons_named(self.site, names)
        steel = self._steel
        return ScoreTargets(site, estimated, considered, static=self._static, steel=steel)

    def begin(self, score: Score | None, state: State) -> None:
        """Continue from the score of the smoothed beginning, at its last state."""
        if score is None:
            return
        time = state.time
        if are_many(self.site):
            names = {b.owner for b in score.fixed if isinstance(b.parameter, BeaconParameter)}
            self._detected_at = {b.name: time for b in self.site.beacons if b.name in names}
        targets = self.targets
        shared = [b.key for b in score.fixed] == [b.key for b in targets.fixed_blocks]
        if not shared or not targets.fixed_blocks:
            return
        response = -np.concatenate([score.by_state[-1], score.by_calibration])
        cov = _given_considered(state.cov, targets.size)
        self._sums = new_sums(score.information, score.gradient, response, time, cov)
        self._waiting = []

    def end(self) -> None:
        """Stop the test: the state was replaced, and its response is not known.

        The last result is kept.
        """
        self._sums, self._waiting = None, []

    def foresee(self, measurement: Measurement, predicted: State) -> None:
        """Predict all that the test needs, so that other users share the prediction.

        With few beacons and a constant calibration, pending epochs are predicted together.
        """
        if self._sums is None or not (self._each_alone or are_many(self.site)):
            return
        self._select_beacons([measurement], predicted.time)
        at = states_of([predicted]), predicted.calibration, self.targets.parameters
        if isinstance(measurement, FieldPhasors):
            measurement.predicted.of(measurement, *at)
        else:
            measurement.linearize(*at)

    def _select_beacons(self, measurements: Sequence[Measurement], time: float) -> None:
        """Test the detected ones among many beacons, and drop those long undetected."""
        if self._sums is None or not are_many(self.site):
            return
        known = self._detected_at | dict.fromkeys(beacons_in(measurements, self.site), time)
        kept = {name: known[name] for name in known if known[name] > time - MEMORY}
        if kept.keys() <= self._detected_at.keys():  # no new beacon: keeping the others is as cheap
            self._detected_at = {name: known[name] for name in self._detected_at}
            return
        sums, before = self.settle(), self.targets
        if sums is None:
            return
        self._detected_at = {b.name: kept[b.name] for b in self.site.beacons if b.name in kept}
        targets = self.targets
        here, there = targets.among(before)
        information = np.zeros((len(targets.unit),) * 2)
        gradient, response = information[0].copy(), np.zeros((targets.size, len(targets.unit)))
        exact = response.copy()
        information[np.ix_(here, here)] = sums.information[np.ix_(there, there)]
        gradient[here], response[:, here] = sums.gradient[there], sums.response[:, there]
        exact[:, here] = sums.exact_response[:, there]
        self._sums = replace(
            sums,
            information=information,
            gradient=gradient,
            response=response,
            exact_response=exact,
            onsets=(),
        )

    def predict(
        self, before: State, after: State, transition: Array, noise: Array, imu: ImuSamples
    ) -> None:
        """Propagate the response to a prediction.

        `transition`, `noise` (n, n): of the tangent. `imu`: of the interval.
        """
        if self._sums is not None:
            self._waiting.append(Epoch(after, passed(before, after, transition, noise, imu)))

    def measured(
        self,
        measurements: Sequence[Measurement],
        predicted: State,
        rejected: Sequence[Measurement] = (),
    ) -> None:
        """Process the innovations of an epoch, after the gate, and those of rejected samples."""
        self._select_beacons(measurements, predicted.time)
        if self._sums is None or not (measurements or rejected):
            return
        led = None
        if self._waiting and self._waiting[-1].predicted is predicted:
            led = self._waiting.pop().passed
        self._waiting.append(Epoch(predicted, led, tuple(measurements), tuple(rejected)))
        self._epochs_since_score += 1
        if self._steps.is_due(self._sums, predicted.time) and (sums := self.settle()) is not None:
            self._sums = self._steps.with_onset(sums)
        if are_many(self.site) or len(self._waiting) >= MAX_WAITING:
            self.settle()

    def settle(self) -> Sums | None:
        """Process the pending epochs, and return the sums, which a checkpoint stores."""
        waiting, self._waiting = self._waiting, []
        if self._sums is not None and waiting:
            result = add_epochs(self._sums, waiting, self.targets)
            finite = all(np.all(np.isfinite(v)) for v in (result.information, result.response))
            self._sums = result if finite else None
        return self._sums

    def judgement_of(self, state: State) -> Judgement:
        """Return the judgement of a state by the test, updated now and then."""
        wait = MIN_SCORE_INTERVAL if self._epochs_since_score >= ENOUGH else MAX_SCORE_INTERVAL
        if state.time >= self._scored_at + wait and (sums := self.settle()) is not None:
            self._scored_at, self._epochs_since_score, self._judgement = (
                state.time,
                0,
                self._evaluate(sums, state),
            )
        return self._judgement

    def _evaluate(self, sums: Sums, state: State) -> Judgement:
        pose_cov, targets = state.cov[None, :6, :6], self.targets
        information = 0.5 * (sums.information + sums.information.T)
        by, size = -sums.response, len(targets.unit)
        steps = self._steps.blocks(sums.onsets, size)
        more = ((0, len(information) - size), (0, 0))  # rows of the steps
        score = Score(
            (*targets.fixed_blocks, *steps),
            information,
            sums.gradient,
            np.pad(targets.spread, more),
            by[None, :MOTION],
            by[MOTION:],
        )

        def candidates(information: Array, gradient: Array) -> list[FaultCandidate]:
            gained = np.flatnonzero(targets.gains(information, gradient) > 0.0)
            known = [targets.fault_candidates[k] for k in gained.tolist()]
            fixed = [one._replace(combine=np.pad(one.combine, more)) for one in known]
            return [*fixed, *self._steps.candidates(steps, information, gradient)]

        self._result, self._evidence = (sums, score), None
        causes = list(causes_of(pose_cov, score, candidates))
        self.correction, self.named = None, ()
        if targets.steel and (bent := self._steel_of(score, causes)) is not None:
            return bent
        if not causes:
            return Judgement()
        cause, rivals = causes[0].cause, causes[0].rivals
        self.named = tuple(sorted({b.owner for one in (cause, *rivals) for b in one.fault.blocks}))
        turn, shift = np.linalg.norm(cause.moved[0].reshape(2, 3), axis=1)
        if cause.code == CHANGED:
            finding = change_finding(cause, prior_sigma(score.fixed))
            if (site := with_bias_walk(self.site, cause)) is not self.site:
                self.correction = Correction(finding, site)
            return Judgement((finding,), turn=float(turn), shift=float(shift))
        self.correction = self._correction_of(score, cause, rivals)
        return Judgement((self.correction.finding,), turn=float(turn), shift=float(shift))

    def _correction_of(
        self, score: Score, cause: ReleasedFault, rivals: list[ReleasedFault]
    ) -> Correction:
        finding = finding_of(self.targets.site, cause, rivals)
        (correction,) = corrections(self.site, (finding,), (cause, *rivals), None)
        spread = score.by_pose @ cause.known_cov @ np.swapaxes(score.by_pose, 1, 2)
        other = next((one for one in rivals if one.code != CHANGED), None)
        instead = None if other is None else self._correction_of(score, other, [])
        return correction._replace(step_spread=spread, alternative=instead)

    def open_rivals(self, correction: Correction) -> list[Rival]:
        """Return the rivals of a correction that the data do not refute up to the last result."""
        if self._result is None:
            return list(correction.rivals)
        if self._evidence is None:
            self._evidence = self._result[1].with_declared(tolerance=False)
        return open_rivals(correction, self.targets.fault_candidates, *self._evidence)

    def _steel_of(self, score: Score, named: Sequence[NamedCause]) -> Judgement | None:
        """Return the judgement by steel; None if it does not explain the data better."""
        best = np.max(self.targets.gains(*score.with_declared(tolerance=False)), initial=0.0)
        rival = max(float(best), sum(one.cause.gain for one in named))
        estimate = None if rival < MIN_EVIDENCE else steel_of_score(score, rival)
        if estimate is None:
            return None
        largest = [
            np.linalg.eigvalsh(estimate.spread[0, part, part])[-1] for part in (ROTATION, POSITION)
        ]
        turn, shift = np.sqrt(np.maximum(largest, 0.0)).tolist()
        return Judgement((estimate.finding(self.site),), turn=turn, shift=shift)


def _given_considered(cov: Array, size: int) -> Array:
    """Return the covariance of the first numbers of a state given the others, (size, size)."""
    across = cov[size:, :size]
    return np.asarray(cov[:size, :size] - across.T @ np.linalg.solve(cov[size:, size:], across))
