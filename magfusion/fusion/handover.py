"""From the smoother of a log's beginning to an estimator that goes on from its last epoch."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.fusion.batch import Smoothed
from magfusion.fusion.factors import CALIBRATION_KEY
from magfusion.fusion.smoother import Estimate, held_steps, linearized
from magfusion.fusion.state import State
from magfusion.parameters import Block
from magfusion.prior import prior_spread
from magfusion.units import Array


def last_state(result: Smoothed, held: tuple[Block, ...] = ()) -> State:
    """Return the smoothed state of the last epoch with its covariance, the calibration's included.

    Parameters
    ----------
    result : Smoothed
    held : tuple of Block
        Uncertain parameters that were not estimated, to be considered from here on.

    Returns
    -------
    State
        In the tangent of ``result.blocks``, then of those held.
    """
    states, last = result.states, len(result.states) - 1
    estimate = Estimate(result.values, result.calibration)
    graph = linearized(result.problem, estimate)
    earlier, kept = gtsam.Ordering(), gtsam.Ordering()
    for i in range(len(states)):
        for symbol in (X, V, B):
            (kept if i == last else earlier).push_back(symbol(i))
    if result.blocks:
        kept.push_back(CALIBRATION_KEY)
    try:
        _, rest = graph.eliminatePartialSequential(earlier)
    except RuntimeError:  # an ill-conditioned stretch: QR needs half the digits
        _, rest = graph.eliminatePartialSequential(earlier, gtsam.EliminateQR)
    information, _ = rest.hessian(kept)
    cov = _with_held(np.asarray(np.linalg.inv(information)), result, estimate, held)
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


def _with_held(cov: Array, result: Smoothed, estimate: Estimate, held: tuple[Block, ...]) -> Array:
    """Return the joint covariance with parameters that the estimate took for known."""
    if not held or result.problem.fields is None:
        return cov
    last = len(result.states) - 1
    spread = prior_spread(result.declared.site, held)
    columns = []
    for step in held_steps(result.problem, estimate, held):
        own = [step.at(X(last)), step.at(V(last)), step.at(B(last))]
        own += [step.at(CALIBRATION_KEY)] if result.blocks else []
        columns.append(np.concatenate(own))
    response = np.stack(columns, axis=1)
    across = response @ spread.T
    return np.block([[cov + response @ response.T, across], [across.T, spread @ spread.T]])
