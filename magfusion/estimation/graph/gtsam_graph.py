"""The graph of a solved log as GTSAM's own nonlinear graph, for its optimisers and for users."""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.gtsam_factors import (
    CalibrationKeys,
    fill,
    linear_factor,
    measurement_factors,
    whitened_factor,
)
from magfusion.estimation.graph.inertial import ROWS
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.solve.ordering import nested_dissection
from magfusion.model.parameters import Block, difference, dimension
from magfusion.model.short_repr import short_repr
from magfusion.units import Array

WIDTHS = {"x": 6, "v": 3, "b": 6}


@dataclass(frozen=True, eq=False)
class GtsamGraph:
    """A solved log as GTSAM has it.

    Parameters
    ----------
    graph : gtsam.NonlinearFactorGraph
        Priors and inertial factors, measurements, the calibration's prior and drift, then those
        of a user's.
    values : gtsam.Values
        Poses X(k), velocities V(k) (m/s), biases B(k), and the calibration's steps C(i) from the
        declared value of block ``i``; in a log with segments D(s) has those that drift.
    time : ndarray, shape (epochs,)
        Of the states (s).
    blocks : tuple of Block
        Calibration parameters of C(i).
    """

    __repr__ = short_repr

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    time: Array
    blocks: tuple[Block, ...]


class NativeProblem:
    """The problem of a `Graph` for GTSAM's optimisers.

    `estimate`: determines which variables a measurement depends on.
    """

    def __init__(self, problem: Graph, estimate: GraphEstimate) -> None:
        self.problem, segments = problem, range(len(problem.segments))
        declared = estimate.calibration if problem.declared is None else problem.declared
        self.keys = [
            CalibrationKeys(declared, problem.blocks, problem.segments.own(k)) for k in segments
        ]
        self.values = gtsam.Values(estimate.values)
        self.keys[problem.segments.main].insert(self.values, estimate.calibration)
        for k in segments:
            self.keys[k].insert(self.values, estimate.at(k))
        if problem.user is not None:
            self.values.insert(problem.user.values if estimate.own is None else estimate.own)
        self.graph = gtsam.NonlinearFactorGraph()
        for factor in self._factors():
            self.graph.add(factor)

    @property
    def ordering(self) -> gtsam.Ordering:
        """Elimination order of `Graph`, with the keys of the calibration in place of its own."""
        ordering = nested_dissection(self.problem.epochs, None)
        motion = {ordering.at(i) for i in range(ordering.size())}
        for key in reversed([key for key in list(self.values.keys()) if key not in motion]):
            ordering.push_back(key)
        return ordering

    def estimate(self, values: gtsam.Values) -> GraphEstimate:
        """Return the estimate at values of the graph."""
        motion, own = gtsam.Values(values), self.own(values)
        calibrations = tuple(keys.calibration(values) for keys in self.keys)
        steps = {key for keys in self.keys for key, _ in keys.parts}
        for key in [*steps, *own.keys()]:
            motion.erase(key)
        several = calibrations if len(calibrations) > 1 else ()
        return GraphEstimate(motion, calibrations[self.problem.segments.main], several, own)

    def own(self, values: gtsam.Values) -> gtsam.Values:
        """Return the values of the own keys of a user's factors."""
        known, out = self.problem.user, gtsam.Values()
        if known is not None and known.own:
            out, own = gtsam.Values(values), {key for key, _ in known.own}
            for key in set(values.keys()) - own:
                out.erase(key)
        return out

    def _factors(self) -> Iterator[gtsam.NonlinearFactor]:
        problem = self.problem
        first = problem.native.size() - len(problem.links)
        for i in range(problem.native.size()):
            factor = problem.native.at(i)
            yield factor if i < first else self._inertial(factor, i - first)
        for factors in problem.factors:
            keys = self.keys[factors.segment]
            yield from measurement_factors(factors.measurement, keys, self.values)
        main = self.keys[problem.segments.main]
        if problem.blocks and problem.declared is not None:
            yield main.prior_factor()
        for k, whitening in enumerate(problem.segments.sqrt_information):
            yield self._drift(k, whitening)
        if problem.user is not None:
            for i in range(problem.user.graph.size()):
                yield self._renamed(problem.user, problem.user.graph.at(i))

    def _renamed(self, user: UserFactors, factor: gtsam.NonlinearFactor) -> gtsam.NonlinearFactor:
        """Return a factor of a user's on the keys of this graph."""
        keys = [user.key(key) for key in list(factor.keys())]
        try:
            return factor.rekey(keys)
        except RuntimeError:  # a CustomFactor cannot be copied
            assert isinstance(factor, gtsam.NoiseModelFactor)
            own, noise = factor, factor.noiseModel()
            assert isinstance(noise, gtsam.noiseModel.Robust | gtsam.noiseModel.Gaussian)
            robust = isinstance(noise, gtsam.noiseModel.Robust)
            whiten = noise.unweightedWhiten if robust else noise.whiten

        def error(
            _this: gtsam.NoiseModelFactor, values: gtsam.Values, jacobians: list[Array] | None
        ) -> Array:
            at = user.named(values, self.own(values))
            whitened = whiten(own.unwhitenedError(at))
            if jacobians is not None:
                linear, zero = gtsam.JacobianFactor(own.linearize(at)), at.zeroVectors()
                # The loss weights the rows of this graph's factor again.
                size = np.linalg.norm(linear.getb())
                unweighted = np.linalg.norm(whitened) / size if size > 0.0 else 1.0
                widths = [len(zero.at(key)) for key in list(own.keys())]
                parts = np.split(linear.getA(), np.cumsum(widths)[:-1], axis=1)
                fill(jacobians, [unweighted * part for part in parts])
            return whitened

        return whitened_factor(keys, own.dim(), error, noise)

    def _inertial(self, factor: gtsam.NonlinearFactor, k: int) -> gtsam.NonlinearFactor:
        """Return an inertial factor with the calibration that acts on its stream."""
        by_calibration = self.problem.links[k].by_calibration
        keys = self.keys[int(self.problem.segments.at(np.array(k)))]
        if by_calibration is None or not keys.blocks:
            return factor
        own = by_calibration[:, : dimension(keys.blocks)]
        corrected = self.problem.links[k].calibration

        def error(
            _this: gtsam.NoiseModelFactor, values: gtsam.Values, jacobians: list[Array] | None
        ) -> Array:
            linear = factor.linearize(values)
            assert isinstance(linear, gtsam.JacobianFactor)
            calibration, by_values = keys.charted(values)
            if jacobians is not None:
                motion = np.split(linear.getA(), np.cumsum(widths)[:-1], axis=1)
                fill(jacobians, [*motion, *keys.by_parts(own @ by_values)])
            moved = difference(corrected, calibration, keys.blocks)
            return np.asarray(own @ moved - linear.getb())

        motion_keys = list(factor.keys())
        widths = [WIDTHS[chr(gtsam.Symbol(key).chr())] for key in motion_keys]
        every = [*motion_keys, *(key for key, _ in keys.parts)]
        return whitened_factor(every, ROWS, error)

    def _drift(self, k: int, whitening: Array) -> gtsam.NoiseModelFactor:
        """Return the random walk of the drifting parameters from a segment to the next."""
        columns, parts = self.problem.segments.drifting, []
        for segment, sign in ((k, -1.0), (k + 1, 1.0)):
            whole = np.zeros((len(whitening), dimension(self.problem.blocks)))
            whole[:, columns] = sign * whitening
            keys = self.keys[segment]
            own = zip(keys.parts, keys.by_parts(whole), strict=True)
            parts += [(part.key, by) for part, by in own if by.any()]
        return linear_factor(parts)
