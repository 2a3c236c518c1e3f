"""Contributions of channels to normal equations, computed once for all variants that have them.

Most considered parameters affect one beacon alone, so that all parts together are hardly larger
than their sum.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from magfusion.estimation.posterior.block_tridiagonal_system import (
    ChainNormalEquations,
    EpochRows,
    FieldRows,
)
from magfusion.estimation.solve.chain import Chain
from magfusion.model.parameters import BeaconParameter
from magfusion.units import Array, BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class ChannelContribution:
    """Contribution of the rows of some channels."""

    channels: BoolArray  # (channels,), all False for the part of every variant
    sums: ChainNormalEquations  # with only the nonzero right sides
    columns: IntArray  # their indices

    def added_to(self, normal: ChainNormalEquations) -> None:
        """Add the part to equations with all right sides, except the diagonal."""
        own = self.sums
        normal.border[...] += own.border
        normal.corner += own.corner
        normal.right_border[:, self.columns] += own.right_border
        begin = 0
        for run in np.split(self.columns, np.flatnonzero(np.diff(self.columns) > 1) + 1):
            end = begin + len(run)
            normal.right[..., run[0] : run[-1] + 1] += own.right[..., begin:end]
            begin = end


@dataclass(frozen=True, eq=False)
class Parts:
    """The normal equations of a chain in parts."""

    parts: tuple[ChannelContribution, ...]
    following: Array  # as of `ChainNormalEquations`
    count: int  # number of right sides

    def of(self, channels: BoolArray) -> Iterator[ChannelContribution]:
        """Yield the parts of a variant that has some of the channels."""
        return (part for part in self.parts if np.all(channels[part.channels]))

    def diagonals(self, some: BoolArray) -> Array:
        """Return the diagonal of some variants, shape (h, states, 15, 15)."""
        result = np.zeros((len(some), *self.parts[0].sums.diagonal.shape))
        for own, channels in zip(result, some, strict=True):
            for part in self.of(channels):
                own += part.sums.diagonal
        return result

    def discard_diagonals(self) -> None:
        """Release the memory of the diagonals after their use."""
        for part in self.parts:
            part.sums.diagonal = part.sums.diagonal[:0].copy()

    def chain(self, some: BoolArray) -> Chain:
        """Return some variants, shape (h, channels), with diagonals of zeros.

        Solving the chain overwrites them.
        """
        states, size = self.parts[0].sums.border.shape[0], len(self.parts[0].sums.corner)
        chain, variants = ChainNormalEquations.blank(
            len(some), states, size, self.count, self.following
        )
        for normal, channels in zip(variants, some, strict=True):
            for part in self.of(channels):
                part.added_to(normal)
        return chain


def parts_of(
    rest: ChainNormalEquations, rows: FieldRows, pieces: Iterable[EpochRows], kept: BoolArray
) -> Parts:
    """Return a chain in parts, each of which a variant has completely or not at all.

    `rest`: common part of all variants; it is returned without right sides. `rows`: source of the
    pieces. `kept` (variants, channels): channels that a variant has.
    """
    count, states, size = rest.right.shape[-1], len(rest.diagonal), len(rest.corner)
    always = _with_affected_only(rest, kept.shape[1])
    patterns = np.unique(kept[:, np.any(kept, axis=0)], axis=1).T
    groups = [np.all(pattern == kept.T, axis=1) for pattern in patterns]
    columns = [_affected_right_sides(rows, channels) for channels in groups]
    sums = [ChainNormalEquations.zeros(states, size, len(own) - 1) for own in columns]
    for piece in pieces:
        for normal, channels, own in zip(sums, groups, columns, strict=True):
            piece._replace(right=piece.right[..., own]).added_to(normal, channels)
    parts = [ChannelContribution(*one) for one in zip(groups, sums, columns, strict=True)]
    return Parts((always, *parts), rest.following, count)


def _with_affected_only(rest: ChainNormalEquations, channels: int) -> ChannelContribution:
    """Return equations as a part, with only the nonzero right sides."""
    affected = np.any(rest.right, axis=(0, 1)) | np.any(rest.right_border, axis=0)
    affected[0] = True
    columns = np.flatnonzero(affected)
    rest.sides = np.concatenate([rest.right[..., columns], rest.border], axis=2)
    rest.right_border = rest.right_border[:, columns]
    return ChannelContribution(np.zeros(channels, dtype=bool), rest, columns)


def _affected_right_sides(rows: FieldRows, channels: BoolArray) -> IntArray:
    """Return the right sides of some channels: the first, and those that affect them."""
    every = rows.estimate.calibration.site.channels
    names = {every[k][0] for k in np.flatnonzero(channels).tolist()}
    acting = [
        block.columns
        for block in rows.considered
        if not isinstance(block.parameter, BeaconParameter) or block.owner in names
    ]
    spread = [rows.spread[columns] for columns in acting]
    affected = np.any(np.concatenate([rows.spread[:0], *spread]) != 0.0, axis=0)
    return np.concatenate([[0], 1 + np.flatnonzero(affected)])
