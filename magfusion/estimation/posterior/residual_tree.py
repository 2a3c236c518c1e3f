"""Remainders of errors after the estimate of a log, by GTSAM's elimination: for any graph."""

from collections.abc import Sequence

import gtsam
import numpy as np

from magfusion.estimation.graph.factors import CONSIDERED_KEY
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.inertial import ROWS
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.solve.bordered import eliminate, eliminate_in_sequence
from magfusion.model.parameters import Block
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.units import Array, IntArray


def left_by_tree(
    graph: Graph,
    estimate: GraphEstimate,
    considered: tuple[Block, ...],
    fields: Sequence[Array],
    inertial: Sequence[Array],
) -> tuple[Array, Array]:
    """Return the same as `left_by_chain` of `residual_covariance_chain`."""
    system = _System(graph, estimate, considered)
    shape = next(
        (len(m.epoch), m.measured.shape[1], 6)
        for m in graph.measurements
        if isinstance(m, FieldPhasors)
    )
    residual = [system.residuals()]
    for own, columns in zip(fields, inertial, strict=True):
        system.put(own.reshape(len(own), -1), columns)
        residual.append(system.residuals())
    return (
        np.array([field.reshape(shape) for field, _ in residual]),
        np.array([own for _, own in residual]),
    )


class _System:
    """The linear system of a solved graph, with variable right-hand sides."""

    def __init__(
        self, graph: Graph, estimate: GraphEstimate, considered: tuple[Block, ...]
    ) -> None:
        self._linear, self._ordering, begin = _linear(graph, estimate, considered)
        every = _jacobians(self._linear)
        last = graph.native.size()
        self._every, self._inertial = every, every[last - graph.epochs + 1 : last]
        self._fields: list[gtsam.JacobianFactor] = []
        self._informative_rows: list[slice | IntArray] = []
        for factors in graph.factors:
            end = begin + len(factors.measurement.epoch)
            if isinstance(factors.measurement, FieldPhasors):
                self._fields += every[begin:end]
                self._informative_rows += factors.informative_rows
                self._width = factors.measurement.measured[0].size
            begin = end
        self._net = eliminate_in_sequence(self._linear, self._ordering)

    def put(self, fields: Array, inertial: Array) -> None:
        """Set right-hand sides: of fields (n, rows), and of inertial factors."""
        for factor in self._every:
            factor.getb()[...] = 0.0
        for factor, own, reported in zip(self._fields, fields, self._informative_rows, strict=True):
            part = own[reported]
            factor.getb()[: part.size] = part
        for factor, own in zip(self._inertial, inertial, strict=True):
            factor.getb()[: own.size] = own

    def residuals(self) -> tuple[Array, Array]:
        """Return the remainders of the right-hand sides."""
        step = self._step()
        rows = np.zeros((len(self._fields), self._width))
        for row, factor, reported in zip(rows, self._fields, self._informative_rows, strict=True):
            row[reported] = factor.error_vector(step)[: row[reported].size]
        own = [factor.error_vector(step)[:ROWS] for factor in self._inertial]
        return rows, np.array(own).reshape(-1, ROWS)

    def _step(self) -> gtsam.VectorValues:
        """Return the solution of the linear system for the present right-hand sides."""
        if self._net is None:
            return eliminate(self._linear, self._ordering).optimize()
        # One elimination serves all: its triangle and its transpose are solved with each.
        uphill = self._linear.gradientAtZero()
        step = self._net.backSubstitute(self._net.backSubstituteTranspose(uphill))
        return step.scale(-1.0)


def _linear(
    graph: Graph, estimate: GraphEstimate, considered: tuple[Block, ...]
) -> tuple[gtsam.GaussianFactorGraph, gtsam.Ordering, int]:
    """Return a linear graph that estimates considered parameters, and its first field factor."""
    ordering = graph.ordering
    if not considered or graph.declared is None:
        return graph.linearized(estimate), ordering, graph.native.size()
    spread = prior_sqrt_covariance(graph.declared.site, considered)
    by_inertial = graph.by_considered(spread)
    linear = graph.with_fixed_columns(estimate, considered, spread, by_inertial, explaining=True)
    fields = linear.size() - sum(len(part.measurement.epoch) for part in graph.factors)
    count = spread.shape[1]
    unit = gtsam.noiseModel.Unit.Create(count)
    linear.push_back(gtsam.JacobianFactor(CONSIDERED_KEY, np.eye(count), np.zeros(count), unit))
    ordering.push_back(CONSIDERED_KEY)
    return linear, ordering, fields


def _jacobians(linear: gtsam.GaussianFactorGraph) -> list[gtsam.JacobianFactor]:
    out = []
    for i in range(linear.size()):
        factor = linear.at(i)
        assert isinstance(factor, gtsam.JacobianFactor)
        out.append(factor)
    return out
