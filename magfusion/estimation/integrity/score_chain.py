"""Score of a log that is a single chain of states: one sweep, in groups of columns."""

from typing import NamedTuple

import numpy as np

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.integrity.fixed_parameter_columns import InertialColumns
from magfusion.estimation.posterior.block_tridiagonal_system import (
    column_groups,
    system_with_columns,
)
from magfusion.estimation.posterior.native_rows import Columns, NativeRows
from magfusion.estimation.posterior.schur_complement import left_over
from magfusion.estimation.posterior.separation import POSE
from magfusion.estimation.solve.chain import solve_chain
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.model.parameters import Block, dimension, placed, prior_sigma
from magfusion.units import Array


class Responses(NamedTuple):
    """Effect of a unit of each fixed parameter."""

    by_state: Array  # (states, 15 or 6, h), on pose, velocity and biases; or on the pose only
    by_calibration: Array  # (dimension, h), on the estimated calibration


class FixedParameterResidual(NamedTuple):
    """Marginal of the fixed parameters, as of `magfusion.estimation.integrity.score.Score`."""

    information: Array  # (h, h)
    gradient: Array  # (h,)


def left_of_chain(
    result: Smoothed, fixed: tuple[Block, ...], inertial: InertialColumns, native: NativeRows
) -> FixedParameterResidual | None:
    """Return the marginal; None if the chain is too badly conditioned for one sweep."""
    graph, size = result.graph, dimension(fixed)
    # A field error that is constant in place resembles some of them; their effect on the
    # estimate, which ignores such errors, is unchanged.
    every = placed((*fixed, *result.field_errors))
    wide = inertial._replace(number=dimension(every))
    others = Columns(every, np.diag(prior_sigma(every)), wide.of)
    try:
        residual = left_over(graph, result.estimate, others, native)
        errors = residual[1 + size :, 1 + size :] + np.eye(dimension(every) - size)
        across = residual[: 1 + size, 1 + size :]
        residual = residual[: 1 + size, : 1 + size] - across @ np.linalg.solve(errors, across.T)
    except np.linalg.LinAlgError:
        return None
    information = 0.5 * (residual[1:, 1:] + residual[1:, 1:].T)
    return (
        FixedParameterResidual(information, -residual[1:, 0])
        if np.all(np.isfinite(residual))
        else None
    )


def responses_of_chain(
    result: Smoothed,
    fixed: tuple[Block, ...],
    inertial: InertialColumns,
    native: NativeRows,
    known: Responses | None = None,
) -> Responses | None:
    """Return the effect of a unit of each; None if rounding dominates.

    `known`: of the first fixed ones; then only poses are computed for the others.
    """
    graph = result.graph
    kept = MOTION if known is None else POSE
    by_state = [np.zeros((graph.epochs, kept, 0))]
    by_calibration = [np.zeros((dimension(graph.blocks), 0))]
    if known is not None:
        by_state.append(known.by_state[:, :kept])
        by_calibration.append(known.by_calibration)
    inverse = None
    new = tuple(
        b for b in fixed if b.columns.start >= sum(part.shape[1] for part in by_calibration)
    )
    for columns in _groups(new, graph.epochs):
        part = inertial.part(columns)
        own = Columns(fixed, np.diag(prior_sigma(fixed))[:, columns], part.of)
        normal, fields = system_with_columns(graph, result.estimate, own, native)
        if fields is not None:
            for piece in fields.pieces():
                piece.added_to(normal)
        estimate = solve_chain(normal.chain(), kept, inverse, covariance=False)
        inverse = estimate.inverse
        by_state.append(estimate.states[0, ..., 1:].copy())
        by_calibration.append(estimate.border[0, :, 1:])
        del normal, fields, estimate  # before the next group: for a long log they are large
        give_back_memory()
    responses = Responses(np.concatenate(by_state, axis=2), np.concatenate(by_calibration, axis=1))
    return responses if all(np.all(np.isfinite(part)) for part in responses) else None


def _groups(fixed: tuple[Block, ...], epochs: int) -> list[slice]:
    """Return groups of the fixed parameters' columns whose right-hand sides fit in memory."""
    if not fixed:
        return []
    first = fixed[0].columns.start
    groups = column_groups(placed(fixed), epochs)
    return [slice(first + group.start, first + group.stop) for group in groups]
