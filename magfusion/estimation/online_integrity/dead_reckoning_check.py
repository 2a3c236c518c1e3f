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
class SlidingUpdate:
    """Corrections since a time."""

    time: float  # (s)
    correction: Array  # (15 + calibration,), of the state, propagated
    cov: Array  # (15 + calibration, 15 + calibration), of the state without it


class DeadReckoningCheck:
    """Undoes the measurements of the last half second to a second."""

    _older: SlidingUpdate | None
    _newer: SlidingUpdate | None

    def __init__(self, blocks: Sequence[Block]) -> None:
        self.blocks = tuple(blocks)
        self._older, self._newer = None, None

    def reset(self) -> None:
        """Start again: the state was replaced."""
        self._older = self._newer = None

    def update(self, before: State, predicted: Propagated, state: State) -> None:
        """Process an epoch: the states before it, predicted, and updated."""
        step = between(predicted.state, state, self.blocks)
        if self._newer is None or before.time - self._newer.time >= LATE:
            self._older = self._newer
            self._newer = SlidingUpdate(before.time, np.zeros(len(step)), before.cov)
        self._older = None if self._older is None else _propagated(self._older, predicted, step)
        self._newer = _propagated(self._newer, predicted, step)

    def taken_back(self, predicted: Propagated) -> State:
        """Return a prediction without the measurements of these epochs."""
        start_time = self._older or self._newer
        if start_time is None:
            return predicted.state
        there = _propagated(start_time, predicted, np.zeros(len(start_time.correction)))
        return moved(replace(predicted.state, cov=there.cov), self.blocks, -there.correction)


def _propagated(update: SlidingUpdate, predicted: Propagated, step: Array) -> SlidingUpdate:
    transition = predicted.transition
    return SlidingUpdate(
        update.time,
        transition @ update.correction + step,
        transition @ update.cov @ transition.T + predicted.noise,
    )
