"""Rows of inertial factors and of motion priors as arrays, with columns of other parameters."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam
import numpy as np

from magfusion.estimation.graph.factors import PIECE
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.state import MOTION
from magfusion.model.parameters import Block, difference, dimension
from magfusion.units import Array, IntArray

_FIRST, _WIDTH = {"x": 0, "v": 6, "b": 9}, {"x": 6, "v": 3, "b": 6}  # in a state's tangent vector


NativePiece = tuple[IntArray, Array, Array | None, Array, Array]


class Columns(NamedTuple):
    """Columns of parameters that are not estimated."""

    blocks: tuple[Block, ...]
    spread: Array  # (dimension, columns), maps each column to a step of the parameters
    # returns for some intervals (int ndarray) the columns of the whitened error of their inertial
    # factors, shape (m, 15, columns)
    inertial: Callable[[IntArray], Array] | None = None

    @property
    def number(self) -> int:
        """Number of columns."""
        return self.spread.shape[1] if self.blocks else 0


@dataclass(eq=False)
class _Kind:
    """Factors of the same variables, by the first state of each."""

    names: tuple[tuple[str, int], ...]
    inertial: bool
    epoch: IntArray
    jacobian: Array  # (m, rows, columns of the variables)
    right: Array  # (m, rows)


@dataclass(eq=False)
class NativeRows:
    """The rows at an estimate, linearised once for any columns."""

    graph: Graph
    estimate: GraphEstimate
    kinds: list[_Kind] = field(init=False)

    def __post_init__(self) -> None:
        linear = self.graph.native.linearize(self.estimate.values)
        result: dict[tuple[tuple[tuple[str, int], ...], bool], list[tuple[int, Array, Array]]]
        result, links = defaultdict(list), linear.size() - (self.graph.epochs - 1)
        for i in range(linear.size()):
            factor = linear.at(i)
            assert isinstance(factor, gtsam.JacobianFactor)
            symbols = [gtsam.Symbol(key) for key in list(factor.keys())]
            names = [(chr(symbol.chr()), symbol.index()) for symbol in symbols]
            first = min(index for _, index in names)
            kind = tuple((name, index - first) for name, index in names), i >= links
            result[kind].append((first, factor.getA(), factor.getb()))
        self.kinds = [
            _Kind(
                *kind,
                np.array([first for first, _, _ in every]),
                np.array([by for _, by, _ in every]),
                np.array([b for _, _, b in every]),
            )
            for kind, every in result.items()
        ]

    def of(self, columns: Columns, begin: int = 0, end: int | None = None) -> Iterator[NativePiece]:
        """Yield the rows of factors by their first states, in the form of `Normal.add`.

        Those without a nonzero column have only the first of the right sides. `begin`, `end`: of
        the states; all by default.
        """
        for _, rows in self.kinds_of(columns, begin, end):
            yield rows

    def kinds_of(
        self, columns: Columns, begin: int = 0, end: int | None = None
    ) -> Iterator[tuple[bool, NativePiece]]:
        """Yield the same rows, with whether they are of inertial factors."""
        for kind in self.kinds:
            inside = kind.epoch >= begin
            inside &= kind.epoch < (self.graph.epochs if end is None else end)
            every = np.flatnonzero(inside)
            for first in range(0, len(every), PIECE):
                for rows in self._of(kind, every[first : first + PIECE], columns):
                    yield kind.inertial, rows

    def _of(self, kind: _Kind, some: IntArray, columns: Columns) -> Iterator[NativePiece]:
        jacobian, epoch = kind.jacobian[some], kind.epoch[some]
        rows = jacobian.shape[:2]
        own, after = np.zeros((*rows, MOTION)), np.zeros((*rows, MOTION))
        border = np.zeros((*rows, dimension(self.graph.blocks)))
        extra_columns = kind.inertial and columns.inertial is not None
        right = np.zeros((*rows, 1 + (columns.number if extra_columns else 0)))
        right[..., 0], column = kind.right[some], 0
        for name, later in kind.names:
            target, width = own if later == 0 else after, _WIDTH[name]
            part = jacobian[..., column : column + width]
            target[..., _FIRST[name] : _FIRST[name] + width] = part
            column += width
        if kind.inertial and self.graph.links and border.shape[2]:
            border[...], moved = self._by_blocks(epoch)
            right[..., 0] -= (border @ moved[..., None])[..., 0]
        if kind.inertial and columns.inertial is not None:
            right[..., 1:] = -columns.inertial(epoch)
        linked = any(later for _, later in kind.names)
        for once in each_once(epoch):
            ahead = after[once] if linked else None
            yield epoch[once], own[once], ahead, border[once], right[once]

    def _by_blocks(self, epoch: IntArray) -> tuple[Array, Array]:
        """Return estimated parameters' columns of inertial factors, and their present steps."""
        blocks, by, moved = self.graph.blocks, [], []
        for link in (self.graph.links[k] for k in epoch.tolist()):
            assert link.by_calibration is not None
            by.append(link.by_calibration[:, : dimension(blocks)])
            moved.append(difference(link.calibration, self.estimate.calibration, blocks))
        return np.array(by), np.array(moved)


def each_once(epoch: IntArray) -> Iterator[IntArray]:
    """Yield rows in groups without repeated states."""
    residual = np.arange(len(epoch))
    while len(residual):
        _, first = np.unique(epoch[residual], return_index=True)
        yield residual[first]
        residual = np.delete(residual, first)
