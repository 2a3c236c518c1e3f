"""A smoothed log for a program or a notebook: a result with its own display."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.batch import batch
from magfusion.estimation.batch.batch import Smoothed, SmootherSettings
from magfusion.estimation.graph.gtsam_graph import GtsamGraph, NativeProblem
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.solve.bordered import optimise
from magfusion.files.blas_threads import warn_about_threads
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.without_imu import logged
from magfusion.results.figures import Figures, heading
from magfusion.results.page import head_in_notebook
from magfusion.results.report import smoothed_figures
from magfusion.results.trajectory import ResultTrajectory, result_trajectory
from magfusion.results.verdict import trust_figures
from magfusion.units import Array

NOT_JUDGED = "No verdict yet: call mf.judge_result(result, log) for the verdict."


@dataclass(frozen=True, eq=False, repr=False)
class SmoothedLog(Smoothed):
    """The posterior of one log, with the trajectory as a table, a file or a figure.

    The fields are those of `magfusion.estimation.batch.batch.Smoothed`: ``states`` and their
    covariance, ``calibration`` with ``calibration_cov``, ``residual``, and the inputs.  A notebook
    shows the head of the page of a result.
    """

    @property
    def trajectory(self) -> ResultTrajectory:
        """The states, with the data needed to save and plot them."""
        return result_trajectory(self.states, self.epoch_ns, self.calibration.site)

    def to_gtsam(self, *, polish: bool = False) -> GtsamGraph:
        """Return the graph of the last pass with its estimate, as GTSAM has it.

        It has no considered parameters, which are uncertain without being estimated: marginals of
        the graph are smaller than ``states.pose_cov``, which contains their effect.

        Parameters
        ----------
        polish : bool
            With the values at the minimum to rounding; a pass ends a little before it.
        """
        estimate = self.estimate
        if polish:
            estimate = optimise(self.graph, estimate, tolerance=0.0).estimate
        native = NativeProblem(self.graph, estimate)
        return GtsamGraph(native.graph, native.values, self.states.time, self.blocks)

    def _repr_html_(self) -> str:
        figures = heading("smooth", self.log_name)
        figures |= Figures() if self.trust is None else trust_figures(self.trust)
        return head_in_notebook(figures | smoothed_figures(self), NOT_JUDGED)


def smooth(
    log: Log,
    site: Site,
    settings: SmootherSettings | None = None,
    report: Report = quiet,
    *,
    factors: gtsam.NonlinearFactorGraph | None = None,
    values: gtsam.Values | None = None,
    times: Array | Sequence[float] = (),
) -> SmoothedLog:
    """Smooth a log: trajectory and calibration in one solution.

    Parameters
    ----------
    log : Log
        With a waveform, or with phasors in the site's channel order.
    site : Site
        Its sigmas are the priors of the calibration.
    settings : SmootherSettings, optional
        The defaults if not given.
    report : callable, optional
        Called with stage, finished steps and number of steps.
    factors : gtsam.NonlinearFactorGraph, optional
        More factors, on X(j), V(j) and B(j) of the j-th of ``times``, and on keys of their own.
    values : gtsam.Values, optional
        Initial values of their own keys.
    times : sequence of float, optional
        At which states are made for the factors (s), ascending, within the log.

    Returns
    -------
    SmoothedLog
        ``trajectory`` with n poses and their covariance, ``calibration`` with ``calibration_cov``.
        Not yet judged: see `judge_result`.

    Raises
    ------
    TypeError
        Where the arguments are not a log and a site, in this order.
    InputError
        Where the log has no usable data.
    EstimationError
        Where the graph cannot be solved.
    """
    warn_about_threads()
    if factors is not None:
        user = UserFactors.of(factors, values, np.asarray(times, dtype=float))
        begin, end = logged(log, site)[0].imu.time[[0, -1]]
        outside = user.time[(user.time < begin) | (user.time > end)]
        if len(outside):
            raise InputError(
                f"a factor is at {outside[0]:g} s, outside the log ({begin:g} to {end:g} s)"
            )
        settings = replace(settings or SmootherSettings(), factors=user)
    return SmoothedLog(**vars(batch.smooth(log, site, settings, report)))
