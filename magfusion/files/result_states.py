"""The states of a result with the verdict on each, for exports."""

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from magfusion.errors import InputError
from magfusion.files.table import Span, TableLayout, read_table
from magfusion.files.trajectory_table import read_trajectory, trajectory_columns
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Verdict
from magfusion.units import IntArray

VERDICT = "verdict"


@dataclass(frozen=True, eq=False)
class ResultStates:
    """States that have a pose."""

    stamp_ns: IntArray  # (n,), as the file has them: the log's epoch is within
    trajectory: Trajectory  # the same states, in seconds since the first
    columns: pa.Table  # all that the file holds of them
    left_out: int  # states of the file whose verdict is failed: their poses are none


def read_result_states(path: Path) -> ResultStates:
    """Read a table of states, Parquet or CSV, and leave out those that failed."""
    stamps = read_table(path, TableLayout(numbers=()), Span(0)).time_ns
    trajectory = read_trajectory(path, int(stamps[0]))
    columns = pa.csv.read_csv(path) if path.suffix == ".csv" else pa.parquet.read_table(path)
    kept = np.ones(len(stamps), dtype=bool)
    if VERDICT in columns.column_names:
        failed = str(Verdict.FAILED)
        kept = np.array([declared != failed for declared in columns[VERDICT].to_pylist()])
    if not kept.any():
        raise InputError(
            f"{path}: its {len(stamps)} states have all failed, so that none has a pose; its"
            " report.json has the reasons"
        )
    parts = {f.name: getattr(trajectory, f.name) for f in fields(trajectory)}
    own = {name: part[kept] for name, part in parts.items() if part is not None}
    return ResultStates(
        stamps[kept], replace(trajectory, **own), columns.filter(kept), int(np.sum(~kept))
    )


def states_of(trajectory: Trajectory, epoch_ns: int) -> ResultStates:
    """Return the states of a trajectory, as a file of it has them."""
    stamps = Span(epoch_ns).stamps(trajectory.time)
    columns = pa.table(trajectory_columns(trajectory, epoch_ns))
    shifted = replace(trajectory, time=Span(int(stamps[0])).seconds(stamps))
    return ResultStates(stamps, shifted, columns, left_out=0)


def write_csv(states: ResultStates, path: Path) -> None:
    """Write all columns as text; lists of names (``excluded``) are joined by spaces."""
    columns = {
        name: [" ".join(one or ()) for one in column.to_pylist()]
        if pa.types.is_list(column.type)
        else column
        for name, column in zip(
            states.columns.column_names, states.columns.itercolumns(), strict=True
        )
    }
    pa.csv.write_csv(pa.table(columns), path)


def write_kitti(states: ResultStates, path: Path) -> None:
    """Write poses as the KITTI odometry benchmark does: 3 rows of 4, one line a pose, no times."""
    result = states.trajectory
    matrices = np.concatenate([result.world_from_body, result.position_world[:, :, None]], axis=2)
    np.savetxt(path, matrices.reshape(-1, 12), fmt="%.9f")
