"""The fixed-lag smoother: a sliding window of the batch smoother's own factors.

The whole window is linearised again at each epoch, and what leaves it becomes a prior.  GTSAM's
`IncrementalFixedLagSmoother` would need a callback for each field factor and relinearise when it
decides to; here the time of an update depends on the window only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.errors import EstimationError
from magfusion.estimation.graph.factors import CALIBRATION_KEY, empty_factor
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.inertial import Link, inertial_factor
from magfusion.estimation.graph.kalman import considered_share, partial_update
from magfusion.estimation.graph.measurement import Measurement, joined
from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.propagation import Propagated
from magfusion.estimation.graph.state import (
    MOTION,
    State,
    between,
    moved_to,
    values_of,
)
from magfusion.estimation.solve.bordered import eliminate_partial
from magfusion.model.parameters import Block, dimension, retract
from magfusion.units import Array

ITERATIONS_FAR = 4  # where the prediction is too uncertain to linearise at
LAST = slice(MOTION, 2 * MOTION)  # of the first state, the last and the calibration


@dataclass(frozen=True, eq=False)
class Node:
    """One epoch in the window.

    Parameters
    ----------
    state : State
        Its calibration is the window's.
    measurements : tuple of Measurement
        Of this epoch.
    link : Link, optional
        From the previous node; None for the first.
    """

    state: State
    measurements: tuple[Measurement, ...]
    link: Link | None


@dataclass(frozen=True, eq=False)
class WindowPrior:
    """``|sqrt_information @ step - right|^2``, steps from its point to the first node's state."""

    linearization_point: State
    sqrt_information: Array
    right: Array


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
    """

    state: State
    lagged: State
    outgoing: list[State]  # the window, in order of time
    nodes: list[Node]
    prior: WindowPrior
    _considered_cov: Array

    def __init__(
        self,
        state: State,
        blocks: tuple[Block, ...],
        lag: float,
        process_noise: ProcessNoise,
        considered: int = 0,
    ) -> None:
        self._share, self._considered_cov = considered_share(len(state.cov), considered), state.cov
        self.blocks, self.lag, self.process_noise = blocks, lag, process_noise
        self.state = self.lagged = state
        self.outgoing, self.nodes = [], []
        self.prior = _prior_of(state)

    def absorb(
        self,
        predicted: Propagated,
        measurements: Sequence[Measurement],
        linearization_point: State | None = None,
    ) -> None:
        """Update with the measurements at the end of an interval.

        Unlike `ErrorStateFilter.absorb`, which solves for one state by a gain, it solves for the
        whole window by elimination.  Both share rows, inertial factor, partial update and chart.

        Parameters
        ----------
        predicted : Propagated
            From ``state``.
        measurements : sequence of Measurement
            Of this epoch.
        linearization_point : State, optional
            Where to start the iteration, if the prediction is too uncertain.

        Raises
        ------
        EstimationError
            If the window cannot be solved; it is then unchanged.
        """
        kept = (self.nodes, self.prior, self.state, self.lagged, self.outgoing)
        nodes, passed = self.nodes or [Node(self.state, (), None)], self._has_passed(0)
        new = predicted.state if linearization_point is None else linearization_point
        self.nodes = [*nodes, Node(new, tuple(measurements), predicted.link)]
        try:
            cov = self._iterate(passed=passed)
            self.nodes[-1] = _at_states(self.nodes[-1])
            for _ in range(0 if linearization_point is None else ITERATIONS_FAR - 1):
                cov = self._iterate()
            self._report_lagged(cov)
        except (RuntimeError, np.linalg.LinAlgError) as error:
            self.nodes, self.prior, self.state, self.lagged, self.outgoing = kept
            reason = str(error).strip().splitlines()[0]
            raise EstimationError(f"the window could not be solved ({reason})") from error

    def replace_state(self, state: State) -> None:
        """Continue from another state, with its covariance for all that was known."""
        unreported = self.nodes[1:] if self._has_passed(0) else self.nodes
        self.outgoing = [
            *self.outgoing,
            *(n.state for n in unreported if n.state.time < state.time),
        ]
        self.nodes, self.prior = [], _prior_of(state)
        self.state = self.lagged = state

    def _has_passed(self, number: int) -> bool:
        """Return whether a node is older than the lag: it is output, and then leaves."""
        nodes = self.nodes
        return len(nodes) > 1 and nodes[-1].state.time - nodes[number].state.time > self.lag

    def _iterate(self, *, passed: bool = False) -> Array:
        """Take a step; return the covariance of the first state before it.

        Parameters
        ----------
        passed : bool
            Whether the first node leaves, linearised with all others.
        """
        graph, begin = self._linearized(self.nodes), 0
        if passed:
            graph, begin = self._without_first(graph), 1
        last = begin + len(self.nodes) - 1
        # Both ends are eliminated last, so that one elimination gives the covariance of either.
        solved, rest = eliminate_partial(graph, _keys(range(begin + 1, last), None))
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
        nodes = []
        for i, node in enumerate(self.nodes, begin):
            motion = np.concatenate([steps.at(X(i)), steps.at(V(i)), steps.at(B(i))])
            nodes.append(replace(node, state=moved_to(node.state, calibration, motion)))
        self.nodes = nodes
        self.state = replace(nodes[-1].state, cov=_even(cov))
        return _cov_without(information, LAST)

    @property
    def calibration_key(self) -> int | None:
        """Key of the calibration; None where none is estimated."""
        return CALIBRATION_KEY if dimension(self.blocks) else None

    def _linearized(self, nodes: list[Node]) -> gtsam.GaussianFactorGraph:
        """Return the linear graph of the first nodes of the window."""
        native, links = gtsam.NonlinearFactorGraph(), [n.link for n in nodes[1:] if n.link]
        for i, link in enumerate(links):
            native.add(inertial_factor(i, link.measurement))
        own = [(m, i) for i, n in enumerate(nodes) for m in n.measurements]
        measured = tuple(joined((m for m, _ in own), (i for _, i in own)))
        acting = tuple(link for link in links if link.by_calibration is not None)
        graph = Graph(native, measured, None, self.blocks, len(nodes), acting)
        states = [n.state for n in nodes]
        linear = graph.linearized(GraphEstimate(values_of(states), states[0].calibration))
        linear.push_back(self._prior_factor(states[0]))
        return linear

    def _prior_factor(self, first: State, number: int = 0) -> gtsam.JacobianFactor:
        """Return the prior of a node's state."""
        prior = self.prior
        moved = between(prior.linearization_point, first, self.blocks)
        right = prior.right - prior.sqrt_information @ moved
        parts = [(X(number), 6), (V(number), 3), (B(number), 6)]
        if self.blocks:
            parts.append((CALIBRATION_KEY, dimension(self.blocks)))
        factor = empty_factor(parts, len(right))
        factor.getA()[...] = prior.sqrt_information
        factor.getb()[...] = right
        return factor

    def _report_lagged(self, cov: Array) -> None:
        """Output the states that are older than the lag; the last leaves with the next epoch.

        Then the whole window is linearised at its current states, and no node twice.

        Parameters
        ----------
        cov : ndarray
            Of the first state, from the last step; the same one step later.
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
        later = range(len(self.nodes) - 1, 0, -1)
        _, rest = eliminate_partial(self._linearized(self.nodes), _keys(later, None))
        information, _ = rest.hessian(_keys([0], self.calibration_key))
        return _even(np.asarray(np.linalg.inv(information)))

    def _without_first(self, graph: gtsam.GaussianFactorGraph) -> gtsam.GaussianFactorGraph:
        """Return a window's linear graph with its first node marginalized to a prior."""
        own, others = gtsam.GaussianFactorGraph(), gtsam.GaussianFactorGraph()
        keys = {X(0), V(0), B(0)}
        for i in range(graph.size()):
            factor = graph.at(i)
            (others if keys.isdisjoint(factor.keys()) else own).push_back(factor)
        self._leave(own)
        others.push_back(self._prior_factor(self.nodes[0].state, 1))
        return others

    def _leave(self, graph: gtsam.GaussianFactorGraph) -> None:
        """Marginalize the first node: its information in a linear graph becomes a prior."""
        first, second = self.nodes[:2]
        _, rest = eliminate_partial(graph, _keys([0], None), orthogonal=True)
        sqrt_information, right = rest.jacobian(_keys([1], self.calibration_key))
        passed = second.state.time - first.state.time
        noise = self.process_noise.cov(second.state.calibration, second.state.time, passed)
        sqrt_information, right = self._predicted_prior(sqrt_information, right, noise)
        self.prior = WindowPrior(second.state, sqrt_information, right)
        self.nodes = self.nodes[1:]

    def _predicted_prior(
        self, sqrt_information: Array, right: Array, noise: Array
    ) -> tuple[Array, Array]:
        """Return the prior with calibration drift added and considered parameters unlearnt."""
        triangular = np.asarray(np.linalg.qr(np.column_stack([sqrt_information, right])).R)
        size = sqrt_information.shape[1]
        sqrt_information, right = triangular[:size, :size], triangular[:size, size]
        if self._share is None and not np.any(noise > 0.0):
            return sqrt_information, right
        inverse = np.linalg.inv(sqrt_information)
        mean, cov = partial_update(
            inverse @ right, inverse @ inverse.T, self._considered_cov, self._share
        )
        cov[MOTION:, MOTION:] += noise
        wide = np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))
        return wide, wide @ mean


def _at_states(node: Node) -> Node:
    return replace(node, measurements=tuple(m.at_states() for m in node.measurements))


def _prior_of(state: State) -> WindowPrior:
    sqrt_information = np.linalg.inv(np.linalg.cholesky(state.cov))
    return WindowPrior(state, sqrt_information, np.zeros(len(sqrt_information)))


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
