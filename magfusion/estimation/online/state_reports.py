"""The states that a navigator reports, each with the judgement of its own time."""

from collections import deque

import numpy as np

from magfusion.estimation.graph.state import State
from magfusion.estimation.online_integrity.discontinuity_counter import DiscontinuityCounter
from magfusion.estimation.online_integrity.judgement import (
    JudgedState,
    Judgement,
    TimedJudgement,
    judged_state,
)
from magfusion.estimation.online_integrity.summary import Summary


class StateReports:
    """States of epochs, not taken yet, and what is known of all.

    `lagged`: whether states are reported again when they leave a window. `judgement`: of the newest
    state. `until`: time of the last state that was taken (s).
    """

    judgement: Judgement
    discontinuities: DiscontinuityCounter
    summary: Summary
    until: float
    _pending: list[JudgedState]
    _timed_judgements: deque[TimedJudgement]

    def __init__(self, *, lagged: bool) -> None:
        self._lagged = lagged
        self.judgement, self._pending, self._timed_judgements = Judgement(), [], deque()
        self.discontinuities, self.summary = DiscontinuityCounter(), Summary()
        self.until = -np.inf

    @property
    def reset_counter(self) -> int:
        """Number of jumps up to the newest state."""
        return self.discontinuities.counter

    def store(self, state: State, judgement: Judgement) -> None:
        """Add the state of an epoch."""
        self.judgement = judgement
        self._pending.append(self.with_judgement(state))
        self.summary.note(state.time, judgement)
        if self._lagged:
            timed = TimedJudgement(state.time, judgement, self.reset_counter)
            self._timed_judgements.append(timed)

    def with_judgement(self, state: State) -> JudgedState:
        """Return a state with the judgement of the newest."""
        return judged_state(state, self.judgement, self.reset_counter)

    def take(self) -> list[JudgedState]:
        """Return the states since the last call."""
        result, self._pending = self._pending, []
        self.until = result[-1].time if result else self.until
        return result

    def drop_until(self, time: float) -> None:
        """Drop states up to a time (s)."""
        self._pending = [state for state in self._pending if state.time > time]

    def with_own_judgement(self, state: State) -> JudgedState:
        """Return a state with the judgement of its own time; earlier judgements are discarded."""
        timed = self._timed_judgements
        while len(timed) > 1 and timed[1].time <= state.time:
            timed.popleft()
        then = timed[0] if timed else TimedJudgement(state.time, Judgement())
        return judged_state(state, then.judgement, then.reset_counter)
