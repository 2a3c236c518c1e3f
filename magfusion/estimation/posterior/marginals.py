"""The posterior covariance of all poses of a log and of its calibration.

GTSAM's Bayes tree returns one pose at a time, and one considered parameter at a time.  The chain of
states gives all of them in one sweep; it is checked against the tree at some poses.
"""

from dataclasses import dataclass

import numpy as np
from gtsam.symbol_shorthand import X

from magfusion.estimation.graph.considered import AT_ONCE, responses
from magfusion.estimation.graph.factors import CALIBRATION_KEY
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.measurements.phasors import leaves_out
from magfusion.estimation.posterior.block_tridiagonal_system import (
    block_tridiagonal_system,
    column_groups,
)
from magfusion.estimation.posterior.separation import POSE
from magfusion.estimation.solve.bordered import eliminate, last_marginal
from magfusion.estimation.solve.chain import solve_chain
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.model.parameters import Block, dimension
from magfusion.units import Array

CHECKED_POSES = 5  # poses at which the tree is used too
# Of a variance: a thousandth of a sigma.  Minutes without fields round the tree itself to 2e-4.
AGREED = 2e-3


@dataclass(frozen=True, eq=False)
class _Marginals:
    """Covariances from the chain."""

    pose_cov: Array  # (n, 6, 6), of the estimated parameters alone
    by_considered: Array  # (n, 6, 6), contribution of considered parameters
    calibration_cov: Array  # (dimension, dimension), of the estimated parameters alone
    response: Array  # (dimension, considered)

    @property
    def whole(self) -> tuple[Array, Array, Array]:
        """Results in the form of `marginals`."""
        poses = self.pose_cov + self.by_considered
        return poses, self.calibration_cov + self.response @ self.response.T, self.response


def marginals(
    graph: Graph, estimate: GraphEstimate, considered: tuple[Block, ...] = ()
) -> tuple[Array, Array, Array]:
    """Return the posterior covariance of every pose and of the calibration.

    `considered`: uncertain parameters that were not estimated: the effect of their errors on the
    estimate is added (a consider covariance). Returns `pose_cov` (n, 6, 6): calibration
    marginalised, its gauge included; `calibration_cov` (dimension, dimension);
    `calibration_response` (dimension, considered): change of the calibration by one sigma of each
    considered parameter, included in its covariance.
    """
    linear, ordering = graph.linearized(estimate), graph.ordering
    tree = eliminate(linear, ordering)
    if is_chain(graph, considered):
        rows = np.unique(np.linspace(0, graph.epochs - 1, CHECKED_POSES).astype(int)).tolist()
        checked = {i: np.array(tree.marginalCovariance(X(i))) for i in rows}
        calibration = last_marginal(tree, linear, ordering) if graph.blocks else None
        del tree, linear  # as large again as the arrays below
        give_back_memory()
        result = _of_chain(graph, estimate, considered)
        if _agrees(result, checked, calibration):
            return result.whole
        linear = graph.linearized(estimate)
        tree = eliminate(linear, ordering)
    poses = np.array([tree.marginalCovariance(X(i)) for i in range(graph.epochs)])
    calibration = last_marginal(tree, linear, ordering) if graph.blocks else np.zeros((0, 0))
    response = np.zeros((len(calibration), 0))
    del tree, linear
    if considered and graph.measurements:
        keys, by_pose, by_calibration = [X(i) for i in range(graph.epochs)], [], []
        for step in responses(graph, estimate, considered):
            by_pose.append(step.vector(keys).reshape(-1, 6))
            if graph.blocks:
                by_calibration.append(step.at(CALIBRATION_KEY))
        every = np.array(by_pose)
        poses += np.einsum("hni,hnj->nij", every, every)
        if graph.blocks:
            response = np.array(by_calibration).T
            calibration += response @ response.T
    return poses, calibration, response


def is_chain(graph: Graph, considered: tuple[Block, ...]) -> bool:
    """Return whether one sweep gives all covariances: one calibration, not many hours."""
    columns = [group.stop - group.start for group in column_groups(considered, graph.epochs)]
    maximum = 1 + max(columns) + dimension(graph.blocks)
    too_long = 8.0 * graph.epochs * MOTION * maximum > AT_ONCE
    if graph.declared is None or len(graph.segments) > 1 or graph.shift is not None:
        return False
    return not too_long and graph.user is None and not leaves_out(graph.measurements)


def _of_chain(graph: Graph, estimate: GraphEstimate, considered: tuple[Block, ...]) -> _Marginals:
    """Return all covariances in one sweep."""
    considered = considered if graph.measurements else ()
    added, responses, solved = np.zeros((graph.epochs, POSE, POSE)), [], None
    for columns in column_groups(considered, graph.epochs):
        normal, fields = block_tridiagonal_system(graph, estimate, considered, columns)
        if fields is not None:
            for piece in fields.pieces():
                piece.added_to(normal)
        known: Array | None = None if solved is None else solved.inverse
        result = solve_chain(normal.chain(), POSE, known, covariance=known is None)
        del normal, fields  # before the next group, to limit memory
        response = result.states[0, ..., 1:]
        added += response @ np.swapaxes(response, 1, 2)
        responses.append(result.border[0, :, 1:])
        solved = result._replace(states=added[None]) if solved is None else solved
        del response, result
        give_back_memory()
    assert solved is not None
    return _Marginals(solved.cov[0], added, solved.border_cov[0], np.concatenate(responses, axis=1))


def _agrees(result: _Marginals, checked: dict[int, Array], calibration: Array | None) -> bool:
    """Return whether the tree agrees: rounding along an ill-conditioned chain may grow."""
    if not all(np.all(np.isfinite(part)) for part in vars(result).values()):
        return False
    pairs = [(result.pose_cov[i], cov) for i, cov in checked.items()]
    if calibration is not None:
        pairs.append((result.calibration_cov, calibration))
    for one, other in pairs:
        sigma = np.sqrt(np.diagonal(other))
        if not np.all(np.abs(one - other) < AGREED * sigma[:, None] * sigma):
            return False
    return True
