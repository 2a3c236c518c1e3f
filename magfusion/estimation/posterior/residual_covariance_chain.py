"""Residuals of errors after the estimate of a log of one chain of states, in one sweep.

Equivalent to `magfusion.estimation.posterior.residual_redundancy` with GTSAM's elimination, which
serves any graph.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.inertial import ROWS
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior.block_tridiagonal_system import (
    ChainNormalEquations,
    EpochRows,
    FieldRows,
    add_prior,
    affected_blocks,
)
from magfusion.estimation.posterior.native_rows import Columns, NativeRows
from magfusion.estimation.solve.chain import solve_chain
from magfusion.model.parameters import Block, dimension
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.units import Array, IntArray

LARGER = 1e-6  # relative increase of a sum of squares that is rounding


class _Rows(NamedTuple):
    """Rows of two states, shape (m, rows, ...)."""

    inertial: bool
    epoch: IntArray
    own: Array
    after: Array | None
    border: Array
    right: Array


def left_by_chain(
    graph: Graph,
    estimate: GraphEstimate,
    considered: tuple[Block, ...],
    fields: Sequence[Array],
    inertial: Sequence[Array],
) -> tuple[Array, Array] | None:
    """Return the residuals, then the remainders of other errors; None if dominated by rounding.

    `considered`: parameters that are estimated here with a prior of their own.
    `fields` (n, channels, 6) each: errors of the phasors, whitened and weighted.
    `inertial` (intervals, 15) each: the corresponding errors of the inertial factors, whitened.
    Returns (1 + errors, n, channels, 6); (1 + errors, intervals, 15).
    """
    columns = _fixed_columns(graph, considered)
    normal = _with_priors(graph, estimate, columns.number, len(fields))
    kept, pieces = [], []
    for rows in _inertial_rows(graph, estimate, columns, inertial):
        normal.add(rows.epoch, rows.own, rows.after, rows.border, rows.right)
        if rows.inertial:
            kept.append(rows)
    for piece, of_phasors in _field_rows(graph, estimate, columns, fields):
        piece.added_to(normal)
        if of_phasors:
            pieces.append(piece)
    result = solve_chain(normal.chain(), MOTION, covariance=False)
    states, calibration = result.states[0], result.border[0]
    if not (np.all(np.isfinite(states)) and np.all(np.isfinite(calibration))):
        return None
    of_motion = np.zeros((graph.epochs - 1, ROWS, 1 + len(fields)))
    for rows in kept:
        assert rows.after is not None
        moved = rows.own @ states[rows.epoch] + rows.after @ states[rows.epoch + 1]
        of_motion[rows.epoch] = moved + rows.border @ calibration - rows.right
    of_fields = np.concatenate([_left_of(piece, states, calibration) for piece in pieces])
    if not _explains(of_fields, of_motion, fields, inertial):
        return None
    return np.moveaxis(of_fields, -1, 0), np.moveaxis(of_motion, -1, 0)


def _explains(
    of_fields: Array, of_motion: Array, fields: Sequence[Array], inertial: Sequence[Array]
) -> bool:
    """Return whether no drawn error has become larger, as least squares require."""
    residual = np.sum(of_fields[..., 1:] ** 2, axis=(0, 1, 2)) + np.sum(
        of_motion[..., 1:] ** 2, (0, 1)
    )
    given = [np.sum(one**2) + np.sum(two**2) for one, two in zip(fields, inertial, strict=True)]
    return bool(np.all(residual <= (1.0 + LARGER) * np.array(given)))


def _fixed_columns(graph: Graph, considered: tuple[Block, ...]) -> Columns:
    if not considered:
        return Columns((), np.zeros((0, 0)))
    assert graph.declared is not None
    spread = prior_sqrt_covariance(graph.declared.site, considered)
    by_inertial = graph.by_considered(spread)
    if by_inertial is None or not np.any(by_inertial):  # they act on the fields only
        return Columns(considered, spread)
    return Columns(considered, spread, by_inertial.__getitem__)


def _with_priors(
    graph: Graph, estimate: GraphEstimate, considered: int, errors: int
) -> ChainNormalEquations:
    """Return the equations with the priors of the calibration and of considered parameters."""
    size = dimension(graph.blocks)
    normal, prior = (
        ChainNormalEquations.zeros(graph.epochs, size + considered, errors),
        ChainNormalEquations.zeros(0, size, 0),
    )
    add_prior(prior, graph, estimate)
    normal.corner[:size, :size] = prior.corner
    normal.right_border[:size, :1] = prior.right_border
    normal.corner[size:, size:] = np.eye(considered)
    return normal


def _inertial_rows(
    graph: Graph, estimate: GraphEstimate, columns: Columns, errors: Sequence[Array]
) -> Iterator[_Rows]:
    """Yield the rows of inertial factors with errors, and of priors of the motion."""
    drawn = np.stack([*errors], axis=-1) if errors else np.zeros((graph.epochs - 1, ROWS, 0))
    for inertial, rows in NativeRows(graph, estimate).kinds_of(columns):
        epoch, own, after, border, right = rows
        whole = _with_considered(border, right, columns.number)
        right = right[..., :1]
        if inertial:
            right = np.concatenate([right, drawn[epoch]], axis=-1)
        yield _Rows(inertial, epoch, own, after, whole, right)


def _field_rows(
    graph: Graph, estimate: GraphEstimate, columns: Columns, errors: Sequence[Array]
) -> Iterator[tuple[EpochRows, bool]]:
    """Yield the rows of measurements, and whether they are of the phasors, with errors."""
    for factors in graph.factors:
        of_phasors, begin = isinstance(factors.measurement, FieldPhasors), 0
        for piece in FieldRows(factors, estimate, *affected_blocks(columns)).pieces():
            border = _with_considered(piece.by_calibration, piece.right, columns.number)
            own, end = piece.right[..., :1], begin + len(piece.epoch)
            if of_phasors:
                own = np.stack([own[..., 0], *(each[begin:end] for each in errors)], axis=-1)
            yield EpochRows(piece.epoch, piece.by_state, border, own), of_phasors
            begin = end


def _with_considered(border: Array, right: Array, count: int) -> Array:
    """Return the columns of the calibration, then those of considered parameters, negated."""
    if not count:
        return border
    out = np.zeros((*border.shape[:-1], border.shape[-1] + count))
    out[..., : border.shape[-1]] = border
    if right.shape[-1] > 1:
        out[..., border.shape[-1] :] = -right[..., 1:]
    return out


def _left_of(piece: EpochRows, states: Array, calibration: Array) -> Array:
    """Return the remainders of the rows of a piece, shape (m, channels, 6, errors)."""
    moved = piece.by_state @ states[piece.epoch][:, None]
    return np.asarray(moved + piece.by_calibration @ calibration - piece.right)
