"""Information of a log on a calibration that it shares with others, its states eliminated.

The linear graph at an estimate is eliminated down to the calibration, without the prior of shared
parameters; the log's own (drive phases, the IMU's clock) are eliminated with their prior.  The
result is a quadratic in the shared parameters: added over logs, with the prior once, it gives the
Gauss-Newton step of one graph of all the logs.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from magfusion.estimation.graph.factors import CALIBRATION_KEY, CONSIDERED_KEY
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.solve.bordered import eliminate_partial
from magfusion.model.parameters import Block, Calibration, difference, dimension, placed
from magfusion.model.prior import prior_sqrt_covariance, prior_sqrt_information
from magfusion.units import Array, BoolArray


@dataclass(frozen=True, eq=False)
class MarginalizedLog:
    """A quadratic in parameters that several logs share, at its linearisation point."""

    information: Array  # (s, s), of the log alone
    # (s,), descent direction: ``information @ step = gradient`` gives the step of the log alone
    gradient: Array
    # (s, c), change by one sigma of each considered parameter that is the same in every log
    by_common: Array
    by_place: Array  # (s, s), covariance due to errors of the fields that are constant in place
    by_log: Array  # (s, s), covariance due to considered parameters of the log's own


def columns_of(blocks: tuple[Block, ...], *, own: bool) -> BoolArray:
    """Return which columns are the log's own, or shared between logs, shape (dimension,)."""
    return np.array([b.parameter.each_log is own for b in blocks for _ in b.sigma], dtype=bool)


def shared_blocks(blocks: tuple[Block, ...]) -> tuple[Block, ...]:
    """Return the parameters that logs share, with consecutive columns."""
    return placed(block for block in blocks if not block.parameter.each_log)


def marginalize(
    graph: Graph,
    estimate: GraphEstimate,
    considered: tuple[Block, ...],
    errors: tuple[Block, ...] = (),
) -> MarginalizedLog:
    """Marginalise the graph of a log to its shared parameters.

    `graph`: its prior is omitted except for the log's own parameters. `considered`: uncertain
    parameters that are not estimated. `errors`: errors of the beacons' fields that are constant in
    place. Raises RuntimeError from GTSAM, for states that the log does not determine.
    """
    assert graph.declared is not None
    site, size = graph.declared.site, dimension(graph.blocks)
    uncertain = placed((*considered, *errors))
    spread = prior_sqrt_covariance(site, uncertain)
    alone = replace(graph, declared=None)
    system = (
        alone.with_fixed_columns(
            estimate, uncertain, spread, graph.by_considered(spread), explaining=True
        )
        if uncertain
        else alone.linearized(estimate)
    )
    _, rest = eliminate_partial(system, _all_but_the_calibration(graph))
    order = gtsam.Ordering()
    order.push_back(CALIBRATION_KEY)
    if uncertain:
        order.push_back(CONSIDERED_KEY)
    hessian, right = rest.hessian(order)
    whole = np.concatenate([right[:size, None], -hessian[:size, size:]], axis=1)
    residual, whole = _without_own(graph, estimate.calibration, hessian[:size, :size], whole)
    gradient, moved = whole[:, 0], whole[:, 1:]
    of_log = columns_of(considered, own=True)
    common, own = moved[:, : len(of_log)][:, ~of_log], moved[:, : len(of_log)][:, of_log]
    place = moved[:, len(of_log) :]
    return MarginalizedLog(residual, gradient, common, place @ place.T, own @ own.T)


def _all_but_the_calibration(graph: Graph) -> gtsam.Ordering:
    every, out = graph.ordering, gtsam.Ordering()
    for i in range(every.size()):
        if every.at(i) != CALIBRATION_KEY:
            out.push_back(every.at(i))
    return out


def _without_own(
    graph: Graph, calibration: Calibration, information: Array, right: Array
) -> tuple[Array, Array]:
    """Eliminate the log's own parameters with their prior."""
    assert graph.declared is not None
    own = columns_of(graph.blocks, own=True)
    blocks = placed(block for block in graph.blocks if block.parameter.each_log)
    information, right = information.copy(), right.copy()
    if blocks:
        whitening = prior_sqrt_information(graph.declared.site, blocks)
        prior, part = whitening.T @ whitening, np.ix_(own, own)
        information[part] += prior
        right[own, 0] -= prior @ difference(graph.declared, calibration, blocks)
        gain = np.linalg.solve(information[part], information[np.ix_(own, ~own)]).T
        right = right[~own] - gain @ right[own]
        information = information[np.ix_(~own, ~own)] - gain @ information[np.ix_(own, ~own)]
    else:
        right = right[~own]
    return 0.5 * (information + information.T), right
