"""The current state: the newest estimate, propagated by every inertial sample, as output."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.graph.state import State
from magfusion.estimation.online.constant_motion_model import ConstantMotionModel
from magfusion.estimation.online.correction_smoothing import CorrectionSmoother
from magfusion.estimation.online.motion_prior_prediction import ahead_by_prior
from magfusion.estimation.online.navigator_settings import NavigatorSettings
from magfusion.estimation.online.propagated import (
    Passage,
    PropagationStart,
    ahead,
    in_tangent,
    initial_passage,
    propagate_passage,
    states_along,
)
from magfusion.estimation.online.queue.inertial_stream import InertialStream
from magfusion.estimation.online_integrity.bank import SubsetBank
from magfusion.estimation.online_integrity.judgement import (
    JudgedState,
    Judgement,
    judged_state,
    parts_of,
)
from magfusion.estimation.online_integrity.levels import Levels
from magfusion.model.short_repr import short_repr
from magfusion.units import DEGREE, Array


@dataclass(frozen=True, eq=False)
class PropagatedState(JudgedState):
    """A state that is propagated by inertial samples."""

    __repr__ = short_repr

    epoch: float = 0.0  # time of the estimate that was propagated (s)


@dataclass(frozen=True, eq=False)
class EpochReport:
    """Judgement and levels that all states propagated from one epoch share."""

    judgement: Judgement
    reset_counter: int
    bank: SubsetBank | None  # the filters that exclude each beacon, of that epoch


class StateOfNow:
    """Propagates the newest estimate to the newest inertial sample, or ahead of it.

    `pending`: at the requested rate, in order of time.
    """

    pending: list[PropagatedState]
    _stamp: float  # of the newest sample, or instant, with a state
    _until: float  # time of the newest state (s)
    _smoother: CorrectionSmoother
    _motion_model: ConstantMotionModel

    def __init__(self, settings: NavigatorSettings) -> None:
        self.rate, self.horizon = settings.rate, settings.horizon
        self.pending, self._stamp, self._until = [], -np.inf, -np.inf
        self._smoother, self._motion_model = (
            CorrectionSmoother(settings.correction_time),
            ConstantMotionModel(settings.horizon),
        )
        self._start: PropagationStart | None = None
        self._report = EpochReport(Judgement(), 0, None)
        self._last: Passage | None = None
        self._newest: State | None = None  # of the newest sample, before a correction

    def restart_from(
        self, start: PropagationStart, report: EpochReport, imu: InertialStream
    ) -> None:
        """Continue from the state of a new epoch, which may include a correction."""
        jumped = report.reset_counter != self._report.reset_counter
        before = self._newest
        self._start, self._report, self._last = start, report, None
        if self.rate == "field":
            return
        if self._stamp == -np.inf:  # states start with the next sample
            self._stamp = self._reached(imu)
        if self.horizon > 0.0:
            self._motion_model.update(imu.measured())
        if self._smoother.length == 0.0:
            return
        if jumped:
            self._smoother.reset()
        elif before is not None and before.time - self.horizon > start.state.time:
            passage = self._passage(imu, np.array([before.time - self.horizon]))
            (corrected,) = states_along(start, self._ahead(passage, self.horizon))
            self._smoother.take(before, corrected)

    def reach(self, imu: InertialStream) -> None:
        """Propagate the state to the inertial samples that have arrived."""
        if self.rate == "field" or self._start is None:
            return
        wanted = self._wanted(imu)
        if len(wanted) == 0:
            return
        self._stamp = float(wanted[-1])
        if self.rate == "imu":
            wanted = wanted + imu.offset
        # Another time offset may go back in time.
        wanted = wanted[wanted > max(self._start.state.time, self._until)]
        if len(wanted) == 0:
            return
        self._until = float(wanted[-1])
        self.pending += self._judge_states(self._passage(imu, wanted), self.horizon)
        self._newest = self.pending[-1]

    def at(self, imu: InertialStream, time: float) -> JudgedState:
        """Return the state at any time since the epoch (s)."""
        assert self._start is not None
        newest = max(imu.reached, self._start.state.time)
        passage = self._passage(imu, np.array([min(time, newest)]))
        if time > newest:
            self._motion_model.update(imu.measured())
        return self._judge_states(passage, max(time - newest, 0.0))[0]

    def _reached(self, imu: InertialStream) -> float:
        return imu.newest if self.rate == "imu" else imu.reached

    def _wanted(self, imu: InertialStream) -> Array:
        """Return the stamps of samples, or instants, for new states."""
        if self.rate == "imu":
            stamps, _ = imu.buffer.rows()
            return stamps[np.searchsorted(stamps, self._stamp, side="right") :]
        assert not isinstance(self.rate, str)
        first = np.floor(self._stamp * self.rate + 1e-6) + 1.0
        last = np.floor(imu.reached * self.rate + 1e-6)
        return np.arange(first, last + 1.0) / self.rate

    def _passage(self, imu: InertialStream, wanted: Array) -> Passage:
        """Return the passage at some times, continued from the last propagation."""
        start, last = self._start, self._last
        assert start is not None
        if last is None or wanted[0] < last.time[0]:
            last = initial_passage(start)
        begin, offset = float(last.time[0]) - start.time_offset, start.time_offset
        end = max(float(wanted[-1]) - offset, imu.newest)
        blind = imu.is_filled(begin, end)
        passage, newest = propagate_passage(
            start, last, imu.filled(begin, end), np.maximum(wanted, last.time), blind=blind
        )
        if self._last is None or newest.time[0] > self._last.time[0]:
            self._last = newest
        return passage

    def _ahead(self, passage: Passage, horizon: float) -> Passage:
        if horizon == 0.0:
            return passage
        assert self._start is not None
        site = self._start.site
        if not site.platform.inertial:
            return ahead_by_prior(passage, horizon, site.platform.imu)
        return ahead(passage, horizon, site.gravity, self._motion_model.cov(horizon))

    def _judge_states(self, passage: Passage, horizon: float) -> list[PropagatedState]:
        start, report = self._start, self._report
        assert start is not None
        passage = self._ahead(passage, horizon)
        grown = np.ones((len(passage), 2))
        if report.bank is not None and report.judgement.protection_level_m is not None:
            grown = report.bank.grown(*in_tangent(passage))
        result = []
        for state, more in zip(states_along(start, passage), grown.tolist(), strict=True):
            own, step = (
                self._smoother.smoothed(state)
                if self._smoother.length > 0.0
                else (state, np.zeros(9))
            )
            judgement = _wider(report.judgement, more, step)
            reported = judged_state(own, judgement, report.reset_counter)
            result.append(PropagatedState(**parts_of(reported), epoch=start.state.time))
        return result


def _wider(judgement: Judgement, grown: list[float], step: Array) -> Judgement:
    """Return a judgement whose levels are scaled, attitude first, and shifted by an offset."""
    metres, degrees = judgement.protection_level_m, judgement.protection_level_deg
    if metres is None and degrees is None:
        return judgement
    turn, shift = (float(np.linalg.norm(part)) for part in (step[:3], step[3:6]))
    return replace(
        judgement,
        levels=Levels(
            (
                None if metres is None else metres * grown[1] + shift,
                None if degrees is None else degrees * grown[0] + turn / DEGREE,
            )
        ),
    )
