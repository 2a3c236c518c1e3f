"""The job that compares a trajectory with a truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from magfusion.errors import InputError
from magfusion.files.bag_topics import is_bag
from magfusion.files.open import open_log
from magfusion.jobs.settings import Command, TopicSettings, argument
from magfusion.results.figures import Figure, Figures, Section

if TYPE_CHECKING:
    from magfusion.model.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings(TopicSettings):
    """Trajectories to compare, for `magfusion.jobs.inputs.read_estimate`, or a log with truth."""

    estimate: Path = argument("Result directory, TUM file or table")
    truth: Path = argument("Log with truth, TUM file or table")


def run_evaluate(settings: EvaluateSettings) -> Figures:
    """Compare a trajectory with a truth.

    Raises
    ------
    InputError
        Where one of the two cannot be read, or they do not overlap in time.
    """
    from magfusion.jobs.inputs import named, read_estimate
    from magfusion.results.errors import trajectory_errors
    from magfusion.results.report import error_figures

    true, epoch_ns, remarks = _read_truth(settings)
    result = read_estimate(settings.estimate, epoch_ns)
    with named(f"{settings.estimate} against {settings.truth}"):
        errors = error_figures(trajectory_errors(result, true))
    notes = Figures(*[Figure("notes", remarks, section=Section.NOTES)] * bool(remarks))
    return Figures(Figure("job", "evaluate", section=Section.TITLE)) | errors | notes


def _read_truth(settings: EvaluateSettings) -> tuple[Trajectory, int, list[str]]:
    """Return the truth, the zero of its clock (ns), and what contradicts it in its log."""
    from magfusion.estimation.data_checks.truth import truth_findings
    from magfusion.jobs.inputs import read_estimate, topics_option

    path, topics = settings.truth, topics_option(settings.topics)
    is_result = (path / "trajectory.parquet").is_file()
    if is_result or not (path.is_dir() or is_bag(path)):
        return read_estimate(path), 0, []
    log = open_log(path, topics=topics)
    if log.truth is None:
        raise InputError(f"{path}: has no truth; give a log with truth, a TUM file or a table")
    return log.truth, log.epoch_ns, [finding.text for finding in truth_findings(log)]


COMMAND = Command(EvaluateSettings, run_evaluate, example="magfusion evaluate run log")
