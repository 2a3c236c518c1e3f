"""Online score test: tests the fixed parameters of a running estimate at every epoch.

An error of a fixed parameter enters the state through the gain, epoch after epoch, and has a
signature of its own in the innovations (the generalised likelihood ratio of Willsky and Jones 1976,
doi 10.1109/TAC.1976.1101146).  This response is propagated with the state; the innovations then
yield the information and gradient that `magfusion.estimation.integrity.score` has of a whole log,
for one more matrix product.  Epochs are pending until a result is requested.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from magfusion.estimation.data_checks.statistics import SURE
from magfusion.estimation.graph.measurement import Measurement
from magfusion.estimation.graph.state import MOTION, State, states_of
from magfusion.estimation.integrity.held import COVERED, Freed, finding_of, freed_by
from magfusion.estimation.integrity.score import Score
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.online_integrity.asked import Asked, heard_in, of_beacons_named
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.score_epochs import MEMORY, Epoch, Sums, heard, passed
from magfusion.model.audibility import are_many
from magfusion.model.parameters import CLOCK_RATE, TIME_OFFSET, BeaconParameter, Block
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.units import Array

ASKED_EVERY, ASKED_AFTER = 2.0, 20.0  # s; shortest and longest interval of results
ENOUGH = 5  # epochs for the shortest interval
MOST_WAITING = 10  # epochs; larger batches would delay an update


class OnlineScore:
    """Score test of a running estimate's fixed parameters; of many beacons, of detected ones.

    Parameters
    ----------
    estimated, considered : tuple of Block
        Calibration parameters in the state's tangent.
    steady : bool
        Whether the static field is measured.
    """

    _sums: Sums | None
    _heard_at: dict[str, float]
    _asked_at: float
    _unasked: int  # epochs since the last result
    _said: Judgement

    def __init__(
        self,
        site: Site,
        estimated: tuple[Block, ...],
        considered: tuple[Block, ...],
        *,
        steady: bool,
    ) -> None:
        self.site, self._tangent, self._steady = site, (estimated, considered), steady
        self._each_alone = any(b.parameter not in (TIME_OFFSET, CLOCK_RATE) for b in estimated)
        self._sums, self._asked_at, self._said = None, -np.inf, Judgement()
        self._waiting: list[Epoch] = []
        self._unasked = 0
        self._heard_at = {}
        self._made = self._asked_of(() if are_many(site) else [b.name for b in site.beacons])

    @property
    def asked(self) -> Asked:
        """Parameters that are tested at present."""
        if are_many(self.site) and self._made.names != tuple(self._heard_at):
            self._made = self._asked_of(self._heard_at)
        return self._made

    def _asked_of(self, names: Iterable[str]) -> Asked:
        estimated, considered = self._tangent
        site = of_beacons_named(self.site, names)
        return Asked(site, estimated, considered, steady=self._steady)

    def begin(self, score: Score | None, time: float) -> None:
        """Continue from the score of the smoothed beginning, at its last state (s)."""
        if score is None:
            return
        if are_many(self.site):
            names = {b.owner for b in score.held if isinstance(b.parameter, BeaconParameter)}
            self._heard_at = {b.name: time for b in self.site.beacons if b.name in names}
        asked = self.asked
        alike = [b.key for b in score.held] == [b.key for b in asked.held]
        if not alike or not asked.held:
            return
        response = -np.concatenate([score.by_state[-1], score.by_calibration])
        self._sums, self._waiting = Sums(score.information, score.gradient, response, time), []

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
        self._hear([measurement], predicted.time)
        at = states_of([predicted]), predicted.calibration, self.asked.asked
        if isinstance(measurement, FieldPhasors):
            measurement.predicted.of(measurement, *at)
        else:
            measurement.linearize(*at)

    def _hear(self, measurements: Sequence[Measurement], time: float) -> None:
        """Test the detected ones among many beacons, and drop those long undetected."""
        if self._sums is None or not are_many(self.site):
            return
        known = self._heard_at | dict.fromkeys(heard_in(measurements, self.site), time)
        kept = {name: known[name] for name in known if known[name] > time - MEMORY}
        if kept.keys() <= self._heard_at.keys():  # no new beacon: keeping the others is as cheap
            self._heard_at = {name: known[name] for name in self._heard_at}
            return
        sums, before = self.settle(), self.asked
        if sums is None:
            return
        self._heard_at = {b.name: kept[b.name] for b in self.site.beacons if b.name in kept}
        asked = self.asked
        here, there = asked.among(before)
        information = np.zeros((len(asked.unit),) * 2)
        gradient, response = information[0].copy(), np.zeros((asked.size, len(asked.unit)))
        information[np.ix_(here, here)] = sums.information[np.ix_(there, there)]
        gradient[here], response[:, here] = sums.gradient[there], sums.response[:, there]
        self._sums = Sums(information, gradient, response, sums.time)

    def predict(self, before: State, after: State, transition: Array, imu: ImuSamples) -> None:
        """Propagate the response to a prediction.

        Parameters
        ----------
        transition : ndarray, shape (n, n)
            Of the tangent.
        imu : ImuSamples
            Of the interval.
        """
        if self._sums is not None:
            self._waiting.append(Epoch(after, passed(before, after, transition, imu)))

    def measured(self, measurements: Sequence[Measurement], predicted: State) -> None:
        """Process the innovations of an epoch, after the gate."""
        self._hear(measurements, predicted.time)
        if self._sums is None or not measurements:
            return
        led = None
        if self._waiting and self._waiting[-1].predicted is predicted:
            led = self._waiting.pop().passed
        self._waiting.append(Epoch(predicted, led, tuple(measurements)))
        self._unasked += 1
        if are_many(self.site) or len(self._waiting) >= MOST_WAITING:
            self.settle()

    def settle(self) -> Sums | None:
        """Process the pending epochs, and return the sums, which a checkpoint stores."""
        waiting, self._waiting = self._waiting, []
        if self._sums is not None and waiting:
            found = heard(self._sums, waiting, self.asked)
            finite = all(np.all(np.isfinite(v)) for v in (found.information, found.response))
            self._sums = found if finite else None
        return self._sums

    def said_of(self, state: State) -> Judgement:
        """Return the judgement of a state by the test, updated now and then."""
        wait = ASKED_EVERY if self._unasked >= ENOUGH else ASKED_AFTER
        if state.time >= self._asked_at + wait and (sums := self.settle()) is not None:
            self._asked_at, self._unasked, self._said = state.time, 0, self._ask(sums, state)
        return self._said

    def _ask(self, sums: Sums, state: State) -> Judgement:
        pose_cov, asked = state.cov[None, :6, :6], self.asked
        information = 0.5 * (sums.information + sums.information.T)
        by = -sums.response
        score = Score(
            asked.held, information, sums.gradient, asked.spread, by[None, :MOTION], by[MOTION:]
        )
        information, gradient = score.with_declared()
        told = np.flatnonzero(asked.gains(information, gradient) > 0.0)
        found = (
            freed_by(pose_cov, score, asked.suspects[k], information, gradient)
            for k in told.tolist()
        )
        likely = [one for one in found if one is not None and _speaks(one)]
        if not likely:
            return Judgement()
        cause = max(likely, key=lambda one: one.gain)
        turn, shift = np.linalg.norm(cause.moved[0].reshape(2, 3), axis=1)
        finding = finding_of(asked.site, score, cause)
        return Judgement((finding,), turn=float(turn), shift=float(shift))


def _speaks(one: Freed) -> bool:
    return one.gain > 0.0 and float(one.distance[0]) > COVERED and one.log_p < np.log(SURE)
