"""The fixed-lag smoother: a sliding window of the batch smoother's own factors.

All of the window is linearised anew at each epoch, and what leaves it stays as a prior.  GTSAM's
`IncrementalFixedLagSmoother` would take a callback for each field factor and relinearise when it
sees fit; here the time of an update is that of the window, whatever happens.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.errors import EstimationError
from magfusion.fusion.factors import CALIBRATION_KEY, FieldFactors, FieldMeasurements
from magfusion.fusion.propagation import Propagated
from magfusion.fusion.state import MOTION, State, between, considered, moved_to, pose_of
from magfusion.fusion.walk import Walk
from magfusion.parameters import Block, dimension, retract
from magfusion.units import Array

ITERATIONS_FAR = 4  # where the prediction is too wide to linearise at


@dataclass(frozen=True, eq=False)
class Node:
    """One epoch in the window.

    Parameters
    ----------
    state : State
        Its calibration is the window's.
    fields : FieldMeasurements
        Of one epoch; with a root of zero where nothing was measured.
    rest_sigma : float, optional
        (m/s)
    measurement : gtsam.PreintegratedCombinedMeasurementsG, optional
        From the node before; None for the first.
    """

    state: State
    fields: FieldMeasurements
    rest_sigma: float | None
    measurement: gtsam.PreintegratedCombinedMeasurementsG | None


@dataclass(frozen=True, eq=False)
class Prior:
    """``|root @ step - right|^2`` with the step from ``about`` to the first node's state."""

    about: State
    root: Array
    right: Array


class SlidingWindow:
    """Fixed-lag smoother.

    Parameters
    ----------
    state : State
        The start, with its covariance.
    blocks : tuple of Block
        Calibration parameters in its tangent.
    lag : float
        Length of the window (s).
    walk : Walk
        Of the calibration.
    applied_offset : float
        IMU time offset with which the inertial data are cut (s).
    earth : bool
        Whether epochs hold the Earth field.
    held : int
        Parameters at the tangent's end that are considered, not estimated.
    """

    def __init__(
        self,
        state: State,
        blocks: tuple[Block, ...],
        lag: float,
        walk: Walk,
        applied_offset: float,
        *,
        earth: bool = False,
        held: int = 0,
    ) -> None:
        self.held, self._held_cov = held, state.cov
        self.applied_offset, self.earth = applied_offset, earth
        self.blocks, self.lag, self.walk = blocks, lag, walk
        self.state = self.lagged = state
        self.left: list[State] = []  # the window, in order of time
        self.nodes: list[Node] = []
        self.prior = _prior_of(state)

    def absorb(
        self,
        predicted: Propagated,
        fields: FieldFactors | None,
        rest_sigma: float | None,
        about: State | None = None,
    ) -> None:
        """Take in what was measured at the end of an interval.

        Parameters
        ----------
        predicted : Propagated
            From ``state``.
        fields : FieldFactors, optional
            Of the epoch.
        rest_sigma : float, optional
            Standard deviation of the velocity, where the platform stands (m/s).
        about : State, optional
            Where to start the iteration, if the prediction is too wide for it.

        Raises
        ------
        EstimationError
            Where the window cannot be solved; it is then as it was.
        """
        kept = (self.nodes, self.prior, self.state, self.lagged, self.left)
        if not self.nodes:
            nothing = self._nothing(self.state)
            self.nodes = [Node(self.state, nothing, None, None)]
        new = predicted.state if about is None else about
        measured = self._nothing(new) if fields is None else fields.measurements
        self.nodes = [*self.nodes, Node(new, measured, rest_sigma, predicted.measurement)]
        try:
            for _ in range(1 if about is None else ITERATIONS_FAR):
                self._iterate()
            while self.nodes[-1].state.time - self.nodes[0].state.time > self.lag:
                self._drop_first()
        except (RuntimeError, np.linalg.LinAlgError) as error:
            self.nodes, self.prior, self.state, self.lagged, self.left = kept
            reason = str(error).strip().splitlines()[0]
            raise EstimationError(f"the window could not be solved ({reason})") from error

    def replace_state(self, state: State) -> None:
        """Go on from another state, with its covariance for all that was known."""
        self.left = [*self.left, *(n.state for n in self.nodes if n.state.time < state.time)]
        self.nodes, self.prior = [], _prior_of(state)
        self.state = self.lagged = state

    def _iterate(self) -> None:
        graph = self._linearized(self.nodes)
        last = len(self.nodes) - 1
        solved, rest = _eliminated(graph, _keys(range(last), None))
        information, vector = rest.hessian(_keys([last], self.calibration_key))
        cov = np.asarray(np.linalg.inv(information))
        step, cov = considered(cov @ vector, cov, self._held_cov, self.held)
        if not np.all(np.isfinite(step)):
            raise EstimationError("the window's step is not finite")
        given = gtsam.VectorValues()
        for key, part in _split(step, last, self.calibration_key):
            given.insert(key, part)
        steps = solved.optimize(given)
        calibration = retract(self.nodes[0].state.calibration, self.blocks, step[MOTION:])
        nodes = []
        for i, node in enumerate(self.nodes):
            motion = np.concatenate([steps.at(X(i)), steps.at(V(i)), steps.at(B(i))])
            nodes.append(replace(node, state=moved_to(node.state, calibration, motion)))
        self.nodes = nodes
        self.state = replace(nodes[-1].state, cov=0.5 * (cov + cov.T))

    @property
    def calibration_key(self) -> int | None:
        """Key of the calibration; None where none is estimated."""
        return CALIBRATION_KEY if dimension(self.blocks) else None

    def _linearized(self, nodes: list[Node]) -> gtsam.GaussianFactorGraph:
        """Return the linear graph of the first nodes of the window."""
        values, native = gtsam.Values(), gtsam.NonlinearFactorGraph()
        for i, node in enumerate(nodes):
            state = node.state
            values.insert(X(i), pose_of(state))
            values.insert(V(i), state.velocity_world)
            bias = gtsam.imuBias.ConstantBias(state.accel_bias_body, state.gyro_bias_body)
            values.insert(B(i), bias)
            if i:
                assert node.measurement is not None
                native.add(
                    gtsam.GalileanCombinedImuFactor(
                        X(i - 1), V(i - 1), X(i), V(i), B(i - 1), B(i), node.measurement
                    )
                )
        graph = native.linearize(values)
        graph.push_back(self._prior_factor(nodes[0].state))
        fields = FieldFactors(_stacked([n.fields for n in nodes]), self.blocks, None)
        fields.linearize(values, nodes[0].state.calibration)
        graph.push_back(fields.graph)
        for i, node in enumerate(nodes):
            if node.rest_sigma is not None:
                graph.push_back(_rest_factor(i, node.state.velocity_world, node.rest_sigma))
        return graph

    def _prior_factor(self, first: State) -> gtsam.JacobianFactor:
        prior = self.prior
        right = prior.right - prior.root @ between(prior.about, first, self.blocks)
        factor = _empty_factor(len(right), self.calibration_key, dimension(self.blocks))
        factor.getA()[...] = prior.root
        factor.getb()[...] = right
        return factor

    def _nothing(self, state: State) -> FieldMeasurements:
        rows = len(state.calibration.site.channels) + self.earth
        return FieldMeasurements(
            time=np.array([state.time]),
            measured=np.zeros((1, rows, 6)),
            root=np.zeros((1, rows, 6, 6)),
            rate_body=np.zeros((1, 3)),
            applied_offset=self.applied_offset,
            by_time_offset=np.zeros((1, rows, 6)),
            earth_repeats=1.0 if self.earth else None,
        )

    def _cov_of_first(self) -> Array:
        """Return the covariance of the first state, the whole window and its past considered."""
        later = range(len(self.nodes) - 1, 0, -1)
        _, rest = _eliminated(self._linearized(self.nodes), _keys(later, None))
        information, _ = rest.hessian(_keys([0], self.calibration_key))
        cov = np.linalg.inv(information)
        return np.asarray(0.5 * (cov + cov.T))

    def _drop_first(self) -> None:
        """Leave what the first node tells as a prior of the second."""
        first, second = self.nodes[:2]
        cov = self._cov_of_first()
        graph = self._linearized([first, replace(second, rest_sigma=None, fields=_blank(second))])
        _, rest = graph.eliminatePartialSequential(_keys([0], None), gtsam.EliminateQR)
        root, right = rest.jacobian(_keys([1], self.calibration_key))
        passed = second.state.time - first.state.time
        noise = self.walk.cov(second.state.calibration, second.state.time, passed)
        root, right = self._carried(root, right, noise)
        self.prior = Prior(second.state, root, right)
        self.lagged = replace(first.state, cov=cov)
        self.left = [*self.left, self.lagged]
        self.nodes = self.nodes[1:]

    def _carried(self, root: Array, right: Array, noise: Array) -> tuple[Array, Array]:
        """Return the prior of later: some of the calibration drifts, some is not to be learnt."""
        triangular = np.asarray(np.linalg.qr(np.column_stack([root, right])).R)
        size = root.shape[1]
        root, right = triangular[:size, :size], triangular[:size, size]
        if not (self.held or np.any(noise > 0.0)):
            return root, right
        inverse = np.linalg.inv(root)
        mean, cov = considered(inverse @ right, inverse @ inverse.T, self._held_cov, self.held)
        cov[MOTION:, MOTION:] += noise
        wide = np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))
        return wide, wide @ mean


def _empty_factor(rows: int, calibration: int | None, columns: int) -> gtsam.JacobianFactor:
    """Return a factor of the first node, to be filled: no constructor takes four keys."""
    unit = gtsam.noiseModel.Unit.Create
    most = rows - 1
    parts = gtsam.GaussianFactorGraph()
    parts.push_back(
        gtsam.JacobianFactor(
            X(0), np.zeros((most, 6)), V(0), np.zeros((most, 3)), np.zeros(most), unit(most)
        )
    )
    bias, one = np.zeros((1, 6)), np.zeros(1)
    if calibration is None:
        parts.push_back(gtsam.JacobianFactor(B(0), bias, one, unit(1)))
    else:
        own = np.zeros((1, columns))
        parts.push_back(gtsam.JacobianFactor(B(0), bias, calibration, own, one, unit(1)))
    return gtsam.JacobianFactor(parts, _keys([0], calibration))


def _prior_of(state: State) -> Prior:
    root = np.linalg.inv(np.linalg.cholesky(state.cov))
    return Prior(state, root, np.zeros(len(root)))


def _keys(nodes: range | list[int], calibration: int | None) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for i in nodes:
        for symbol in (X, V, B):
            ordering.push_back(symbol(i))
    if calibration is not None:
        ordering.push_back(calibration)
    return ordering


def _split(step: Array, node: int, calibration: int | None) -> list[tuple[int, Array]]:
    parts = [(X(node), step[:6]), (V(node), step[6:9]), (B(node), step[9:15])]
    return parts if calibration is None else [*parts, (calibration, step[MOTION:])]


def _eliminated(
    graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> tuple[gtsam.GaussianBayesNet, gtsam.GaussianFactorGraph]:
    try:
        return graph.eliminatePartialSequential(ordering)
    except RuntimeError:  # an ill-conditioned stretch: QR needs half the digits
        return graph.eliminatePartialSequential(ordering, gtsam.EliminateQR)


def _rest_factor(node: int, velocity_world: Array, sigma: float) -> gtsam.JacobianFactor:
    unit = gtsam.noiseModel.Unit.Create(3)
    return gtsam.JacobianFactor(V(node), np.eye(3) / sigma, -velocity_world / sigma, unit)


def _blank(node: Node) -> FieldMeasurements:
    return replace(node.fields, root=np.zeros_like(node.fields.root))


def _stacked(parts: list[FieldMeasurements]) -> FieldMeasurements:
    """Return the epochs of a window as one; all were cut with the same time offset."""
    return FieldMeasurements(
        time=np.concatenate([p.time for p in parts]),
        measured=np.concatenate([p.measured for p in parts]),
        root=np.concatenate([p.root for p in parts]),
        rate_body=np.concatenate([p.rate_body for p in parts]),
        applied_offset=parts[-1].applied_offset,
        by_time_offset=np.concatenate([p.by_time_offset for p in parts]),
        earth_repeats=parts[-1].earth_repeats,
    )
