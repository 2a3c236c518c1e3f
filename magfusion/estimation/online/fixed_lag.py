"""The fixed-lag smoother: a sliding window of the batch smoother's own factors.

The whole window is linearised again at each epoch, and what leaves it becomes a prior.  A state
that has left stays as a clone while a user's factor joins it to one in the window.  GTSAM's
`IncrementalFixedLagSmoother` would need a callback for each field factor and relinearise when it
decides to; here the time of an update depends on the window only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.errors import EstimationError
from magfusion.estimation.graph.factors import CALIBRATION_KEY
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.inertial import Link, inertial_factor
from magfusion.estimation.graph.kalman import considered_share, partial_update
from magfusion.estimation.graph.measurement import Measurement, joined
from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.propagation import Propagated
from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.estimation.graph.state import MOTION, State, moved_to, values_of
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.online.window_prior import WindowPrior, triangular
from magfusion.estimation.solve.bordered import eliminate_partial
from magfusion.model.parameters import Block, dimension, retract
from magfusion.model.site import Site
from magfusion.units import Array

ITERATIONS_FAR = 4  # where the prediction is too uncertain to linearise at
LAST = slice(MOTION, 2 * MOTION)  # of the first state, the last and the calibration


@dataclass(frozen=True, eq=False)
class Node:
    """One epoch in the window."""

    state: State  # its calibration is the window's
    measurements: tuple[Measurement, ...]  # of this epoch
    link: Link | None  # from the previous node; None for the first


class SlidingWindow:
    """Fixed-lag smoother.

    Parameters
    ----------
    state : State
        Initial state, with its covariance.
    blocks : tuple of Block
        Calibration parameters in its tangent.
    lag : float
        Length of the window (s).
    process_noise : ProcessNoise
        Of the calibration.
    considered : int
        Parameters at the tangent's end that are considered, not estimated.
    site : Site, optional
        Noise of the IMU and gravity; the state's by default.
    """

    state: State
    lagged: State
    outgoing: list[State]  # the window, in order of time
    clones: list[State]  # earlier than the first node
    nodes: list[Node]
    prior: WindowPrior
    factors: list[UserFactors]  # on nodes and clones
    waiting: list[UserFactors]  # to be bound at the next epoch after their last time
    dropped: int  # calls with factors whose states are not in the window any more
    _considered_cov: Array

    def __init__(
        self,
        state: State,
        blocks: tuple[Block, ...],
        lag: float,
        process_noise: ProcessNoise,
        considered: int = 0,
        site: Site | None = None,
    ) -> None:
        self.site = state.calibration.site if site is None else site
        self._share, self._considered_cov = considered_share(len(state.cov), considered), state.cov
        self.blocks, self.lag, self.process_noise = blocks, lag, process_noise
        self.state = self.lagged = state
        self.outgoing, self.clones, self.nodes = [], [], []
        self.factors, self.waiting, self.dropped = [], [], 0
        self.prior = WindowPrior.of(state)

    @property
    def oldest(self) -> float:
        """Time of the first state that a new factor may be on (s)."""
        return self.nodes[0].state.time if self.nodes else self.state.time

    def absorb(
        self,
        predicted: Propagated,
        measurements: Sequence[Measurement],
        linearization_point: State | None = None,
    ) -> None:
        """Update with the measurements at the end of an interval.

        Unlike `ErrorStateFilter.absorb`, which solves for one state by a gain, it solves for the
        whole window by elimination.  Both share rows, inertial factor, partial update and chart.
        `predicted`: from ``state``. `measurements`: of this epoch. `linearization_point`: where to
        start the iteration, if the prediction is too uncertain. Raises EstimationError if the
        window cannot be solved; it is then unchanged.
        """
        kept, solved = dict(vars(self)), False
        nodes, passed = self.nodes or [Node(self.state, (), None)], self._has_passed(0)
        new = predicted.state if linearization_point is None else linearization_point
        self.nodes = [*nodes, Node(new, tuple(measurements), predicted.link)]
        try:
            self._bind_factors()
            cov = self._iterate(passed=passed)
            self.nodes[-1] = _at_states(self.nodes[-1])
            for _ in range(0 if linearization_point is None else ITERATIONS_FAR - 1):
                cov = self._iterate()
            self._report_lagged(cov)
            solved = True
        except (RuntimeError, np.linalg.LinAlgError) as error:
            reason = str(error).strip().splitlines()[0]
            raise EstimationError(f"the window could not be solved ({reason})") from error
        finally:
            if not solved:
                dropped = self.dropped + len(self.factors)
                vars(self).update(kept, factors=[], waiting=self.waiting, dropped=dropped)

    def _bind_factors(self) -> None:
        """Make the states of waiting factors whose time has come."""
        newest, waiting = self.nodes[-1].state.time + SAME_TIME, []
        for factors in self.waiting:
            if factors.time[0] < self.oldest - SAME_TIME:
                self.dropped += 1
                continue
            time = [self._with_state_at(t) if t <= newest else t for t in factors.time.tolist()]
            bound = replace(factors, time=np.array(time))
            if time[-1] <= newest:
                self.factors = [*self.factors, bound]
            else:
                waiting.append(bound)
        self.waiting = waiting

    def _with_state_at(self, time: float) -> float:
        """Return the time of the node at a time (s), a new one where there is none."""
        known = np.array([node.state.time for node in self.nodes])
        nearest = float(known[np.argmin(np.abs(known - time))])
        if abs(nearest - time) <= SAME_TIME:
            return nearest
        k = int(np.searchsorted(known, time))
        before, node = self.nodes[k - 1].state, self.nodes[k]
        assert node.link is not None
        first, second = node.link.split(time - before.time, self.site)
        bias = gtsam.imuBias.ConstantBias(before.accel_bias_body, before.gyro_bias_body)
        there = gtsam.NavState(before.pose, before.velocity_world)
        there = first.measurement.predict(there, bias)
        state = replace(
            before,
            time=time,
            world_from_body=there.pose().rotation().matrix(),
            position_world=np.asarray(there.pose().translation()),
            velocity_world=np.asarray(there.velocity()),
        )
        new = [Node(state, (), first), replace(node, link=second)]
        self.nodes = [*self.nodes[:k], *new, *self.nodes[k + 1 :]]
        return time

    def replace_state(self, state: State) -> None:
        """Continue from another state, with its covariance for all that was known."""
        unreported = self.nodes[1:] if self._has_passed(0) else self.nodes
        self.outgoing = [
            *self.outgoing,
            *(n.state for n in unreported if n.state.time < state.time),
        ]
        later = [factors for factors in self.waiting if factors.time[0] >= state.time]
        self.dropped += len(self.factors) + len(self.waiting) - len(later)
        self.factors, self.waiting = [], later
        self.clones, self.nodes, self.prior = [], [], WindowPrior.of(state)
        self.state = self.lagged = state

    def _has_passed(self, number: int) -> bool:
        """Return whether a node is older than the lag: it is output, and then leaves."""
        nodes = self.nodes
        return len(nodes) > 1 and nodes[-1].state.time - nodes[number].state.time > self.lag

    def _iterate(self, *, passed: bool = False) -> Array:
        """Take a step; return the covariance of the first state before it.

        `passed`: whether the first node leaves, linearised with all others.
        """
        graph, clones = self._linearized(self.nodes), list(range(len(self.clones)))
        begin, leaving = len(clones), self._leaving() if passed else []
        joining = self._of_user([own for own in self.factors if own not in leaving])
        if passed:
            graph, clones = self._without_first(graph)
            begin += 1
        graph.push_back(joining)
        last = begin + len(self.nodes) - 1
        # Both ends are eliminated last, so that one elimination gives the covariance of either.
        between_ends = _keys([*clones, *range(begin + 1, last)], None)
        solved, rest = eliminate_partial(graph, between_ends)
        information, vector = rest.hessian(_keys([begin, last], self.calibration_key))
        oldest, newest = slice(0, MOTION), slice(MOTION, None)
        by_newest = np.linalg.solve(information[oldest, oldest], information[oldest, newest])
        own = information[newest, newest] - information[newest, oldest] @ by_newest
        cov = np.asarray(np.linalg.inv(own))
        step = cov @ (vector[newest] - vector[oldest] @ by_newest)
        step, cov = partial_update(step, cov, self._considered_cov, self._share)
        if not np.all(np.isfinite(step)):
            raise EstimationError("the window's step is not finite")
        remaining = vector[oldest] - information[oldest, newest] @ step
        first = np.asarray(np.linalg.solve(information[oldest, oldest], remaining))
        given = gtsam.VectorValues()
        for end, part in ((begin, first), (last, step[:MOTION])):
            for key, own in _split(part, end):
                given.insert(key, own)
        if self.calibration_key is not None:
            given.insert(self.calibration_key, step[MOTION:])
        steps = solved.optimize(given)
        calibration = retract(self.nodes[0].state.calibration, self.blocks, step[MOTION:])

        def stepped(i: int, state: State) -> State:
            motion = np.concatenate([steps.at(X(i)), steps.at(V(i)), steps.at(B(i))])
            return moved_to(state, calibration, motion)

        self.clones = [stepped(i, s) for i, s in zip(clones, self.clones, strict=True)]
        own_nodes = enumerate(self.nodes, begin)
        self.nodes = [replace(node, state=stepped(i, node.state)) for i, node in own_nodes]
        self.state = replace(self.nodes[-1].state, cov=_even(cov))
        return _cov_without(information, LAST)

    @property
    def calibration_key(self) -> int | None:
        """Key of the calibration; None where none is estimated."""
        return CALIBRATION_KEY if dimension(self.blocks) else None

    def _linearized(self, nodes: list[Node]) -> gtsam.GaussianFactorGraph:
        """Return the linear graph of the clones and the first nodes, without a user's factors."""
        native, links = gtsam.NonlinearFactorGraph(), [n.link for n in nodes[1:] if n.link]
        first = len(self.clones)
        for i, link in enumerate(links, first):
            native.add(inertial_factor(i, link.measurement))
        own = [(m, i) for i, n in enumerate(nodes, first) for m in n.measurements]
        measured = tuple(joined((m for m, _ in own), (i for _, i in own)))
        acting = tuple(link for link in links if link.by_calibration is not None)
        states = [*self.clones, *(n.state for n in nodes)]
        graph = Graph(native, measured, None, self.blocks, len(states), acting)
        linear = graph.linearized(GraphEstimate(values_of(states), nodes[0].state.calibration))
        linear.push_back(self.prior.factor(range(first + 1), states[: first + 1], self.blocks))
        return linear

    def _of_user(self, several: list[UserFactors]) -> gtsam.GaussianFactorGraph:
        """Return the linear graph of a user's factors."""
        linear = gtsam.GaussianFactorGraph()
        if several:
            states = [*self.clones, *(n.state for n in self.nodes)]
            time, values = np.array([s.time for s in states]), values_of(states)
            for factors in several:
                linear.push_back(factors.among(time).marginalized(values))
        return linear

    def _leaving(self) -> list[UserFactors]:
        """Return the factors whose last state is the first node."""
        time = self.nodes[0].state.time
        return [factors for factors in self.factors if factors.time[-1] <= time]

    def _report_lagged(self, cov: Array) -> None:
        """Output the states that are older than the lag; the last leaves with the next epoch.

        Then the whole window is linearised at its current states, and no node twice. `cov`: of the
        first state, from the last step; the same one step later.
        """
        while self._has_passed(0):
            self.lagged = replace(self.nodes[0].state, cov=cov)
            self.outgoing = [*self.outgoing, self.lagged]
            if not self._has_passed(1):
                return
            first, second = self.nodes[:2]
            self._leave(self._linearized([first, replace(second, measurements=())]))
            cov = self._cov_of_first()

    def _cov_of_first(self) -> Array:
        """Return the covariance of the first state, given the whole window and its past."""
        first, graph = len(self.clones), self._linearized(self.nodes)
        graph.push_back(self._of_user(self.factors))
        others = [*range(first + len(self.nodes) - 1, first, -1), *range(first)]
        _, rest = eliminate_partial(graph, _keys(others, None))
        information, _ = rest.hessian(_keys([first], self.calibration_key))
        return _even(np.asarray(np.linalg.inv(information)))

    def _without_first(
        self, graph: gtsam.GaussianFactorGraph
    ) -> tuple[gtsam.GaussianFactorGraph, list[int]]:
        """Return a linear graph with its first node marginalized, and the numbers of the clones."""
        own, others = gtsam.GaussianFactorGraph(), gtsam.GaussianFactorGraph()
        first = len(self.clones)
        keys = {X(first), V(first), B(first)}
        for i in range(graph.size()):
            factor = graph.at(i)
            (others if keys.isdisjoint(factor.keys()) else own).push_back(factor)
        clones = self._leave(own)
        states = [*self.clones, self.nodes[0].state]
        others.push_back(self.prior.factor([*clones, first + 1], states, self.blocks))
        return others, clones

    def _leave(self, graph: gtsam.GaussianFactorGraph) -> list[int]:
        """Marginalize the first node: its information in a linear graph becomes a prior.

        A state that remaining factors are on becomes a clone.  Return the clones' old numbers.
        """
        (first, second), leaving = self.nodes[:2], self._leaving()
        graph.push_back(self._of_user(leaving))
        self.factors = [factors for factors in self.factors if factors not in leaving]
        states, wanted = [*self.clones, first.state], {t for f in self.factors for t in f.time}
        clones = [i for i, state in enumerate(states) if state.time in wanted]
        others = [i for i in range(len(states)) if i not in clones]
        _, rest = eliminate_partial(graph, _keys(others, None), orthogonal=True)
        remaining = _keys([*clones, len(states)], self.calibration_key)
        sqrt_information, right = rest.jacobian(remaining)
        passed = second.state.time - first.state.time
        noise = self.process_noise.cov(second.state.calibration, second.state.time, passed)
        self.clones, self.nodes = [states[i] for i in clones], self.nodes[1:]
        prior = WindowPrior((*self.clones, second.state), *triangular(sqrt_information, right))
        self.prior = prior.predicted(noise, self._considered_cov, self._share)
        return clones


def _at_states(node: Node) -> Node:
    return replace(node, measurements=tuple(m.at_states() for m in node.measurements))


def _keys(nodes: range | list[int], calibration: int | None) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for i in nodes:
        for symbol in (X, V, B):
            ordering.push_back(symbol(i))
    if calibration is not None:
        ordering.push_back(calibration)
    return ordering


def _split(step: Array, node: int) -> list[tuple[int, Array]]:
    return [(X(node), step[:6]), (V(node), step[6:9]), (B(node), step[9:15])]


def _cov_without(information: Array, others: slice) -> Array:
    """Return the covariance of all variables except some."""
    kept = np.delete(np.arange(len(information)), others)
    by_kept = information[others, kept]
    gained = by_kept.T @ np.linalg.solve(information[others, others], by_kept)
    return _even(np.asarray(np.linalg.inv(information[np.ix_(kept, kept)] - gained)))


def _even(cov: Array) -> Array:
    return np.asarray(0.5 * (cov + cov.T))
