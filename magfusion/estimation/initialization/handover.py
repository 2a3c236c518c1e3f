"""Handover from the smoother of a log's beginning to an estimator from its last epoch on."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.graph.considered import responses
from magfusion.estimation.graph.factors import CALIBRATION_KEY
from magfusion.estimation.graph.graph import GraphEstimate
from magfusion.estimation.graph.state import State
from magfusion.estimation.solve.bordered import eliminate_partial
from magfusion.model.parameters import Block, dimension, placed
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.units import Array


def last_state(result: Smoothed, considered: tuple[Block, ...] = ()) -> State:
    """Return the smoothed state of the last epoch with its covariance, including calibration.

    `considered`: uncertain parameters that were not estimated, to be considered from then on.
    Returned in the tangent of ``result.blocks``, then of those considered.
    """
    states, last = result.states, len(result.states) - 1
    estimate = result.estimate
    graph = result.graph.linearized(estimate)
    earlier, kept = gtsam.Ordering(), gtsam.Ordering()
    for i in range(len(states)):
        for symbol in (X, V, B):
            (kept if i == last else earlier).push_back(symbol(i))
    if result.blocks:
        kept.push_back(CALIBRATION_KEY)
    _, rest = eliminate_partial(graph, earlier)
    information, _ = rest.hessian(kept)
    cov = _with_considered(np.asarray(np.linalg.inv(information)), result, estimate, considered)
    assert states.velocity_world is not None
    assert states.accel_bias_body is not None
    assert states.gyro_bias_body is not None
    return State(
        time=float(states.time[last]),
        world_from_body=states.world_from_body[last],
        position_world=states.position_world[last],
        velocity_world=states.velocity_world[last],
        accel_bias_body=states.accel_bias_body[last],
        gyro_bias_body=states.gyro_bias_body[last],
        calibration=result.calibration,
        cov=0.5 * (cov + cov.T),
    )


def _with_considered(
    cov: Array, result: Smoothed, estimate: GraphEstimate, considered: tuple[Block, ...]
) -> Array:
    """Return the joint covariance with parameters that the estimate assumed to be known."""
    uncertain = placed((*considered, *result.field_errors))
    if not uncertain:
        return cov
    last, size = len(result.states) - 1, dimension(considered)
    columns = []
    for step in responses(result.graph, estimate, uncertain):
        own = [step.at(X(last)), step.at(V(last)), step.at(B(last))]
        own += [step.at(CALIBRATION_KEY)] if result.blocks else []
        columns.append(np.concatenate(own))
    response = np.stack(columns, axis=1)
    cov = cov + response[:, size:] @ response[:, size:].T
    if not considered:
        return cov
    response, spread = response[:, :size], prior_sqrt_covariance(result.declared.site, considered)
    across = response @ spread.T
    return np.block([[cov + response @ response.T, across], [across.T, spread @ spread.T]])
