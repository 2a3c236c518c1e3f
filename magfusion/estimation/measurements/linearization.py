"""Iterated update: linearisation point of an epoch's fields for an uncertain prediction."""

import numpy as np

from magfusion.estimation.graph.state import MOTION, POSITION, ROTATION, State, states_of
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.parameters import Block
from magfusion.units import Array

# A dipole's field at a displacement s from distance r deviates from its tangent by up to
# 6 (s / r)^2 of itself: at two sigma of a prediction with this uncertainty by .0024, about half of
# the usual model error.  A rotation deviates by half of its square.
WIDE_OF_DISTANCE, WIDE_ROTATION = 0.01, 0.03  # of the nearest beacon's distance; rad
CONVERGED_STEP = 0.001  # last step, of the distance, or rad: the remaining error is 6e-6 of a field
MAX_ITERATIONS = 10


def is_curved(predicted: State) -> bool:
    """Return whether fields are nonlinear over the uncertainty of a prediction."""
    cov = predicted.cov
    if np.trace(cov[ROTATION, ROTATION]) > WIDE_ROTATION**2:
        return True
    return bool(np.trace(cov[POSITION, POSITION]) > (WIDE_OF_DISTANCE * _nearest(predicted)) ** 2)


def relinearized(
    phasors: FieldPhasors, predicted: State, blocks: tuple[Block, ...]
) -> FieldPhasors | None:
    """Return an epoch's fields linearised at their own most probable pose, by Gauss-Newton steps.

    The update of an iterated extended Kalman filter (Bell and Cathey 1993, doi 10.1109/9.250476):
    innovation and Jacobian are those of the last point, the prior is that of the prediction.
    `predicted`: with its covariance. `blocks`: calibration parameters in its tangent. Returns None
    if the steps do not converge.
    """
    pose, distance = predicted.pose, _nearest(predicted)
    for _ in range(MAX_ITERATIONS):
        result = phasors.linearized_at(pose.rotation().matrix(), np.asarray(pose.translation()))
        step = _step(result, predicted, blocks)
        if not np.all(np.isfinite(step)):
            return None
        before, pose = pose, predicted.pose.retract(step)
        moved = before.localCoordinates(pose)
        rotated, shifted = np.linalg.norm(moved[ROTATION]), np.linalg.norm(moved[POSITION])
        if rotated < CONVERGED_STEP and shifted < CONVERGED_STEP * distance:
            return result
    return None


def _step(phasors: FieldPhasors, predicted: State, blocks: tuple[Block, ...]) -> Array:
    """Return the step (6,) from a predicted pose to the most probable one."""
    rows = phasors.linearize(states_of([predicted]), predicted.calibration, blocks)
    size = len(predicted.cov)
    jacobian = rows.jacobian(size - MOTION).reshape(-1, size)
    crossed = predicted.cov @ jacobian.T
    innovation_cov = jacobian @ crossed + np.eye(len(jacobian))
    gain = np.linalg.solve(innovation_cov, crossed[:6].T).T
    return np.asarray(-gain @ rows.error.reshape(-1))


def _nearest(state: State) -> float:
    """Return the distance of the nearest beacon (m)."""
    places = np.array([b.position_world for b in state.calibration.site.beacons])
    return float(np.min(np.linalg.norm(places - state.position_world, axis=1)))
