"""Comparison of a state from time to time with a fix of one epoch, which does not know it."""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import State
from magfusion.estimation.online_integrity.recovery import AgreedFix, agreed_fix, explains
from magfusion.estimation.snapshot.fix import AS_LIKELY
from magfusion.model.samples import FieldSamples

COMPARED_EVERY, COMPARED_EPOCHS = 30.0, 150  # s, epochs; between fixes without a request


class FixComparison:
    """Chooses the epochs at which a fix is compared with the state."""

    _compared_at: float
    _since_compared: int

    def __init__(self) -> None:
        self._compared_at, self._since_compared = -np.inf, COMPARED_EPOCHS

    def compare(
        self, samples: FieldSamples, state: State, *, requested: bool
    ) -> tuple[float, float] | None:
        """Return squared distance and offset (m) of a state from a fix, if it is due and usable.

        `requested`: whether a fix is due, whenever the last was.
        """
        self._since_compared += 1
        due = state.time >= self._compared_at + COMPARED_EVERY
        due = due and self._since_compared >= COMPARED_EPOCHS
        if not (due or requested):
            return None
        self._compared_at, self._since_compared = state.time, 0
        fix, calibration = agreed_fix(samples, state.calibration), state.calibration
        lacking = calibration.site.platform.magnetometer.lacking
        if fix is None or (lacking and not fix.fixes.determined[0, 0]):
            return None  # an undetermined roll is equally far from any state
        return _distance_to_fix(state, fix) if explains(fix, samples, calibration) else None


def _distance_to_fix(state: State, fix: AgreedFix) -> tuple[float, float]:
    """Return squared distance and offset (m) of a state from the nearest likely hypothesis.

    A mirrored pose that explains the epoch equally well is no contradiction.
    """
    fixes, body_from_world = fix.fixes, state.world_from_body.T
    best = (np.inf, np.inf)
    for k in np.flatnonzero(fixes.cost[0] < fixes.cost[0, 0] + AS_LIKELY):
        turn = Rotation.from_matrix(body_from_world @ fixes.world_from_body[0, k]).as_rotvec()
        shift = body_from_world @ (fixes.position_world[0, k] - state.position_world)
        offset = np.concatenate([turn, shift])
        cov = fix.excess * fixes.pose_cov[0, k] + state.cov[:6, :6]
        distance = float(offset @ np.linalg.solve(cov, offset))
        best = min(best, (distance, float(np.linalg.norm(shift))))
    return best
