"""The job that refines a site by a log: what it determined, what it could not, what is missing."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.evaluation.errors import trajectory_errors
from magfusion.evaluation.motion_coverage import MotionCoverage, missing_motion, motion_coverage
from magfusion.evaluation.observability import observability
from magfusion.evaluation.transfer import Estimated, agreement
from magfusion.fusion.batch import Smoothed, SmootherSettings, smooth
from magfusion.fusion.self_survey import smooth_and_place
from magfusion.job import Job, claim, named, read_job
from magfusion.plots.log_calibration import write_log_calibration_plot
from magfusion.records.samples import Log
from magfusion.refinement import Finding, findings, refined_site
from magfusion.report import (
    Figures,
    compared_with_truth,
    placement_figures,
    smoothed_figures,
    write_report,
)
from magfusion.site import Site
from magfusion.site_file import save_site

JOB = "calibrate log"
HELD = ("phase", "time-offset")  # what every log has of its own
SHORTEST_PART = 15.0  # s
MOST_PARTS = 6
Report = Callable[[str, int, int], None]


class Score(NamedTuple):
    """How well a part of a log is explained with the calibration held.

    Parameters
    ----------
    residual : float
        Root mean square, whitened.
    position, attitude_deg : float, optional
        Aligned errors against the truth, where there is one (m, deg).
    """

    residual: float
    position: float | None
    attitude_deg: float | None


class Transfer(NamedTuple):
    """What the calibrations of some parts of a log are worth on its other parts.

    Parameters
    ----------
    declared : list of Score
        Of each part, with the survey held.
    calibrated : list of Score
        Of each pair of parts: calibrated on the one, scored on the other.
    pairs : list of (int, int)
    disagreement : float
        Largest difference of two parts' calibrations along a direction that both determined, in
        its sigmas.
    """

    declared: list[Score]
    calibrated: list[Score]
    pairs: list[tuple[int, int]]
    disagreement: float


def run_calibrate_log(
    job: Job,
    settings: SmootherSettings,
    *,
    parts: int | None = None,
    report: Report,
) -> Figures:
    """Calibrate a site by a log of ordinary motion.

    Parameters
    ----------
    job : Job
    settings : SmootherSettings
    parts : int, optional
        Cross-validate: calibrate on each of so many parts of the log and score on the others.
    report : callable
        Told stage, steps done and steps in all.

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError
        Where the log or the site cannot be used, or nothing is to be calibrated.
    EstimationError
        Where the smoother fails or does not converge.
    """
    claimed = claim(job.output, JOB)
    log, site = read_job(job, unknown=True)
    cuts = _cuts(job, log, site, parts)
    settings = replace(settings, lockin=job.lockin)
    with named(job.log_path):
        result, placed = smooth_and_place(log, site, settings, report)
    if not result.blocks:
        raise InputError(
            f"{job.site_path or job.log_path}: the site's sigmas are zero or negligible, so there"
            " is nothing to calibrate; declare how well the survey is known"
        )
    if not result.converged:
        raise EstimationError(
            f"{job.log_path}: the smoother did not converge, so its calibration is not to be"
            " trusted; add motion or a beacon, or check the survey"
        )
    told = findings(result.declared, result.calibration, result.blocks, result.calibration_cov)
    found = observability(result.calibration, result.blocks, result.calibration_cov)
    covered = motion_coverage(result.states, result.calibration, log.imu)
    figures: Figures = {"job": JOB, "log": log.name}
    figures |= smoothed_figures(result)
    figures |= compared_with_truth(result.states, log)[1]
    figures |= placement_figures(placed, result.calibration.site)
    figures |= _coverage_figures(covered)
    figures["missing_motion"] = missing_motion(covered, result.calibration, result.blocks, found)
    if cuts is not None:
        figures |= _transfer_figures(_transfer(job, site, settings, cuts, report))
    refined = _refined(result, told, log)
    with claimed as directory:
        save_site(refined, directory / "site.yaml")
        write_log_calibration_plot(
            directory / "calibration.png", told, found.ratio_but_for_gauge, found.direction_ratio
        )
        write_report(directory, figures)
    return figures


def _refined(result: Smoothed, told: list[Finding], log: Log) -> Site:
    return refined_site(result.calibration, result.blocks, result.calibration_cov, told, log.name)


def _coverage_figures(covered: MotionCoverage) -> Figures:
    figures: Figures = {f"nearest_m_{name}": least for name, least in covered.nearest.items()}
    for axis, extent, turned in zip("xyz", covered.extent_world, covered.turned_deg, strict=True):
        figures[f"motion_extent_{axis}_m"] = float(extent)
        figures[f"motion_turned_{axis}_deg"] = float(turned)
    figures["motion_at_rest"] = covered.rest_share
    return figures


def _cuts(job: Job, log: Log, site: Site, parts: int | None) -> list[float | None] | None:
    """Return the bounds of the parts, the outer ones those of the job."""
    if parts is None:
        return None
    if not 2 <= parts <= MOST_PARTS:
        raise InputError(f"--cross-validate must lie between 2 and {MOST_PARTS}; got {parts}")
    if any(beacon.unknown is not None for beacon in site.beacons):
        raise InputError(
            "--cross-validate compares with the survey, and a beacon has none; place it first"
        )
    first, last = float(log.imu.time[0]), float(log.imu.time[-1])
    if last - first < parts * SHORTEST_PART:
        raise InputError(
            f"{job.log_path}: {last - first:.3g} s make no {parts} parts of at least"
            f" {SHORTEST_PART:g} s; record longer, or use fewer parts"
        )
    inner = np.linspace(first, last, parts + 1)[1:-1]
    return [job.start, *(float(cut) for cut in inner), job.end]


def _transfer(
    job: Job, site: Site, settings: SmootherSettings, cuts: list[float | None], report: Report
) -> Transfer:
    count = len(cuts) - 1
    logs = [read_job(replace(job, start=cuts[i], end=cuts[i + 1]))[0] for i in range(count)]
    results = []
    for i, log in enumerate(logs):
        report(f"calibrating on part {i + 1}", i, count)
        results.append(smooth(log, site, settings))
    sites = [
        _refined(r, findings(r.declared, r.calibration, r.blocks, r.calibration_cov), log)
        for r, log in zip(results, logs, strict=True)
    ]
    pairs = [(i, j) for i in range(count) for j in range(count) if i != j]
    declared = [_score(log, site, settings) for log in logs]
    calibrated = []
    for done, (i, j) in enumerate(pairs):
        report(f"calibration of part {i + 1} on part {j + 1}", done, len(pairs))
        calibrated.append(_score(logs[j], sites[i], settings))
    estimated = [Estimated(r.declared, r.calibration, r.blocks, r.calibration_cov) for r in results]
    apart = [
        float(np.max(np.abs(agreement(estimated[i], estimated[j]).by_direction), initial=0.0))
        for i, j in pairs
        if i < j
    ]
    return Transfer(declared, calibrated, pairs, max(apart))


def _score(log: Log, site: Site, settings: SmootherSettings) -> Score:
    held = smooth(log, site, replace(settings, estimate=HELD))
    residual = float(np.sqrt(np.nanmean(held.residual**2)))
    if log.truth is None:
        return Score(residual, None, None)
    errors = trajectory_errors(held.states, log.truth)
    return Score(residual, errors.aligned_ate, errors.aligned_attitude_rmse_deg)


def _transfer_figures(transfer: Transfer) -> Figures:
    figures: Figures = {"cross_parts": len(transfer.declared)}
    units = {"residual": "residual_rms", "position": "aligned_ate_m"}
    units |= {"attitude_deg": "aligned_attitude_rmse_deg"}
    for name, key in units.items():
        for label, scores in (
            ("declared", transfer.declared),
            ("calibrated", transfer.calibrated),
        ):
            values = [getattr(score, name) for score in scores]
            if None not in values:
                figures[f"cross_{label}_{key}"] = float(np.sqrt(np.mean(np.square(values))))
    for (i, j), score in zip(transfer.pairs, transfer.calibrated, strict=True):
        before = transfer.declared[j]
        for name, key in units.items():
            if getattr(score, name) is not None:
                stem = f"cross_part_{i + 1}_on_{j + 1}"
                figures[f"{stem}_{key}"] = getattr(score, name)
                figures[f"cross_part_{j + 1}_declared_{key}"] = getattr(before, name)
    figures["cross_disagreement_sigma"] = transfer.disagreement
    return figures
