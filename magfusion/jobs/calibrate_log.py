"""The job that refines a site with a log: estimated, unobservable and missing parts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.snapshot.priors import contradiction, trust_of, unexplained
from magfusion.files.site import save_site
from magfusion.jobs.failure import reason_of
from magfusion.jobs.settings import Command, EstimateSettings, LogsSettings, WindowSettings, option
from magfusion.model.parameters import difference
from magfusion.model.prior import prior_sqrt_covariance
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.figures import ErrorColumn, Figure, Figures, Section, heading
from magfusion.results.motion_coverage import MotionCoverage, missing_motion, motion_coverage
from magfusion.results.observability import observability
from magfusion.results.transfer import Estimated, agreement
from magfusion.results.verdict import trust_figures

if TYPE_CHECKING:
    from magfusion.estimation.batch.batch import Smoothed, SmootherSettings
    from magfusion.jobs.inputs import Job


JOB = "calibrate log"
OF_LOG = ("phase", "time-offset")  # every log has its own: estimated even so
MIN_PART = 15.0  # s
MAX_PARTS = 6
MAX_DIFFERENCE_SIGMAS = (
    5.0  # sigmas; the largest of tens of directions, by chance once in thousands
)
WORSE = 1.2  # residual on other parts, by that of the declared calibration
OVERLAP = 2.0  # windows that share their samples


class PartScore(NamedTuple):
    """Fit of a part of a log with the calibration fixed.

    `residual`: root mean square, whitened. `position`, `attitude_deg`: aligned errors against the
    truth, where there is one (m, deg).
    """

    residual: float
    position: float | None
    attitude_deg: float | None


class Transfer(NamedTuple):
    """Cross-validation of calibrations between parts of a log.

    Parameters
    ----------
    declared : list of PartScore
        Of each part, with the survey fixed.
    calibrated : list of PartScore
        Of each pair of parts: calibrated on the one, scored on the other.
    disagreement : float
        Largest difference of two parts' calibrations along a direction that both determine, in its
        sigmas.
    """

    declared: list[PartScore]
    calibrated: list[PartScore]
    pairs: list[tuple[int, int]]
    disagreement: float


@dataclass(frozen=True, kw_only=True)
class LogCalibrationSettings(LogsSettings, WindowSettings, EstimateSettings):
    """Settings of the calibration from a log of ordinary motion."""

    cross_validate: int | None = option(
        None, "Calibrate on each of this many parts of the log, score on the others"
    )
    calendar: bool = option(
        False,
        "Search for beacons that were moved or exchanged between the logs, and platforms that"
        " changed; estimate them separately before and after",
    )
    map_steel: bool = option(
        False,
        "Map the steel near the paths first, one log after the other, and calibrate with the maps"
        " that predict beacons left out",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.map_steel and self.cross_validate is not None:
            raise InputError(
                "--map-steel maps the whole log, of which --cross-validate compares parts; omit one"
            )


def run_calibrate_log(
    settings: LogCalibrationSettings, output: Path, report: Report = quiet
) -> Figures:
    """Calibrate a site with a log of ordinary motion, or with several together."""
    from magfusion.estimation.batch.batch import SmootherSettings
    from magfusion.estimation.batch.self_survey import smooth_and_place
    from magfusion.estimation.integrity.judge import judge_result
    from magfusion.jobs.inputs import named, read_job
    from magfusion.jobs.result_directory import claim, result_in
    from magfusion.jobs.steel_of_logs import SteelOfLogs, map_steel_of_logs
    from magfusion.results.plots.log_calibration import write_log_calibration_plot
    from magfusion.results.refinement import parameter_estimates, result_site
    from magfusion.results.report import compared_with_truth, placement_figures, smoothed_figures

    job = settings.job(output)
    smoother = SmootherSettings(estimate=settings.groups, lockin=settings.lockin(job))
    if settings.more:
        from magfusion.jobs.joint_result import run_joint

        if settings.cross_validate is not None:
            raise InputError("--cross-validate splits one log; several were given")
        return run_joint(
            JOB,
            settings,
            smoother,
            output,
            report,
            by_date=settings.calendar,
            mapping=settings.map_steel,
        )
    if settings.calendar:
        raise InputError("--calendar compares several logs; one was given")
    claimed, steel = claim(output, JOB), SteelOfLogs([job])
    if settings.map_steel:
        steel = map_steel_of_logs([job], smoother, output, report)
    (job,) = steel.jobs
    log, site = read_job(job, unknown=True, report=report)
    cuts = _cuts(job, log, site, settings.cross_validate)
    with named(job.log_path), _as_failure(job.log_path):
        result, placed = smooth_and_place(log, site, smoother, report)
    if not result.blocks:
        raise InputError(
            f"{job.site_path or job.log_path}: the site's sigmas are zero or negligible, so that no"
            " parameter can be calibrated; declare the uncertainty of the survey"
        )
    honest, trust = judge_result(result, log)
    result, moved = against_site(honest, grown(result, honest))
    with _as_failure(job.log_path):
        compared = None if cuts is None else _transfer(job, site, smoother, cuts, report)
    trust = _report_once(trust, moved) | steel.trust
    if compared is not None:
        trust |= transferred(compared)
    parts_of = result.calibration, result.blocks, result.calibration_cov
    estimate = observability(*parts_of)
    covered = motion_coverage(result.states, result.calibration, log.imu)
    figures = heading(JOB, log.name) | trust_figures(trust)
    figures |= smoothed_figures(result, Section.DIRECTIONS)
    figures |= compared_with_truth(result.states, log)[1]
    figures |= placement_figures(placed, result.calibration.site)
    figures |= _coverage_figures(covered)
    missing = missing_motion(covered, result.calibration, result.blocks, estimate)
    label = "missing motion"
    figures |= Figures(Figure("missing_motion", missing, section=Section.DIRECTIONS, label=label))
    if compared is not None:
        figures |= _transfer_figures(compared)
    figures |= steel.figures
    estimates = parameter_estimates(result.declared, *parts_of)
    with result_in(claimed, figures, trust, job.log_path, output) as directory:
        save_site(result_site(result, log.name), directory / "site.yaml")
        steel.write(directory)
        write_log_calibration_plot(
            directory / "calibration.png",
            estimates,
            estimate.ratio_but_for_gauge,
            estimate.direction_ratio,
        )
    return figures


@contextmanager
def _as_failure(path: Path) -> Iterator[None]:
    """Raise GTSAM's error of a singular system as a failure to estimate."""
    try:
        yield
    except RuntimeError as error:
        raise EstimationError(f"{path}: {reason_of(error)}") from error


def _report_once(trust: Trust, moved: Trust) -> Trust:
    """Return the union; a finding in both keeps the text of the first."""
    moved = Trust(tuple(f for f in moved.findings if f.code not in _codes(trust, f.verdict)))
    kept = tuple(f for f in trust.findings if f.code not in _codes(moved, f.verdict))
    return Trust(kept, trust.unverified) | moved


def _codes(trust: Trust, verdict: Verdict) -> set[str]:
    """Return the codes of findings with a verdict at least as bad."""
    return {f.code for f in trust.findings if f.verdict.rank >= verdict.rank}


def grown(result: Smoothed, honest: Smoothed) -> float:
    """Return the factor on the covariance of the poses, median over the states."""
    before, after = result.states.pose_cov, honest.states.pose_cov
    if before is None or after is None:
        return 1.0
    variances = (np.diagonal(cov, axis1=1, axis2=2) for cov in (after, before))
    return max(1.0, float(np.median(np.mean(np.divide(*variances), axis=1))))


def against_site(result: Smoothed, least: float = 1.0) -> tuple[Smoothed, Trust]:
    """Return a result with calibration sigmas consistent with its fit, and the findings.

    `least`: minimum factor on the covariance of the calibration.
    """
    from magfusion.results.refinement import parameter_estimates

    parts = result.calibration, result.blocks, result.calibration_cov
    spread = prior_sqrt_covariance(result.declared.site, result.blocks)
    prior, known = spread @ spread.T, np.isfinite(result.residual)
    fitted = unexplained(
        "the fields of the beacons",
        float(np.sum(result.residual[known] ** 2)) / OVERLAP,
        float(np.sum(known)) / OVERLAP,
        "Check the survey of the beacons, iron near them, and the declared noise.",
    )
    moved = contradiction(
        [estimate.key for estimate in parameter_estimates(result.declared, *parts)],
        difference(result.declared, result.calibration, result.blocks),
        prior - result.calibration_cov,
        prior,
        "Check their declared values; where they are only roughly known, declare larger sigmas.",
    )
    trust, excess = trust_of(fitted, moved)
    factor = max(excess, least)
    return replace(result, calibration_cov=factor * result.calibration_cov), trust


def transferred(compared: Transfer) -> Trust:
    """Return whether the calibrations of parts of a log agree, and improve its other parts."""
    result = []
    if compared.disagreement > MAX_DIFFERENCE_SIGMAS:
        text = (
            f"The calibrations of parts of the log disagree by {compared.disagreement:.1f} sigmas"
            " along a direction that both determine: a change during the log, or too small declared"
            " sigmas."
        )
        result.append(
            Finding("transfer", text, weight=compared.disagreement / MAX_DIFFERENCE_SIGMAS)
        )
    before, after = (
        float(np.sqrt(np.mean([one.residual**2 for one in scores])))
        for scores in (compared.declared, compared.calibrated)
    )
    if after > WORSE * before:
        text = (
            f"A calibration on one part of the log has a residual of {after:.3g} on the others, the"
            f" declared one {before:.3g}: record more motion."
        )
        result.append(Finding("transfer", text, weight=after / before))
    return Trust(tuple(result))


def _coverage_figures(covered: MotionCoverage) -> Figures:
    motion = {"motion_at_rest": covered.rest_share}
    for axis, extent, rotated in zip("xyz", covered.extent_world, covered.turned_deg, strict=True):
        motion[f"motion_extent_{axis}_m"] = float(extent)
        motion[f"motion_turned_{axis}_deg"] = float(rotated)
    return Figures(
        *(
            Figure("nearest_m_{beacon}", least, "m", beacon, Section.REPORT)
            for beacon, least in covered.nearest.items()
        ),
        *(Figure(name, value, section=Section.REPORT) for name, value in motion.items()),
    )


def _cuts(job: Job, log: Log, site: Site, parts: int | None) -> list[float | None] | None:
    """Return the bounds of the parts, the outer ones those of the job."""
    if parts is None:
        return None
    if not 2 <= parts <= MAX_PARTS:
        raise InputError(f"--cross-validate must lie between 2 and {MAX_PARTS}; got {parts}")
    if any(beacon.unknown is not None for beacon in site.beacons):
        raise InputError(
            "--cross-validate compares with the survey, but a beacon has none; survey it first"
        )
    first, last = float(log.imu.time[0]), float(log.imu.time[-1])
    if last - first < parts * MIN_PART:
        raise InputError(
            f"{job.log_path}: {last - first:.3g} s are too short for {parts} parts of at least"
            f" {MIN_PART:g} s; record longer, or use fewer parts"
        )
    inner = np.linspace(first, last, parts + 1)[1:-1]
    return [job.start, *(float(cut) for cut in inner), job.end]


def _transfer(
    job: Job, site: Site, settings: SmootherSettings, cuts: list[float | None], report: Report
) -> Transfer:
    from magfusion.estimation.batch.batch import smooth
    from magfusion.jobs.inputs import read_job
    from magfusion.results.refinement import result_site

    count = len(cuts) - 1
    logs = [read_job(replace(job, start=cuts[i], end=cuts[i + 1]))[0] for i in range(count)]
    results = []
    for i, log in enumerate(logs):
        report(f"calibrating on part {i + 1}", i, count)
        results.append(smooth(log, site, settings))
    sites = [result_site(r, log.name) for r, log in zip(results, logs, strict=True)]
    pairs = [(i, j) for i in range(count) for j in range(count) if i != j]
    declared = [_score(log, site, settings) for log in logs]
    calibrated = []
    for done, (i, j) in enumerate(pairs):
        report(f"calibration of part {i + 1} on part {j + 1}", done, len(pairs))
        calibrated.append(_score(logs[j], sites[i], settings))
    estimated = [Estimated(r.declared, r.calibration, r.blocks, r.calibration_cov) for r in results]
    separate = [
        float(np.max(np.abs(agreement(estimated[i], estimated[j])), initial=0.0))
        for i, j in pairs
        if i < j
    ]
    return Transfer(declared, calibrated, pairs, max(separate))


def _score(log: Log, site: Site, settings: SmootherSettings) -> PartScore:
    from magfusion.estimation.batch.batch import smooth
    from magfusion.results.errors import trajectory_errors

    fixed = smooth(log, site, replace(settings, estimate=OF_LOG))
    residual = float(np.sqrt(np.nanmean(fixed.residual**2)))
    if log.truth is None:
        return PartScore(residual, None, None)
    errors = trajectory_errors(fixed.states, log.truth)
    return PartScore(
        residual,
        errors.aligned_ate if errors.has_position else None,
        errors.aligned_attitude_rmse_deg if errors.has_attitude else None,
    )


# Attribute of a score, key of its figure, label and unit.
_SCORES = (
    ("residual", "residual_rms", "residual", "sigma"),
    ("position", "aligned_ate_m", "position, aligned", "m"),
    ("attitude_deg", "aligned_attitude_rmse_deg", "attitude, aligned", "deg"),
)


def _transfer_figures(transfer: Transfer) -> Figures:
    figures = [Figure("cross_parts", len(transfer.declared), section=Section.REPORT)]
    by_part = {f"part_{j + 1}_declared": score for j, score in enumerate(transfer.declared)}
    for (i, j), score in zip(transfer.pairs, transfer.calibrated, strict=True):
        by_part[f"part_{i + 1}_on_{j + 1}"] = score
    columns = (
        ("declared", ErrorColumn.FIXED, transfer.declared),
        ("calibrated", ErrorColumn.CALIBRATED, transfer.calibrated),
    )
    for name, key, label, unit in _SCORES:
        for which, column, scores in columns:
            values = [getattr(score, name) for score in scores]
            if None not in values:
                rms = float(np.sqrt(np.mean(np.square(values))))
                place = (Section.TRANSFER, label, column)
                figures.append(Figure(f"cross_{which}_{key}", rms, unit, None, *place))
        figures += [
            Figure(f"cross_{part}_{key}", getattr(score, name), section=Section.REPORT)
            for part, score in by_part.items()
            if getattr(score, name) is not None
        ]
    separate = Figure("cross_disagreement_sigma", transfer.disagreement, section=Section.REPORT)
    return Figures(*figures, separate)


COMMAND = Command(
    LogCalibrationSettings,
    run_calibrate_log,
    output="calibration",
    example="magfusion calibrate log log --cross-validate 2 -o calibration",
)
