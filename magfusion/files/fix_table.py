"""Hypotheses of single-epoch fixes as a table, several rows a time, best first."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magfusion.files.table import TIME, Span, write_table
from magfusion.files.trajectory_table import trust_columns
from magfusion.model.trust import StateTrust
from magfusion.units import Array, BoolArray


def write_hypotheses(
    path: Path,
    epoch_ns: int,
    time: Array,
    world_from_body: Array,
    position_world: Array,
    cost: Array,
    probability: Array,
    determined: BoolArray,
    relation: NDArray[np.str_],
    trust: StateTrust | None = None,
    *,
    columns: Mapping[str, Array] | None = None,
) -> None:
    """Write the hypotheses of every epoch as Parquet.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    world_from_body : ndarray, shape (n, hypotheses, 3, 3)
    position_world : ndarray, shape (n, hypotheses, 3)
        (m)
    cost, probability : ndarray, shape (n, hypotheses)
        Chi square, infinite where there is no such hypothesis; share of the posterior.
    determined : bool ndarray, shape (n, hypotheses)
        False where a direction of the pose is open.
    relation : ndarray of str, shape (n, hypotheses)
        How each follows from the best, e.g. ``mirror A``.
    trust : StateTrust, optional
        Of each epoch, as in `magfusion.files.trajectory_table.write_trajectory`.
    columns : mapping of str to ndarray, shape (n, hypotheses), optional
        Further columns of each.
    """
    more = {} if columns is None else columns
    epoch, rank = np.nonzero(np.isfinite(cost))
    rotation = Rotation.from_matrix(world_from_body[epoch, rank])
    table: dict[str, object] = {TIME: Span(epoch_ns).stamps(time[epoch]), "hypothesis": rank}
    table |= dict(
        zip(("position_x", "position_y", "position_z"), position_world[epoch, rank].T, strict=True)
    )
    table |= dict(zip(("qw", "qx", "qy", "qz"), rotation.as_quat(scalar_first=True).T, strict=True))
    table |= {
        "chi_square": cost[epoch, rank],
        "probability": probability[epoch, rank],
        "determined": determined[epoch, rank],
        "relation": relation[epoch, rank],
    }
    table |= {name: values[epoch, rank] for name, values in more.items()}
    if trust is not None:
        table |= trust_columns(trust, epoch)
    write_table(table, path)
