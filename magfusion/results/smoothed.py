"""A smoothed log for a program or a notebook: a result with its own display."""

from dataclasses import dataclass

from magfusion.estimation.batch import batch
from magfusion.estimation.batch.batch import Smoothed, SmootherSettings
from magfusion.files.blas_threads import warn_about_threads
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.results.figures import Figures, heading
from magfusion.results.page import head_in_notebook
from magfusion.results.report import smoothed_figures
from magfusion.results.trajectory import ResultTrajectory, result_trajectory
from magfusion.results.verdict import trust_figures

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

    def _repr_html_(self) -> str:
        figures = heading("smooth", self.log_name)
        figures |= Figures() if self.trust is None else trust_figures(self.trust)
        return head_in_notebook(figures | smoothed_figures(self), NOT_JUDGED)


def smooth(
    log: Log, site: Site, settings: SmootherSettings | None = None, report: Report = quiet
) -> SmoothedLog:
    """Smooth a log: trajectory and calibration in one solution.

    Parameters
    ----------
    log : Log
        With a waveform, or with phasors in the site's channel order.
    site : Site
    settings : SmootherSettings, optional
    report : callable, optional
        Called with stage, finished steps and number of steps.

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
    return SmoothedLog(**vars(batch.smooth(log, site, settings, report)))
