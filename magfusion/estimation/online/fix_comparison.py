"""Comparison of a state from time to time with a fix of one epoch, which does not know it."""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import State, states_of
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.online_integrity.recovery import AgreedFix, agreed_fix, at_fix, explains
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
        self, measured: FieldPhasors, samples: FieldSamples, state: State, *, requested: bool
    ) -> tuple[float, float] | None:
        """Return squared distance and offset (m) of a state from a fix, if it is due and usable.

        A state that explains the epoch about as well is no farther than zero: of a far beacon alone
        the poses that do lie on a curve, which no covariance describes. `requested`: whether a fix
        is due, whenever the last was.
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
        if not explains(fix, samples, calibration):
            return None
        squares = [_square(measured, one) for one in (state, at_fix(state, fix))]
        return (0.0, 0.0) if squares[0] < squares[1] + AS_LIKELY else _distance_to_fix(state, fix)


def _square(measured: FieldPhasors, state: State) -> float:
    """Return the chi square of an epoch at a state."""
    rows = measured.linearize(states_of([state]), state.calibration, ())
    return float(np.sum(rows.error**2))


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
