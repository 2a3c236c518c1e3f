"""The result of several logs of one site: the refined site, and their table."""

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.estimation.posterior.noise_tuning import Tuned, with_noise
from magfusion.files.row_table import write_rows
from magfusion.files.site import save_site
from magfusion.jobs.inputs import Job
from magfusion.jobs.joint_run import Joint, refine, tasks_of
from magfusion.jobs.joint_tasks import together_settings
from magfusion.jobs.result_directory import claim, keep_results
from magfusion.jobs.settings import LogsSettings
from magfusion.jobs.steel_of_logs import SteelOfLogs, map_steel_of_logs
from magfusion.jobs.written import CALENDAR_TABLE, KEPT, LOGS, LOGS_TABLE, PLATFORMS
from magfusion.model.parameters import Block, Calibration
from magfusion.model.progress import Report
from magfusion.model.site import Site
from magfusion.model.trust import Risk
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


def run_joint(
    command: str,
    settings: LogsSettings,
    smoother: SmootherSettings,
    output: Path,
    report: Report,
    *,
    rate: Rate = "field",
    risk: Risk | None = None,
    by_date: bool = False,
    mapping: bool = False,
) -> Figures:
    """Refine one site with several logs together.

    `command`: the former writes the trajectory of each log too. `by_date`: whether changes between
    the logs are searched. `mapping`: whether the steel near the paths is mapped first.
    """
    writes = command == "smooth"
    claimed = claim(output, *(("smooth", "fix") if writes else (command,)))
    jobs: list[Job] = settings.jobs(output)
    tasks = tasks_of(jobs, together_settings(smoother), output)
    began = time.perf_counter()
    steel = SteelOfLogs(jobs)
    if mapping:
        steel = map_steel_of_logs(jobs, smoother, output, report)
        tasks = tasks_of(steel.jobs, together_settings(smoother), output)
    joint = refine(
        tasks,
        cluster=settings.cluster,
        workers=settings.workers,
        writes=writes,
        rate=rate,
        risk=risk,
        by_date=by_date,
        report=report,
    )
    name = ", ".join(task.name for task in tasks)
    calibration, cov = _calibration(joint, 0)
    declared, blocks = joint.calendar.platforms[0].shared.declared, _blocks(joint)
    estimates = parameter_estimates(declared, calibration, blocks, cov)
    joint = replace(joint, trust=joint.trust | steel.trust)
    figures = heading(command, name) | _figures(joint, calibration, cov, estimates, writes=writes)
    figures |= steel.figures
    figures |= Figures(Figure("elapsed_s", time.perf_counter() - began, "s"))
    result = observability(calibration, blocks, cov)
    with claimed as whole:
        keep_results(whole, [(t.name, t.kept, t.job.output) for t in tasks])
        save_site(refined_site(calibration, blocks, cov, estimates, name), whole / "site.yaml")
        for i in range(1, len(joint.calendar.platforms)):
            (whole / PLATFORMS).mkdir(exist_ok=True)
            save_site(_other_site(joint, i, name), whole / PLATFORMS / f"{i + 1}.yaml")
        write_rows(whole / LOGS_TABLE, joint.table)
        steel.write(whole)
        steel.keep(whole / KEPT, output)
        if joint.months:
            write_rows(whole / CALENDAR_TABLE, joint.months)
        if not writes:
            ratios = result.ratio_but_for_gauge, result.direction_ratio
            write_log_calibration_plot(whole / "calibration.png", estimates, *ratios)
        write_report(whole, figures)
    return figures


def _blocks(joint: Joint, platform: int = 0) -> tuple[Block, ...]:
    return joint.calendar.platforms[platform].shared.blocks


def _calibration(joint: Joint, platform: int) -> tuple[Calibration, Array]:
    """Return the joint calibration with one platform after all changes, and its covariance.

    The noise is that estimated from the logs of the platform (geometric mean).
    """
    result: dict[tuple[str, str], list[Tuned]] = {}
    for tuned in joint.noise[platform]:
        result.setdefault((tuned.owner, tuned.key), []).append(tuned)
    noise = [
        replace(every[0], estimated=float(np.exp(np.mean(np.log([t.estimated for t in every])))))
        for every in result.values()
    ]
    known = joint.known.of(*joint.calendar.columns(joint.calendar.on(platform, math.inf)))
    shared = joint.calendar.platforms[platform].shared
    return with_noise(shared.moved(known.step), noise), joint.excess * known.honest


def _other_site(joint: Joint, platform: int, name: str) -> Site:
    calibration, cov = _calibration(joint, platform)
    declared = joint.calendar.platforms[platform].shared.declared
    blocks = _blocks(joint, platform)
    estimates = parameter_estimates(declared, calibration, blocks, cov)
    return refined_site(calibration, blocks, cov, estimates, name)


def _figures(
    joint: Joint,
    calibration: Calibration,
    cov: Array,
    estimates: list[ParameterEstimate],
    *,
    writes: bool,
) -> Figures:
    section = Section.REPORT if writes else Section.DIRECTIONS
    result = observability(calibration, _blocks(joint), cov)
    return (
        trust_figures(joint.trust)
        | Figures(
            Figure(LOGS, joint.table, section=Section.LOGS),
            Figure("logs_used", sum(row["used"] == "yes" for row in joint.table)),
            Figure("rounds", joint.rounds),
            Figure("changes", [one.row for one in joint.changes], section=Section.REPORT),
        )
        | observability_figures(estimates, result, section)
        | Figures(*estimates)
        | determined_figures(estimates)
    )
