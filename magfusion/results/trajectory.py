"""A trajectory that a program can convert to a table, a file or a figure."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from magfusion.errors import InputError
from magfusion.estimation.graph.state import State, as_trajectory
from magfusion.files.trajectory_formats import save_trajectory
from magfusion.files.trajectory_table import trajectory_columns
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors
from magfusion.results.page_motion import MotionPage, path_charts, size_charts
from magfusion.results.plots.drawn import draw_charts


@dataclass(frozen=True, eq=False, repr=False)
class ResultTrajectory(Trajectory):
    """A trajectory on the clock of a log, among the beacons of a site.

    Besides the parts of `Trajectory`: ``time`` (n,) (s), ``position`` (n, 3) (m, world axes),
    ``rotation`` (SciPy's `Rotation`, world from body), ``euler`` (n, 3) (roll, pitch, yaw; rad) and
    ``cov`` (n, 6, 6) (rotation, then position; body axes; rad^2, rad m, m^2).

    Parameters
    ----------
    epoch_ns : int
        Zero of the clock: nanoseconds since 1970 where the log has a date.
    site : Site
        With the calibration of the result.
    """

    epoch_ns: int = field(kw_only=True)
    site: Site = field(kw_only=True)

    def to_pandas(self) -> Any:
        """Return a table with the columns of ``trajectory.parquet``, a row for each pose.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        ImportError
            Where pandas is not installed.
        """
        table = pa.table(trajectory_columns(self, self.epoch_ns))
        try:
            return table.to_pandas()
        except ImportError as error:
            text = "to_pandas requires pandas; install it with: pip install pandas"
            raise ImportError(text) from error

    def save(self, path: Path | str) -> None:
        """Write the poses in the format of the file's extension.

        ``.parquet`` has every part, as ``trajectory.parquet`` of a result; ``.csv`` the same
        columns as text; ``.tum`` and ``.kitti`` poses alone; ``.mcap`` and ``.db3`` are ROS 2 bags
        of odometry.  Stamps are on the log's clock.

        Parameters
        ----------
        path : Path or str
            Replaced as a whole, or unchanged on failure.

        Raises
        ------
        InputError
            Where the extension is unknown, or the file cannot be written.
        """
        save_trajectory(self, Path(path), self.epoch_ns)

    def plot(self, truth: Trajectory | None = None) -> NDArray[np.object_]:
        """Draw plan, height, and the size of sigmas, as on the page of a result.

        Parameters
        ----------
        truth : Trajectory, optional
            Drawn as well, with the errors.

        Returns
        -------
        ndarray of matplotlib.axes.Axes, shape (2,) or (4,)
            Of a new figure of `matplotlib.pyplot`, which ``plt.show()`` shows.

        Raises
        ------
        InputError
            Where there is no pose, or fewer than three of them have a truth.
        """
        if len(self) == 0:
            raise InputError("the trajectory has no pose to plot")
        errors = None if truth is None else trajectory_errors(self, truth)
        motion = MotionPage(self.site, self, truth, errors)
        return draw_charts([*path_charts(motion), *size_charts(motion)])


def result_trajectory(states: Trajectory, epoch_ns: int, site: Site) -> ResultTrajectory:
    """Return a trajectory with its clock and site."""
    return ResultTrajectory(**vars(states), epoch_ns=epoch_ns, site=site)


def collect_states(states: Sequence[State], epoch_ns: int = 0) -> ResultTrajectory:
    """Return the states of a `Navigator` as one trajectory.

    Parameters
    ----------
    states : sequence of State
        In the order of their times, at least one; those of a lost navigator are guesses.
    epoch_ns : int
        Zero of the clock of their times, as the log's (ns).

    Returns
    -------
    ResultTrajectory
        With velocities, biases and ``pose_cov`` of all n states, and the site of the last one.

    Raises
    ------
    InputError
        Where there is no state.
    ValueError
        Where the times do not increase.
    """
    if not states:
        raise InputError("there is no state to collect: the navigator gave none yet")
    return result_trajectory(as_trajectory(list(states)), epoch_ns, states[-1].calibration.site)
