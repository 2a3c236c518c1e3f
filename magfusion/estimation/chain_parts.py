"""What the rows of some channels add to normal equations, found once for all variants that have it.

Most of what is considered is felt by one beacon alone, so that all parts together are hardly larger
than their sum.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.chain_system import FieldRows, Normal
from magfusion.units import BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class Part:
    """What the rows of some channels add.

    Parameters
    ----------
    channels : bool ndarray, shape (channels,)
    sums : Normal
        With those right sides alone that they have any of.
    columns : int ndarray
        Which these are.
    """

    channels: BoolArray
    sums: Normal
    columns: IntArray

    def added_to(self, normal: Normal) -> None:
        """Add them to equations that have all right sides."""
        own = self.sums
        normal.diagonal += own.diagonal
        normal.border[...] += own.border
        normal.corner += own.corner
        normal.right_border[:, self.columns] += own.right_border
        begin = 0
        for run in np.split(self.columns, np.flatnonzero(np.diff(self.columns) > 1) + 1):
            end = begin + len(run)
            normal.right[..., run[0] : run[-1] + 1] += own.right[..., begin:end]
            begin = end


def parts_of(rows: FieldRows, kept: BoolArray, like: Normal) -> list[Part]:
    """Return the parts of a log's rows, of which each variant has all or nothing.

    Parameters
    ----------
    kept : bool ndarray, shape (variants, channels)
        Channels that a variant has.
    like : Normal
        Equations to which they will be added.
    """
    patterns = np.unique(kept[:, np.any(kept, axis=0)], axis=1).T
    groups = [np.all(pattern == kept.T, axis=1) for pattern in patterns]
    felt = np.zeros((len(groups), like.right.shape[-1]), dtype=bool)
    felt[:, 0] = True
    for piece in rows.pieces():
        for own, channels in zip(felt, groups, strict=True):
            own |= np.any(piece.right[:, channels] != 0.0, axis=(0, 1, 2))
    states, calibration = len(like.diagonal), len(like.corner)
    columns = [np.flatnonzero(own) for own in felt]
    sums = [Normal(states, calibration, len(own) - 1) for own in columns]
    for piece in rows.pieces():
        for normal, channels, own in zip(sums, groups, columns, strict=True):
            piece._replace(right=piece.right[..., own]).added_to(normal, channels)
    return [Part(*one) for one in zip(groups, sums, columns, strict=True)]
