"""Correction smoothing: corrections of the estimate enter the output gradually."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import POSITION, ROTATION, VELOCITY, State
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Offset:
    """A correction that has not fully entered the output."""

    time: float  # of the correction (s)
    # (9,), from the corrected state to the previous output, world axes: rotation (on the left),
    # position, velocity
    step: Array


class CorrectionSmoother:
    """Corrections that enter the output smoothly, each within a length of time (s)."""

    _offsets: list[Offset]

    def __init__(self, length: float) -> None:
        self.length, self._offsets = length, []

    def reset(self) -> None:
        """Discard all corrections."""
        self._offsets = []

    def take(self, reported: State, corrected: State) -> None:
        """Add the correction from an output state to a corrected state of the same time."""
        turn = reported.world_from_body @ corrected.world_from_body.T
        step = np.concatenate(
            [
                Rotation.from_matrix(turn).as_rotvec(),
                reported.position_world - corrected.position_world,
                reported.velocity_world - corrected.velocity_world,
            ]
        )
        kept = [one for one in self._offsets if reported.time - one.time < self.length]
        remaining = sum((self._remaining_offset(one, reported.time) for one in kept), np.zeros(9))
        self._offsets = [*kept, Offset(reported.time, step - remaining)]

    def _remaining_offset(self, one: Offset, time: float) -> Array:
        share = min(max((time - one.time) / self.length, 0.0), 1.0)
        return one.step * (1.0 - share**2 * (3.0 - 2.0 * share))

    def remaining(self, time: float) -> Array:
        """Return the sum of all corrections that remain at a time (s), shape (9,)."""
        return sum((self._remaining_offset(one, time) for one in self._offsets), np.zeros(9))

    def smoothed(self, state: State) -> tuple[State, Array]:
        """Return the output for a corrected state, its covariance enlarged; and the remainder."""
        step = self.remaining(state.time)
        if not np.any(step):
            return state, step
        world_from_body = Rotation.from_rotvec(step[:3]).as_matrix() @ state.world_from_body
        body = step.copy()
        body[ROTATION], body[POSITION] = world_from_body.T @ step[:3], world_from_body.T @ step[3:6]
        cov = state.cov.copy()
        cov[:9, :9] += np.outer(body, body)
        moved = replace(
            state,
            world_from_body=world_from_body,
            position_world=state.position_world + step[POSITION],
            velocity_world=state.velocity_world + step[VELOCITY],
            cov=cov,
        )
        return moved, step
