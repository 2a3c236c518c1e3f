"""Inertial residuals: inconsistency of rates and forces with the magnetic-field solution.

At the optimum the states have absorbed most of an inertial factor's error; the expected residual
follows from their covariance, computed for a sample of the intervals.  An error of the field model
that is constant in place turns the states slowly, and leaves more than that: as much as drawn ones.
"""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.batch.log_graph import overlap
from magfusion.estimation.graph.graph import GraphEstimate
from magfusion.estimation.graph.inertial import ROWS
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior.residual_redundancy import ResidualProjection
from magfusion.estimation.solve.bordered import eliminate
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

SAMPLED = 24  # intervals whose covariance is computed: most are similar
DRAWS = 4  # of errors: one that is constant in place has few independent parts
WIDTHS = {"x": 6, "v": 3, "b": 6}


def inertial_errors(result: Smoothed, estimate: GraphEstimate) -> Array:
    """Return the whitened error of every inertial factor at an estimate, shape (intervals, 15)."""
    native, count = result.graph.native, result.graph.epochs - 1
    first, values = native.size() - count, estimate.values
    out = np.zeros((count, ROWS))
    for k in range(count):
        factor = native.at(first + k)
        assert isinstance(factor, gtsam.NoiseModelFactor)
        out[k] = factor.whitenedError(values)
    return out


def expected_squares(result: Smoothed) -> Array:
    """Return the expected mean square residual of each row, shape (15,)."""
    graph, estimate = result.graph, result.estimate
    count = graph.epochs - 1
    linear = graph.native.linearize(estimate.values)
    tree = eliminate(graph.linearized(estimate), graph.ordering)
    first = linear.size() - count
    chosen = np.unique(np.linspace(0, count - 1, min(SAMPLED, count)).astype(int))
    residual = np.zeros((len(chosen), ROWS))
    for row, k in enumerate(chosen.tolist()):
        factor = linear.at(first + k)
        assert isinstance(factor, gtsam.JacobianFactor)
        keys = [X(k), V(k), B(k), X(k + 1), V(k + 1), B(k + 1)]
        joint = tree.jointMarginalCovariance(keys).fullMatrix()
        columns, start = {}, 0
        for key in keys:
            width = WIDTHS[chr(gtsam.Symbol(key).chr())]
            columns[key], start = slice(start, start + width), start + width
        matrix, begin = np.zeros((ROWS, start)), 0
        for key in factor.keys():  # noqa: SIM118
            width = WIDTHS[chr(gtsam.Symbol(key).chr())]
            matrix[:, columns[key]] = factor.getA()[:, begin : begin + width]
            begin += width
        residual[row] = 1.0 - np.einsum("ij,jk,ik->i", matrix, joint, matrix)
    return np.maximum(np.median(residual, axis=0), _drawn_squares(result))


def _drawn_squares(result: Smoothed) -> Array:
    """Return the mean square of each row that drawn noise and model errors leave, shape (15,)."""
    if not any(isinstance(m, FieldPhasors) for m in result.graph.measurements):
        return np.zeros(ROWS)
    rows = {k: v[result.epoch] for k, v in vars(result.states).items() if v is not None}
    known = result.graph, result.estimate, result.fields, Trajectory(**rows)
    parts = *known, overlap(result.fields), result.considered
    noise, rough, smooth, own = ResidualProjection(*parts, draws=DRAWS).inertial_squares
    return np.asarray(noise + np.maximum(rough, smooth) + own)
