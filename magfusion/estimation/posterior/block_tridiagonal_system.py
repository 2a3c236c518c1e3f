"""The linear system of a solved graph as normal equations of a chain of states with a border.

GTSAM's elimination serves any graph; here all states of a log are one chain, so that one sweep
(`solve.chain`) gives the covariance of every state and other results for all of them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.graph.factors import Factors
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.state import MOTION, States, states_in
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior.native_rows import Columns, NativeRows, each_once
from magfusion.estimation.solve.chain import Chain
from magfusion.model.parameters import Block, Calibration, difference, dimension, placed
from magfusion.model.prior import prior_sqrt_covariance, prior_sqrt_information
from magfusion.units import Array, BoolArray, IntArray

SIDES = 6e7  # bytes of right sides at once; considered parameters are processed in groups


@dataclass(eq=False)
class ChainNormalEquations:
    """Normal equations of a chain, accumulated by rows.

    The right sides are the step, then the response to one sigma of each considered parameter.
    """

    diagonal: Array  # (states, 15, 15)
    following: Array  # (states - 1, 15, 15), between each state and the next
    sides: Array  # (states, 15, 1 + considered + calibration), right sides, then the border
    corner: Array  # (calibration, calibration)
    right_border: Array  # (calibration, 1 + considered)

    @classmethod
    def zeros(cls, states: int, calibration: int, considered: int) -> "ChainNormalEquations":
        """Return empty equations."""
        return cls(
            np.zeros((states, MOTION, MOTION)),
            np.zeros((max(states - 1, 0), MOTION, MOTION)),
            np.zeros((states, MOTION, 1 + considered + calibration)),
            np.zeros((calibration, calibration)),
            np.zeros((calibration, 1 + considered)),
        )

    @property
    def right(self) -> Array:
        """Right sides, shape (states, 15, 1 + considered)."""
        return self.sides[..., : self.right_border.shape[1]]

    @property
    def border(self) -> Array:
        """By the calibration, shape (states, 15, calibration)."""
        return self.sides[..., self.right_border.shape[1] :]

    def chain(self) -> Chain:
        """Return the equations as a chain of one variant: solving it overwrites them."""
        return Chain.of_sides(**{name: value[None] for name, value in vars(self).items()})

    @staticmethod
    def blank(
        count: int, states: int, calibration: int, right: int, following: Array
    ) -> tuple[Chain, list["ChainNormalEquations"]]:
        """Return empty variants as one chain, and each of them for accumulation.

        `right`: number of right sides. `following` (states - 1, 15, 15): common to all.
        """
        built = {
            "diagonal": np.zeros((count, states, MOTION, MOTION)),
            "sides": np.zeros((count, states, MOTION, right + calibration)),
            "corner": np.zeros((count, calibration, calibration)),
            "right_border": np.zeros((count, calibration, right)),
        }
        own = [
            ChainNormalEquations(
                following=following, **{name: value[k] for name, value in built.items()}
            )
            for k in range(count)
        ]
        return Chain.of_sides(following=following[None], **built), own

    def add(
        self, epoch: IntArray, own: Array, after: Array | None, border: Array, right: Array
    ) -> None:
        """Add rows of some states, each at most once.

        `epoch` (m,). `own`, `after` (m, rows, 15): by the state, and by the next.
        `border` (m, rows, calibration). `right` (m, rows, k): the first k of 1 + considered; the
        others are zero.
        """
        back, affected = np.swapaxes(own, 1, 2), right.shape[-1]
        self.diagonal[epoch] += back @ own
        self.border[epoch] += back @ border
        self.right[epoch, :, :affected] += back @ right
        self.corner += np.einsum("mrc,mrd->cd", border, border, optimize=True)
        self.right_border[:, :affected] += np.einsum("mrc,mrd->cd", border, right, optimize=True)
        if after is not None:
            ahead = np.swapaxes(after, 1, 2)
            self.diagonal[epoch + 1] += ahead @ after
            self.following[epoch] += back @ after
            self.border[epoch + 1] += ahead @ border
            self.right[epoch + 1, :, :affected] += ahead @ right


class EpochRows(NamedTuple):
    """Rows of some epochs, shape (m, groups, components, k), with their latest weights."""

    epoch: IntArray
    by_state: Array
    by_calibration: Array
    right: Array

    def added_to(self, normal: ChainNormalEquations, kept: BoolArray | slice = slice(None)) -> None:
        """Add the rows of some channels, shape (channels,)."""
        flat = []
        for part in (self.by_state, self.by_calibration, self.right):
            own = part[:, kept]
            flat.append(own.reshape(len(own), own.shape[1] * own.shape[2], own.shape[3]))
        # A measurement may have several rows of one state.
        for once in each_once(self.epoch):
            normal.add(self.epoch[once], flat[0][once], None, flat[1][once], flat[2][once])


@dataclass(frozen=True, eq=False)
class FieldRows:
    """The rows of a measurement in pieces, since those of a log of hours take much memory."""

    factors: Factors
    estimate: GraphEstimate
    considered: tuple[Block, ...]  # parameters of the columns
    spread: Array  # (dimension, columns), maps unit noise to a step of the parameters

    def pieces(self) -> Iterator[EpochRows]:
        """Yield all rows."""
        states, calibration = states_in(self.estimate.values), self.estimate.calibration
        for factors in self.factors.pieces():
            yield field_piece(factors, states, calibration, self.considered, self.spread)


def field_piece(
    factors: Factors,
    states: States,
    calibration: Calibration,
    considered: tuple[Block, ...],
    spread: Array,
) -> EpochRows:
    """Return the rows of some epochs of a measurement."""
    size, every = dimension(factors.blocks), placed((*factors.blocks, *considered))
    result = factors.rows(states, calibration, every)
    right = np.zeros((*result.error.shape, 1 + spread.shape[1]))
    right[..., 0] = -result.error
    by_every = result.by_calibration
    if by_every is not None and considered:
        _spread_over(by_every[..., size:], -spread, right[..., 1:])
        result = replace(result, by_calibration=by_every[..., :size])
    jacobian = result.jacobian(size)
    by_state, by_calibration = jacobian[..., :MOTION], jacobian[..., MOTION:]
    return EpochRows(factors.measurement.epoch, by_state, by_calibration, right)


def _spread_over(by_other: Array, spread: Array, out: Array) -> None:
    """Write the product of parameters' columns and a spread; most spreads are diagonal."""
    if not spread.size or np.any(np.count_nonzero(spread, axis=0) > 1):
        np.matmul(by_other, spread, out=out)
        return
    at = np.argmax(np.abs(spread), axis=0)
    first, scale = int(at[0]), spread[at, np.arange(len(at))]
    together = np.array_equal(at, np.arange(first, first + len(at)))
    own = by_other[..., first : first + len(at)] if together else by_other[..., at]
    np.multiply(own, scale, out=out)


def column_groups(considered: tuple[Block, ...], epochs: int) -> list[slice]:
    """Return groups of considered columns whose right sides fit memory."""
    maximum, out = int(SIDES / (8.0 * MOTION * epochs)), [slice(0, 0)]
    for block in considered:
        first, end = out[-1].start, block.columns.stop
        if end - first > maximum and out[-1].stop > first:
            out.append(slice(out[-1].stop, end))
        else:
            out[-1] = slice(first, end)
    return out


def block_tridiagonal_system(
    graph: Graph,
    estimate: GraphEstimate,
    considered: tuple[Block, ...],
    columns: slice = slice(None),
) -> tuple[ChainNormalEquations, FieldRows | None]:
    """Return the normal equations of all but the fields, and the rows of the fields.

    For a log with one calibration, whose prior is in the graph. `columns`: of the considered
    parameters, for the right sides.
    """
    assert graph.declared is not None
    spread, by_inertial = np.zeros((0, 0)), None
    if considered:
        spread = prior_sqrt_covariance(graph.declared.site, considered)[:, columns]
        by_others = graph.by_considered(spread)
        if by_others is not None and np.any(by_others):  # else they act on the fields only
            by_inertial = by_others.__getitem__
    extra_columns = Columns(considered, spread, by_inertial)
    return system_with_columns(graph, estimate, extra_columns, NativeRows(graph, estimate), columns)


def system_with_columns(
    graph: Graph,
    estimate: GraphEstimate,
    extra_columns: Columns,
    native: NativeRows,
    columns: slice = slice(None),
) -> tuple[ChainNormalEquations, FieldRows | None]:
    """Return the same, with columns of any parameters as right sides.

    `columns`: of errors in the calibration's prior from other logs.
    """
    size = dimension(graph.blocks)
    normal = ChainNormalEquations.zeros(graph.epochs, size, extra_columns.number)
    add_prior(normal, graph, estimate)
    if size and graph.shift is not None:
        assert graph.declared is not None
        whitening = prior_sqrt_information(graph.declared.site, graph.blocks)
        by = graph.shift.by_considered[:, columns]
        normal.right_border[:, 1 : 1 + by.shape[1]] += whitening.T @ (whitening @ by)
    for own in native.of(extra_columns):
        normal.add(*own)
    fields: FieldRows | None = None
    for factors in graph.factors:
        rows = FieldRows(factors, estimate, *affected_blocks(extra_columns))
        if isinstance(factors.measurement, FieldPhasors):
            fields = rows
            continue
        for piece in rows.pieces():
            piece.added_to(normal)
    return normal, fields


def add_prior(normal: ChainNormalEquations, graph: Graph, estimate: GraphEstimate) -> None:
    """Add the prior of the calibration."""
    if not graph.blocks:
        return
    assert graph.declared is not None
    whitening = prior_sqrt_information(graph.declared.site, graph.blocks)
    step = difference(graph.declared, estimate.calibration, graph.blocks)
    normal.corner += whitening.T @ whitening
    normal.right_border[:, 0] -= whitening.T @ (whitening @ step)


def affected_blocks(columns: Columns) -> tuple[tuple[Block, ...], Array]:
    """Return the parameters with a nonzero column, and the map from columns to their steps."""
    affected = [block for block in columns.blocks if np.any(columns.spread[block.columns])]
    if not affected:
        return (), columns.spread[:0]
    return placed(affected), np.concatenate([columns.spread[block.columns] for block in affected])
