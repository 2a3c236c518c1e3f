"""The score test as the data arrive: what an online estimate holds is asked at every epoch.

What a parameter that is held may be wrong by goes into the state through the gain, epoch after
epoch, and shows in each innovation in a way of its own (the generalised likelihood ratio of Willsky
and Jones 1976, doi 10.1109/TAC.1976.1101146).  With that response carried on beside the state, the
innovations make the same information and gradient that `magfusion.estimation.integrity.score` has
of a whole log, at the cost of one more product of matrices.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from magfusion.estimation.integrity.held import COVERED, Freed, finding_of, freed_by, gains
from magfusion.estimation.integrity.judgement import Judgement
from magfusion.estimation.integrity.score import Score
from magfusion.estimation.integrity.statistics import SURE
from magfusion.estimation.integrity.suspects import (
    Inertial,
    Stream,
    Suspect,
    held_blocks,
    suspects,
)
from magfusion.estimation.measurements.measurement import Measurement
from magfusion.estimation.state import MOTION, State, states_of
from magfusion.model.parameters import Block, dimension, prior_sigma
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.units import Array

MEMORY = 60.0  # s; older innovations count less, for what is wrong may have changed
ASKED_EVERY = 2.0  # s


@dataclass(frozen=True, eq=False)
class Sums:
    """Of the innovations up to now, in typical errors of what is held.

    Parameters
    ----------
    information : ndarray, shape (h, h)
    gradient : ndarray, shape (h,)
    response : ndarray, shape (15 + estimated, h)
        What a unit of an error in them has done to the state.
    time : float
        (s)
    """

    information: Array
    gradient: Array
    response: Array
    time: float


class OnlineScore:
    """Of everything that a running estimate holds.

    Parameters
    ----------
    estimated, considered : tuple of Block
        Calibration parameters in the state's tangent.
    steady : bool
        Whether the steady field is measured.
    """

    _sums: Sums | None
    _asked_at: float
    _said: Judgement

    def __init__(
        self,
        site: Site,
        estimated: tuple[Block, ...],
        considered: tuple[Block, ...],
        *,
        steady: bool,
    ) -> None:
        self.site, self.held = site, held_blocks(site, estimated, steady=steady)
        self.unit, self.size = prior_sigma(self.held), MOTION + dimension(estimated)
        at = MOTION + dimension((*estimated, *considered))
        self.blocks = tuple(
            b._replace(columns=slice(at - MOTION + b.columns.start, at - MOTION + b.columns.stop))
            for b in self.held
        )
        self.asked, self.whole = (*estimated, *considered, *self.blocks), at
        self.spread = self._declared(considered)
        self._sums, self._asked_at, self._said = None, -np.inf, Judgement()

    @cached_property
    def suspects(self) -> tuple[Suspect, ...]:
        """What one mistake would have wrong; of many beacons it takes gigabytes, so if asked."""
        return tuple(suspects(self.site, self.held))

    @cached_property
    def _combine(self) -> Array:
        most = max((one.combine.shape[1] for one in self.suspects), default=0)
        every = np.zeros((len(self.suspects), dimension(self.held), most))
        for room, one in zip(every, self.suspects, strict=True):
            room[:, : one.combine.shape[1]] = one.combine
        return every

    def _declared(self, considered: tuple[Block, ...]) -> Array:
        """Return a root of the covariance that the site declares of what is held."""
        if not considered:
            return np.zeros((len(self.unit), 0))
        start = considered[0].columns.start
        own = tuple(
            b._replace(columns=slice(b.columns.start - start, b.columns.stop - start))
            for b in considered
        )
        spread = prior_sqrt_covariance(self.site, own)
        at, out = {b.key: b.columns for b in self.held}, np.zeros((len(self.unit), len(spread)))
        for block in own:
            if block.key in at:
                out[at[block.key]] = spread[block.columns]
        return out / self.unit[:, None]

    def begin(self, score: Score | None, time: float) -> None:
        """Go on from the score of the smoothed beginning, at its last state (s)."""
        alike = score is not None and [b.key for b in score.held] == [b.key for b in self.held]
        if score is None or not alike or not self.held:
            return
        response = -np.concatenate([score.by_state[-1], score.by_calibration])
        self._sums = Sums(score.information, score.gradient, response, time)

    def end(self) -> None:
        """Hear no more: the state has come from elsewhere, and its response is not known.

        What was said of the site stays said.
        """
        self._sums = None

    def foresee(self, measurement: Measurement, predicted: State) -> None:
        """Predict a measurement for all that is asked: who asks for less of it finds it there."""
        if self._sums is not None:
            measurement.linearize(states_of([predicted]), predicted.calibration, self.asked)

    def predict(self, before: State, after: State, transition: Array, imu: ImuSamples) -> None:
        """Carry the response on to a prediction.

        Parameters
        ----------
        transition : ndarray, shape (n, n)
            Of the tangent.
        imu : ImuSamples
            Of the interval.
        """
        sums = self._sums
        if sums is None:
            return
        own = slice(0, self.size)
        response = transition[own, own] @ sums.response
        if len(imu):
            time, gyro, accel = np.zeros(1), imu.gyro_body, imu.accel_body
            mean = ImuSamples(time, np.mean(gyro, axis=0)[None], np.mean(accel, axis=0)[None])
            stream = Stream(mean, np.stack([before.world_from_body, after.world_from_body]))
            by_bias = transition[:9, 9:MOTION]
            for block in self.held:
                if isinstance(block.parameter, Inertial):
                    unit = self.unit[block.columns]
                    bias = block.parameter.as_bias(stream)[0] * unit
                    response[:9, block.columns] -= by_bias @ bias
        kept = float(np.exp(-max(0.0, after.time - sums.time) / MEMORY))
        self._sums = Sums(
            kept * sums.information, kept * sums.gradient, response, max(after.time, sums.time)
        )

    def measured(self, measurements: Sequence[Measurement], predicted: State) -> None:
        """Take in the innovations of an epoch, as the gate has left them."""
        sums = self._sums
        if sums is None or not measurements:
            return
        errors, jacobians = [], []
        blocks, width = self.asked, self.whole - MOTION + len(self.unit)
        for measurement in measurements:
            rows = measurement.linearize(states_of([predicted]), predicted.calibration, blocks)
            rows, _ = rows.weighed(measurement.loss)
            jacobian = rows.jacobian(width).reshape(-1, MOTION + width)
            told = np.any(jacobian[:, : self.whole] != 0.0, axis=1)
            errors.append(rows.error.reshape(-1)[told])
            jacobians.append(jacobian[told])
        error, jacobian = np.concatenate(errors), np.concatenate(jacobians)
        if not len(error):
            return
        own, cov = slice(0, self.size), predicted.cov
        by_state, by_held = jacobian[:, : self.whole], jacobian[:, self.whole :] * self.unit
        across = by_state @ cov
        innovation = across @ by_state.T + np.eye(len(error))
        known = across[:, own] @ by_state[:, own].T
        if self.size < self.whole:
            rest = slice(self.size, self.whole)
            learnt = np.linalg.solve(cov[rest, rest], cov[rest, own])
            alone = cov[own, own] - cov[own, rest] @ learnt
            known = by_state[:, own] @ alone @ by_state[:, own].T
        known = known + np.eye(len(error))
        shown = by_state[:, own] @ sums.response - by_held
        solved = np.linalg.solve(0.5 * (known + known.T), np.column_stack([shown, error]))
        gain = np.linalg.solve(innovation, across[:, own]).T
        found = replace(
            sums,
            information=sums.information + shown.T @ solved[:, :-1],
            gradient=sums.gradient + shown.T @ solved[:, -1],
            response=sums.response - gain @ shown,
        )
        finite = all(np.all(np.isfinite(v)) for v in (found.information, found.response))
        self._sums = found if finite else None

    def said_of(self, state: State) -> Judgement:
        """Return what the score says of a state; asked now and then."""
        if self._sums is not None and state.time >= self._asked_at + ASKED_EVERY:
            self._asked_at, self._said = state.time, self._ask(self._sums, state)
        return self._said

    def _ask(self, sums: Sums, state: State) -> Judgement:
        pose_cov = state.cov[None, :6, :6]
        information = 0.5 * (sums.information + sums.information.T)
        by = -sums.response
        score = Score(
            self.held, information, sums.gradient, self.spread, by[None, :MOTION], by[MOTION:]
        )
        information, gradient = score.with_declared()
        asked = np.flatnonzero(gains(self._combine, information, gradient) > 0.0)
        found = (
            freed_by(pose_cov, score, self.suspects[k], information, gradient)
            for k in asked.tolist()
        )
        likely = [one for one in found if one is not None and _speaks(one)]
        if not likely:
            return Judgement()
        cause = max(likely, key=lambda one: one.gain)
        turn, shift = np.linalg.norm(cause.moved[0].reshape(2, 3), axis=1)
        finding = finding_of(self.site, score, cause)
        return Judgement((finding,), turn=float(turn), shift=float(shift))


def _speaks(one: Freed) -> bool:
    return one.gain > 0.0 and float(one.distance[0]) > COVERED and one.log_p < np.log(SURE)
