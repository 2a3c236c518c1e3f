"""Where the inertial data alone lead from a little while ago: what was measured since, taken back.

A disturbance is noticed some epochs after it began, and those are in the state and in its
covariance.  Beside the estimate runs what its corrections were, carried on as errors are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.graph.propagation import Propagated
from magfusion.estimation.graph.state import State, between, moved
from magfusion.model.parameters import Block
from magfusion.units import Array

LATE = 0.5  # s; after which a disturbance is noticed, at most


@dataclass(frozen=True, eq=False)
class Since:
    """What was taken in since a time.

    Parameters
    ----------
    time : float
        (s)
    correction : ndarray, shape (15 + calibration,)
        Of the state, carried on.
    cov : ndarray, shape (15 + calibration, 15 + calibration)
        Of the state without it.
    """

    time: float
    correction: Array
    cov: Array


class Reckoned:
    """Takes back what was measured in the last half second to a second."""

    _older: Since | None
    _newer: Since | None

    def __init__(self, blocks: Sequence[Block]) -> None:
        self.blocks = tuple(blocks)
        self._older, self._newer = None, None

    def forget(self) -> None:
        """Begin anew: the state has come from elsewhere."""
        self._older = self._newer = None

    def hear(self, before: State, predicted: Propagated, state: State) -> None:
        """Take in an epoch: the states before it, predicted, and updated."""
        step = between(predicted.state, state, self.blocks)
        if self._newer is None or before.time - self._newer.time >= LATE:
            self._older = self._newer
            self._newer = Since(before.time, np.zeros(len(step)), before.cov)
        self._older = None if self._older is None else _carried(self._older, predicted, step)
        self._newer = _carried(self._newer, predicted, step)

    def taken_back(self, predicted: Propagated) -> State:
        """Return a prediction without what was measured before it."""
        since = self._older or self._newer
        if since is None:
            return predicted.state
        there = _carried(since, predicted, np.zeros(len(since.correction)))
        return moved(replace(predicted.state, cov=there.cov), self.blocks, -there.correction)


def _carried(since: Since, predicted: Propagated, step: Array) -> Since:
    transition = predicted.transition
    return Since(
        since.time,
        transition @ since.correction + step,
        transition @ since.cov @ transition.T + predicted.noise,
    )
