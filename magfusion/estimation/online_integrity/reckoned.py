"""Undoing the corrections of the last epochs: the dead-reckoned state from a short time ago.

A disturbance is detected some epochs after its onset, and these are in the state and in its
covariance.  The sum of their corrections is therefore propagated with the estimate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.graph.propagation import Propagated
from magfusion.estimation.graph.state import State, between, moved
from magfusion.model.parameters import Block
from magfusion.units import Array

LATE = 0.5  # s; largest delay of the detection of a disturbance


@dataclass(frozen=True, eq=False)
class Since:
    """Corrections since a time.

    Parameters
    ----------
    time : float
        (s)
    correction : ndarray, shape (15 + calibration,)
        Of the state, propagated.
    cov : ndarray, shape (15 + calibration, 15 + calibration)
        Of the state without it.
    """

    time: float
    correction: Array
    cov: Array


class Reckoned:
    """Undoes the measurements of the last half second to a second."""

    _older: Since | None
    _newer: Since | None

    def __init__(self, blocks: Sequence[Block]) -> None:
        self.blocks = tuple(blocks)
        self._older, self._newer = None, None

    def forget(self) -> None:
        """Start again: the state was replaced."""
        self._older = self._newer = None

    def hear(self, before: State, predicted: Propagated, state: State) -> None:
        """Process an epoch: the states before it, predicted, and updated."""
        step = between(predicted.state, state, self.blocks)
        if self._newer is None or before.time - self._newer.time >= LATE:
            self._older = self._newer
            self._newer = Since(before.time, np.zeros(len(step)), before.cov)
        self._older = None if self._older is None else _carried(self._older, predicted, step)
        self._newer = _carried(self._newer, predicted, step)

    def taken_back(self, predicted: Propagated) -> State:
        """Return a prediction without the measurements of these epochs."""
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
