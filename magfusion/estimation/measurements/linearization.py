"""Iterated update: linearisation point of an epoch's fields for an uncertain prediction."""

import numpy as np

from magfusion.estimation.graph.state import MOTION, POSITION, ROTATION, State, states_of
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.parameters import Block
from magfusion.units import Array

# A dipole's field at a displacement s from distance r deviates from its tangent by up to
# 6 (s / r)^2 of itself, a rotated one by half of its square.
BY_DISTANCE, BY_ROTATION = 6.0, 0.5
# Of the noise.  The deviation is not zero in the mean: that of a platform at rest is the same in
# thousands of epochs, of which it must be no signal.
MAX_DEVIATION = 0.02  # sigma
MAX_ITERATIONS = 10


def is_curved(phasors: FieldPhasors, predicted: State) -> bool:
    """Return whether an epoch's fields are nonlinear over the uncertainty of its prediction."""
    cov = predicted.cov
    rotated, shifted = np.trace(cov[ROTATION, ROTATION]), np.trace(cov[POSITION, POSITION])
    return _deviation(phasors, rotated, shifted, _nearest(predicted)) > MAX_DEVIATION


def relinearized(
    phasors: FieldPhasors, predicted: State, blocks: tuple[Block, ...]
) -> FieldPhasors | None:
    """Return an epoch's fields linearised at their own most probable pose, by Gauss-Newton steps.

    The update of an iterated extended Kalman filter (Bell and Cathey 1993, doi 10.1109/9.250476):
    innovation and Jacobian are those of the last point, the prior is that of the prediction.
    `predicted`: with its covariance. `blocks`: calibration parameters in its tangent. Returns None
    if the steps do not converge.
    """
    pose, nearest = predicted.pose, _nearest(predicted)
    for _ in range(MAX_ITERATIONS):
        result = phasors.linearized_at(pose.rotation().matrix(), np.asarray(pose.translation()))
        step = _step(result, predicted, blocks)
        if not np.all(np.isfinite(step)):
            return None
        before, pose = pose, predicted.pose.retract(step)
        moved = before.localCoordinates(pose)
        rotated, shifted = np.sum(moved[ROTATION] ** 2), np.sum(moved[POSITION] ** 2)
        if _deviation(result, rotated, shifted, nearest) < MAX_DEVIATION:
            return result
    return None


def _step(phasors: FieldPhasors, predicted: State, blocks: tuple[Block, ...]) -> Array:
    """Return the step (6,) from a predicted pose to the most probable one."""
    rows = phasors.linearize(states_of([predicted]), predicted.calibration, blocks)
    size = len(predicted.cov)
    jacobian = rows.jacobian(size - MOTION).reshape(-1, size)
    detected = np.any(jacobian, axis=1)  # rows of undetected beacons are zero
    error, jacobian = rows.error.reshape(-1)[detected], jacobian[detected]
    crossed = predicted.cov @ jacobian.T
    innovation_cov = jacobian @ crossed + np.eye(len(jacobian))
    gain = np.linalg.solve(innovation_cov, crossed[:6].T).T
    return np.asarray(-gain @ error)


def _deviation(phasors: FieldPhasors, rotated: float, shifted: float, nearest: float) -> float:
    """Return the largest deviation of an epoch's fields from their tangent (sigma).

    `rotated`, `shifted`: square of a displacement (rad^2, m^2). `nearest`: distance of the nearest
    beacon (m).
    """
    fields = phasors.sqrt_information[0] @ phasors.measured[0, :, :, None]
    relative = BY_ROTATION * rotated + BY_DISTANCE * shifted / nearest**2
    return float(relative * np.max(np.linalg.norm(fields[..., 0], axis=1), initial=0.0))


def _nearest(state: State) -> float:
    """Return the distance of the nearest beacon (m)."""
    places = np.array([b.position_world for b in state.calibration.site.beacons])
    return float(np.min(np.linalg.norm(places - state.position_world, axis=1)))
