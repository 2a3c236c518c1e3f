"""Discontinuity counter of a running estimate, for users of its pose increments."""

import numpy as np
from scipy.special import chdtri

from magfusion.estimation.graph.state import State
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.model.trust import Verdict

UNEXPLAINED = float(chdtri(6, 1e-6))  # squared jump of a pose over its covariance


class DiscontinuityCounter:
    """Counts the jumps of a running estimate.

    It jumps where a lost state is recovered, where another hypothesis replaces it, and where a
    correction is larger than the prior covariance explains. `counter`: jumps so far.
    """

    counter: int
    _is_lost: bool
    _restarts: int

    def __init__(self) -> None:
        self.counter, self._is_lost, self._restarts = 0, False, 0

    def update(
        self, predicted: State, state: State, before: Judgement, now: Judgement, restarts: int
    ) -> bool:
        """Process an update; return whether the estimate jumped.

        `predicted`, `state`: before and after the update, at one time. `before`, `now`: of the
        previous state, and of this one. `restarts`: number of fixes that have replaced the state up
        to now.
        """
        restarted, self._restarts = restarts > self._restarts, restarts
        was_lost, self._is_lost = self._is_lost, now.verdict is Verdict.FAILED
        if self._is_lost:  # there is no pose that could jump
            return False
        jumped = was_lost or restarted or unexplained(predicted, state, before)
        self.counter += jumped
        return jumped


def unexplained(predicted: State, state: State, before: Judgement) -> bool:
    """Return whether a pose moved by more than its covariance explains, at one time."""
    step = predicted.pose.localCoordinates(state.pose)
    cov = before.honest(predicted.cov[:6, :6])
    return bool(step @ np.linalg.solve(cov, step) > UNEXPLAINED)
