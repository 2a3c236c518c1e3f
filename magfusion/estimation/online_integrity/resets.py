"""Whether a running estimate went on or jumped, for those who follow it by its changes."""

import numpy as np
from scipy.special import chdtri

from magfusion.estimation.graph.state import State
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.model.trust import Verdict

UNEXPLAINED = float(chdtri(6, 1e-6))  # squared jump of a pose in units of what it was known to


class Resets:
    """Counts the jumps of a running estimate.

    It jumps where it was lost and is found again, where another hypothesis takes its place, and
    where a correction is larger than the covariance of the state before it explains.

    Attributes
    ----------
    counter : int
        Jumps so far.
    """

    counter: int
    _lost: bool
    _restarts: int

    def __init__(self) -> None:
        self.counter, self._lost, self._restarts = 0, False, 0

    def hear(
        self, predicted: State, state: State, before: Judgement, now: Judgement, restarts: int
    ) -> bool:
        """Take in an update; return whether the estimate jumped there.

        Parameters
        ----------
        predicted, state : State
            Before and after it, at one time.
        before, now : Judgement
            What was said of the last state, and of this.
        restarts : int
            How often a fix has taken the state's place, up to now.
        """
        anew, self._restarts = restarts > self._restarts, restarts
        was_lost, self._lost = self._lost, now.verdict is Verdict.FAILED
        if self._lost:  # there is no pose that could jump
            return False
        jumped = was_lost or anew or unexplained(predicted, state, before)
        self.counter += jumped
        return jumped


def unexplained(predicted: State, state: State, before: Judgement) -> bool:
    """Tell whether a pose moved by more than it was known to, at one time."""
    step = predicted.pose.localCoordinates(state.pose)
    cov = before.honest(predicted.cov[:6, :6])
    return bool(step @ np.linalg.solve(cov, step) > UNEXPLAINED)
