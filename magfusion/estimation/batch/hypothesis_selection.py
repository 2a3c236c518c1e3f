"""Selection among several starts by the motion, with the best rival."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.batch.log_graph import PreprocessedLog, graph_of
from magfusion.estimation.batch.search import differ, thinned
from magfusion.estimation.graph.graph import GraphEstimate, initial_estimate, read_states
from magfusion.estimation.measurements.fixed_roll import without_roll
from magfusion.estimation.solve.bordered import Optimised, optimise
from magfusion.model.one_axis import roll_is_open
from magfusion.model.trajectory import Trajectory
from magfusion.units import IntArray

AMBIGUOUS_CHI_SQUARE = 20.0  # below this a mirrored trajectory explains the data nearly as well
DECIDED = 20.0  # times that on a thinned log, above which a rival needs no further comparison
SHORT = 12  # steps of a comparison


def select_hypothesis(starts: list[PreprocessedLog]) -> PreprocessedLog:
    """Return the start that agrees best with the motion, where single epochs are ambiguous.

    All are compared on a thinned log, then the best and its rival on the whole one. Raises
    EstimationError where none can be solved.
    """
    if len(starts) == 1:
        return starts[0]
    kept = thinned(starts[0].samples)
    result, paths = [], []
    for start in starts:
        part = _part(start, kept)
        result.append(_optimised(part, SHORT))
        paths.append(_path(result[-1], part))
    order = np.argsort([one.cost for one in result])
    first = int(order[0])
    others = [int(i) for i in order[1:] if differ(paths[i], paths[first])]
    if not others:
        return starts[first]
    margin = 2.0 * (result[others[0]].cost - result[first].cost)
    if margin > DECIDED * AMBIGUOUS_CHI_SQUARE:
        return replace(starts[first], rival_chi_square=float(margin))
    pair = [starts[first], starts[others[0]]]
    whole = [_optimised(start) for start in pair]
    best, second = (0, 1) if whole[0].cost <= whole[1].cost else (1, 0)
    rival = _path(whole[second], pair[second])
    if not differ(_path(whole[best], pair[best]), rival):
        return pair[best]
    margin = 2.0 * (whole[second].cost - whole[best].cost)
    return replace(pair[best], rival_chi_square=float(margin), rival=rival)


def _part(log: PreprocessedLog, kept: IntArray) -> PreprocessedLog:
    """Return a log with some of its fields, and states there."""
    states = Trajectory(
        **{k: v[log.epoch[kept]] for k, v in vars(log.states).items() if v is not None}
    )
    return replace(
        log,
        samples=log.samples.rows(kept),
        static=None,
        epoch=np.arange(len(kept)),
        fixes=None,
        states=states,
        others=(),
    )


def _optimised(log: PreprocessedLog, iterations: int = 30) -> Optimised[GraphEstimate]:
    graph, _ = graph_of(log, log.states, log.declared)
    return optimise(graph, initial_estimate(log.states, log.declared), iterations=iterations)


def _path(result: Optimised[GraphEstimate], log: PreprocessedLog) -> Trajectory:
    path, site = read_states(result.estimate.values, log.states.time), log.declared.site
    if not roll_is_open(site):
        return path
    return without_roll(path, site, signed=log.samples.signed)
