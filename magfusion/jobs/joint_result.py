"""The result of several logs of one site: the refined site, and their table."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magfusion.estimation.posterior.noise_tuning import Tuned, with_noise
from magfusion.files.row_table import write_rows
from magfusion.files.site import save_site
from magfusion.jobs.inputs import Job
from magfusion.jobs.joint_run import Joint, refine, tasks_of
from magfusion.jobs.joint_tasks import together_settings
from magfusion.jobs.result_directory import claim, keep_results
from magfusion.jobs.written import LOGS, LOGS_TABLE
from magfusion.model.parameters import Calibration
from magfusion.model.progress import Report
from magfusion.results.figures import (
    Figure,
    Figures,
    ParameterEstimate,
    Section,
    determined_figures,
    heading,
)
from magfusion.results.observability import observability
from magfusion.results.plots.log_calibration import write_log_calibration_plot
from magfusion.results.refinement import parameter_estimates, refined_site
from magfusion.results.report import observability_figures, write_report
from magfusion.results.verdict import trust_figures
from magfusion.units import Array, Rate

if TYPE_CHECKING:
    from magfusion.estimation.batch.batch import SmootherSettings
    from magfusion.jobs.settings import LogsSettings
    from magfusion.model.trust import Risk


def run_joint(
    command: str,
    settings: LogsSettings,
    smoother: SmootherSettings,
    output: Path,
    report: Report,
    *,
    rate: Rate = "field",
    risk: Risk | None = None,
) -> Figures:
    """Refine one site with several logs together.

    Parameters
    ----------
    command : {'smooth', 'calibrate log'}
        The former writes the trajectory of each log too.

    Raises
    ------
    InputError
        Where a log or the site cannot be used, or the cluster not be reached.
    EstimationError
        Where no log can be used.
    """
    writes = command == "smooth"
    claimed = claim(output, *(("smooth", "fix") if writes else (command,)))
    jobs: list[Job] = settings.jobs(output)
    tasks = tasks_of(jobs, together_settings(smoother), output)
    began = time.perf_counter()
    joint = refine(
        tasks,
        cluster=settings.cluster,
        workers=settings.workers,
        writes=writes,
        rate=rate,
        risk=risk,
        report=report,
    )
    cov, name = joint.excess * joint.known.honest, ", ".join(task.name for task in tasks)
    calibration = _calibration(joint)
    blocks = joint.shared.blocks
    estimates = parameter_estimates(joint.shared.declared, calibration, blocks, cov)
    figures = heading(command, name) | _figures(joint, calibration, cov, estimates, writes=writes)
    figures |= Figures(Figure("elapsed_s", time.perf_counter() - began, "s"))
    result = observability(calibration, blocks, cov)
    with claimed as whole:
        keep_results(whole, [(t.name, t.kept, t.job.output) for t in tasks])
        save_site(refined_site(calibration, blocks, cov, estimates, name), whole / "site.yaml")
        write_rows(whole / LOGS_TABLE, joint.table)
        if not writes:
            ratios = result.ratio_but_for_gauge, result.direction_ratio
            write_log_calibration_plot(whole / "calibration.png", estimates, *ratios)
        write_report(whole, figures)
    return figures


def _calibration(joint: Joint) -> Calibration:
    """Return the joint calibration, with the noise estimated from the logs (geometric mean)."""
    result: dict[tuple[str, str], list[Tuned]] = {}
    for tuned in joint.noise:
        result.setdefault((tuned.owner, tuned.key), []).append(tuned)
    noise = [
        replace(every[0], estimated=float(np.exp(np.mean(np.log([t.estimated for t in every])))))
        for every in result.values()
    ]
    return with_noise(joint.shared.moved(joint.known.step), noise)


def _figures(
    joint: Joint,
    calibration: Calibration,
    cov: Array,
    estimates: list[ParameterEstimate],
    *,
    writes: bool,
) -> Figures:
    section = Section.REPORT if writes else Section.DIRECTIONS
    result = observability(calibration, joint.shared.blocks, cov)
    return (
        trust_figures(joint.trust)
        | Figures(
            Figure(LOGS, joint.table, section=Section.LOGS),
            Figure("logs_used", sum(row["used"] == "yes" for row in joint.table)),
            Figure("rounds", joint.rounds),
        )
        | observability_figures(estimates, result, section)
        | Figures(*estimates)
        | determined_figures(estimates)
    )
