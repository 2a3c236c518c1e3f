"""Convergence of an estimator, in units of its own sigmas."""

import numpy as np
from gtsam.symbol_shorthand import X
from scipy.spatial.transform import Rotation

from magfusion.errors import UNOBSERVABLE, EstimationError
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.posterior.separation import OPEN_ROTATION
from magfusion.estimation.solve.bordered import eliminate
from magfusion.model.parameters import Calibration
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

OFFSET_CONVERGED = 2e-5  # s; change of the time offset at which the passes end
POSITION_CONVERGED = 5e-5  # m; rms change of the positions at which the passes end


def last_move(
    before: Trajectory, after: Trajectory, unfinished: tuple[Graph, GraphEstimate] | None = None
) -> float:
    """Return the rms pose change of the last pass, in sigmas, including an unfinished step.

    The gauge of a survey is as uncertain as the survey: a step along it is small in these units.
    `after`: with a covariance. `unfinished`: state of an unconverged loop of the last pass.
    """
    cov, moves = after.pose_cov, [pose_steps(before, after)]
    assert cov is not None
    if unfinished is not None:
        graph, estimate = unfinished
        try:
            step = eliminate(graph.linearized(estimate), graph.ordering).optimize()
        except RuntimeError:  # from GTSAM, for a singular system
            return float("inf")
        moves.append(step.vector([X(i) for i in range(graph.epochs)]).reshape(-1, 6))
    squares = [np.einsum("ni,ni->", m, np.linalg.solve(cov, m[..., None])[..., 0]) for m in moves]
    return float(np.sqrt(max(squares) / (6.0 * len(cov))))


def pose_steps(before: Trajectory, after: Trajectory) -> Array:
    """Return the steps between poses, shape (n, 6): rotation, then translation, body axes."""
    back = np.swapaxes(before.world_from_body, 1, 2)
    turn = Rotation.from_matrix(back @ after.world_from_body).as_rotvec()
    moved = back @ (after.position_world - before.position_world)[..., None]
    return np.concatenate([turn, moved[..., 0]], axis=1)


def refuse_open(states: Trajectory) -> None:
    """Raise an error for an unobservable attitude, whose estimate may be rounding alone."""
    assert states.pose_cov is not None
    widest = np.linalg.eigvalsh(states.pose_cov[:, :3, :3])[:, -1]
    if np.min(widest) > OPEN_ROTATION**2:
        raise EstimationError(f"{UNOBSERVABLE}: add a beacon or a coil")


def settled_at(before: Trajectory, after: Trajectory, old: Calibration, new: Calibration) -> bool:
    """Return whether a pass changed states and the IMU's stamps by negligible amounts."""
    moved = np.sqrt(np.mean((after.position_world - before.position_world) ** 2))
    ends = after.time[[0, -1]]
    shifted = np.max(np.abs(new.imu_offset(ends) - old.imu_offset(ends)))
    return bool(moved < POSITION_CONVERGED and shifted < OFFSET_CONVERGED)
