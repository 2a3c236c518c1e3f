"""Schur complement of fixed parameters after elimination of all states and the calibration.

In segments of the log: the rows of all of it, with hundreds of columns, would be gigabytes.
"""

import numpy as np

from magfusion.estimation.graph.factors import Factors
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.state import states_in
from magfusion.estimation.posterior.block_tridiagonal_system import (
    ChainNormalEquations,
    EpochRows,
    add_prior,
    field_piece,
)
from magfusion.estimation.posterior.native_rows import Columns, NativeRows
from magfusion.estimation.solve.chain import inverses
from magfusion.units import Array

STRETCH = 128  # states that are eliminated at once


def left_over(graph: Graph, estimate: GraphEstimate, columns: Columns, native: NativeRows) -> Array:
    """Return the normal equations of fixed parameters after elimination of all estimates.

    For a log with one calibration, whose prior is in the graph. Returns (1 + columns, 1 + columns):
    products of the projected residual and columns, the latter with the sign of a right side: the
    descent gradient of the columns is minus their products with the residual.
    """
    count, propagated = 1 + columns.number, None
    states, whole = (
        states_in(estimate.values),
        ChainNormalEquations.zeros(0, _size(graph), columns.number),
    )
    add_prior(whole, graph, estimate)
    size = len(whole.corner)
    gram = np.zeros((count + size, count + size))  # of right sides, then of the border
    gram[:count, count:], gram[count:, count:] = whole.right_border.T, whole.corner
    for begin in range(0, graph.epochs, STRETCH):
        end = min(begin + STRETCH, graph.epochs)
        normal = ChainNormalEquations.zeros(
            min(end + 1, graph.epochs) - begin, size, columns.number
        )
        if propagated is not None:
            normal.diagonal[0], normal.sides[0] = propagated
        for epoch, own, after, border, right in native.of(columns, begin, end):
            normal.add(epoch - begin, own, after, border, right)
            _count(gram[:count, :count], right)
        for factors in graph.factors:
            every = factors.measurement.epoch
            inside = (every >= begin) & (every < end)
            if not np.any(inside):
                continue
            part = Factors(factors.measurement.rows(inside), graph.blocks)
            own_piece = field_piece(
                part, states, estimate.calibration, columns.blocks, columns.spread
            )
            _add(normal, gram[:count, :count], own_piece, begin)
        gram[:count, count:] += normal.right_border.T
        gram[count:, count:] += normal.corner
        propagated = _eliminated(normal, gram, end - begin)
    if size:
        across = gram[:count, count:]
        return np.asarray(
            gram[:count, :count] - across @ np.linalg.solve(gram[count:, count:], across.T)
        )
    return gram


def _size(graph: Graph) -> int:
    return sum(len(block.sigma) for block in graph.blocks)


def _add(normal: ChainNormalEquations, gram: Array, piece: EpochRows, begin: int) -> None:
    piece._replace(epoch=piece.epoch - begin).added_to(normal)
    for channel in range(piece.right.shape[1]):  # most columns affect one beacon
        _count(gram, piece.right[:, channel])


def _count(gram: Array, right: Array) -> None:
    """Add the products of right sides, shape (m, rows, columns), those that are not zero."""
    flat = right.reshape(-1, right.shape[-1])
    affected = np.flatnonzero(np.any(flat, axis=0))
    own = flat[:, affected]
    gram[np.ix_(affected, affected)] += own.T @ own


def _eliminated(normal: ChainNormalEquations, gram: Array, number: int) -> tuple[Array, Array]:
    """Eliminate the first states from all products; return the Schur complement of the next.

    It consists of its information, and its right sides and border.
    """
    of_each = inverses(normal.diagonal[None, :number], normal.following[None])[0]
    sides = normal.sides
    for i in range(min(number, len(normal.following))):
        gain = of_each[i] @ normal.following[i]
        sides[i + 1] -= gain.T @ sides[i]
    rooted = np.swapaxes(np.linalg.cholesky(of_each), 1, 2) @ sides[:number]
    flat = rooted.reshape(-1, rooted.shape[-1])
    gram -= flat.T @ flat
    if number == len(sides):
        return normal.diagonal[-1], sides[-1]
    last = normal.following[number - 1]
    return normal.diagonal[number] - last.T @ of_each[number - 1] @ last, sides[number]
