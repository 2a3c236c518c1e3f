"""Trajectories in the formats that others read: ROS 2 bags, TUM, KITTI, CSV, Parquet."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

from magfusion.errors import InputError
from magfusion.files.atomic import whole_file
from magfusion.files.odometry_bag import Frames, write_bag
from magfusion.files.result_states import ResultStates, states_of, write_csv, write_kitti
from magfusion.files.trajectory_table import write_trajectory
from magfusion.files.tum import write_tum
from magfusion.model.trajectory import Trajectory

Format = Literal["mcap", "db3", "tum", "kitti", "csv"]
FORMATS: tuple[Format, ...] = get_args(Format)
BAGS: tuple[Format, ...] = ("mcap", "db3")
PARQUET = ".parquet"  # of a trajectory with all that it holds


def format_of(path: Path) -> Format | None:
    """Return the format that the name of a file ends with; None where it is no known one."""
    return next((one for one in FORMATS if path.suffix.lower() == f".{one}"), None)


def refuse_place(path: Path) -> None:
    """Refuse a path at which no file can be written."""
    if path.is_dir():
        raise InputError(f"{path}: is a directory; give the path of a file to write")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path.parent}: there is no such directory; make it first")


def write_states(
    states: ResultStates,
    path: Path,
    form: Format,
    frames: Frames | None = None,
    report: Callable[[int], None] | None = None,
) -> None:
    """Write states, stamped with the log's clock, as one whole file or none.

    `frames`: of a bag. `report`: called with the number of states written, of a bag.
    """
    with whole_file(path) as unfinished:
        if form == "csv":
            write_csv(states, unfinished)
        elif form == "kitti":
            write_kitti(states, unfinished)
        elif form == "tum":
            write_tum(states.trajectory, unfinished, int(states.stamp_ns[0]))
        else:
            write_bag(states, unfinished, form, frames or Frames(), report or (lambda _: None))


def save_trajectory(trajectory: Trajectory, path: Path, epoch_ns: int) -> None:
    """Write a trajectory as its file's name ends: .parquet, or one of `FORMATS`.

    `epoch_ns`: zero of the clock of its times. Raises InputError where the name ends otherwise,
    nothing can be written there or there is no pose.
    """
    form = format_of(path)
    if form is None and path.suffix.lower() != PARQUET:
        known = ", ".join((PARQUET, *(f".{one}" for one in FORMATS)))
        raise InputError(f"{path}: the format is unknown; end the name with one of {known}")
    refuse_place(path)
    if len(trajectory) == 0:
        raise InputError(f"{path}: the trajectory has no pose to write")
    if form is None:
        write_trajectory(trajectory, path, epoch_ns)
    else:
        write_states(states_of(trajectory, epoch_ns), path, form)
