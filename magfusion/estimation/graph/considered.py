"""Effect of fixed parameters on all estimates of a graph."""

from collections.abc import Iterator
from dataclasses import replace

import gtsam
import numpy as np

from magfusion.estimation.graph.factors import CONSIDERED_KEY, NUISANCE_KEY
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.prior_factor import prior_factor
from magfusion.estimation.solve.bordered import eliminate_partial
from magfusion.model.parameters import Block
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.units import Array

AT_ONCE = 2e8  # bytes; fixed parameters, and variants, are processed in groups of this size
PER_COLUMN = 400.0  # bytes per parameter and state, in the graph and eliminated


def responses(
    graph: Graph, estimate: GraphEstimate, considered: tuple[Block, ...]
) -> Iterator[gtsam.VectorValues]:
    """Yield the step of every variable that considered parameters cause.

    One for each column of their prior's spread: one sigma of each where they are independent.
    They are eliminated last, so that one elimination serves all of them, or in a long log as many
    as fit in memory.
    """
    assert graph.declared is not None
    spread, shift = prior_sqrt_covariance(graph.declared.site, considered), None
    if graph.shift is not None:
        spread, shift = graph.shift.with_separate_errors(spread)
    group = max(1, int(AT_ONCE / (PER_COLUMN * graph.epochs)))
    for first in range(0, spread.shape[1], group):
        columns = slice(first, first + group)
        moved = None if shift is None else shift[:, columns]
        conditional = _conditional(graph, estimate, considered, spread[:, columns], moved)
        yield from steps_of_others(conditional, spread[:, columns].shape[1])


def _conditional(
    graph: Graph,
    estimate: GraphEstimate,
    considered: tuple[Block, ...],
    spread: Array,
    shift: Array | None,
) -> gtsam.GaussianBayesNet:
    """Return the conditionals of all estimates, given columns of considered parameters."""
    assert graph.declared is not None
    linear = replace(graph, declared=None).with_fixed_columns(
        estimate, considered, spread, graph.by_considered(spread)
    )
    if graph.blocks:
        linear.push_back(prior_factor(graph.declared, graph.declared, graph.blocks, shift))
    return eliminate_partial(linear, graph.ordering)[0]


def steps_of_others(
    conditional: gtsam.GaussianBayesNet, count: int, nuisance: int = 0
) -> Iterator[gtsam.VectorValues]:
    """Yield the step of every variable that a unit of each fixed parameter causes.

    One at a time: in a long log all of them take as much memory as the log. `count`, `nuisance`:
    number of fixed parameters, and of nuisances of the system, which are zero.
    """
    for one in np.eye(count):
        given = gtsam.VectorValues()
        given.insert(CONSIDERED_KEY, one)
        if nuisance:
            given.insert(NUISANCE_KEY, np.zeros(nuisance))
        yield conditional.optimize(given)
