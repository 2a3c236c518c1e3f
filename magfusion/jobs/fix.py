"""The job that fixes the pose at every epoch on its own, by likelihood or as in paper 004."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.estimation.snapshot.ambiguity import relations
from magfusion.estimation.snapshot.explained_fixes import ExplainedFixes, explained_fixes
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.fix_magnetometers import contradicting_magnetometers
from magfusion.estimation.snapshot.problem import ESTIMABLE
from magfusion.estimation.snapshot.region_test import of_place
from magfusion.files.fix_table import write_hypotheses
from magfusion.files.trajectory_table import write_trajectory
from magfusion.files.tum import write_tum
from magfusion.jobs.region import RegionSettings
from magfusion.jobs.rest_settings import RestSettings
from magfusion.jobs.settings import Command, RiskSettings, WindowSettings, option
from magfusion.model.parameters import Calibration, initial_calibration
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Risk, StateTrust, Trust
from magfusion.receiver.windows import LockinSettings
from magfusion.results.figures import Figure, Figures, heading
from magfusion.results.rest_figures import rest_figures
from magfusion.results.verdict import level_figures, trust_figures
from magfusion.units import Array

if TYPE_CHECKING:
    import numpy as np

    from magfusion.jobs.inputs import Job


@dataclass(frozen=True, kw_only=True)
class FixSettings(RegionSettings, WindowSettings, RestSettings, RiskSettings):
    """Settings of single-epoch fixes.

    `survey`: a survey's table, or the output directory of ``magfusion survey``.
    """

    method: Literal[
        "likelihood", "paper-lines", "paper-knn", "paper-knn-nt", "paper-fingerprint"
    ] = option("likelihood", "Maximum likelihood, or an algorithm of paper 004")
    survey: Path | None = option(None, "Fingerprint survey, required by the paper's methods")
    block: float | None = option(
        None, "For paper-lines: a line for each block of this size", unit="m", above=0.0
    )
    free: str | None = option(
        None,
        "Estimate these of every beacon with the pose, overriding the site (gains are estimated in"
        " any case where the fields require it)",
        metavar="phase,gain",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method != "likelihood" and self.free is not None:
            raise InputError("--free belongs to --method likelihood; omit one of the two")
        if self.method != "likelihood" and self.risks != RiskSettings().risks:
            raise InputError(
                "--risk and --fault-prior belong to --method likelihood: the algorithms of paper"
                " 004 have no covariance, and so no protection level"
            )
        if self.method == "likelihood" and self.survey is not None:
            raise InputError(
                "--survey belongs to the methods of paper 004; choose one with --method"
            )
        if self.method != "paper-lines" and self.block is not None:
            raise InputError("--block belongs to --method paper-lines")
        if self.method != "likelihood" and self.at_rest:
            raise InputError("--at-rest belongs to --method likelihood; omit one of the two")
        if self.method != "likelihood" and self.survey is None:
            raise InputError(
                f"--method {self.method} requires a survey; give one with --survey SURVEY"
            )


def run(settings: FixSettings, output: Path, report: Report = quiet) -> Figures:
    """Fix the pose at every epoch by the selected method."""
    job = settings.job(output)
    if settings.method != "likelihood":
        from magfusion.jobs.published_fix import run_published_fix

        assert settings.survey is not None
        return run_published_fix(
            job, settings.method, settings.survey, settings.block, settings.lockin(job)
        )
    free_parameters = _read_free_parameters(settings.free)
    lockin = settings.lockin(job)
    return run_fix(
        job,
        lockin=lockin,
        free_parameters=free_parameters,
        risk=settings.risks,
        rest=settings,
        report=report,
    )


def _read_free_parameters(text: str | None) -> tuple[str, ...]:
    """Parse ``phase,gain`` or either."""
    chosen = () if text is None else tuple(part.strip() for part in text.split(","))
    unknown = [part for part in chosen if part not in ESTIMABLE]
    if unknown:
        raise InputError(
            f"--free {text!r}: {unknown[0] or 'nothing'} cannot be estimated with the pose; choose"
            f" from {', '.join(ESTIMABLE)}"
        )
    return chosen


def run_fix(
    job: Job,
    *,
    lockin: LockinSettings | None = None,
    free_parameters: tuple[str, ...] = (),
    risk: Risk | None = None,
    rest: RestSettings | None = None,
    report: Report = quiet,
) -> Figures:
    """Fix the pose at every epoch on its own: every hypothesis, best first.

    `free_parameters`: parameters estimated with the pose in any case, as in
    `magfusion.estimation.snapshot.explained_fixes`. `risk`: specification of the protection levels.
    `rest`: settings by which each rest is one epoch.
    """
    from magfusion.estimation.demodulation.demodulation import fix_inputs, phasors
    from magfusion.jobs.inputs import named
    from magfusion.jobs.result_directory import claim, found_in, refuse_failed
    from magfusion.results.report import dropped_figures, fix_figures, where_found

    claimed = claim(job.output, "smooth", "fix")
    used = rest is not None and rest.at_rest
    log, site = _read(job, lockin, by_rests=used, report=report)
    began = time.perf_counter()
    report("demodulating", 0, 3)
    if len(site.platform.magnetometer.axes) == 1:
        return _run_coil(claimed, job, log, site, lockin, free_parameters, report)
    with named(job.log_path):
        rested = None if rest is None else rest.integrated(log, site, lockin)
        recording, log = log, log if rested is None else rested.log(log)
        phasor_samples, dropped = phasors(log, site, lockin)
    detection = None if rested is None else rested.detection(site)
    if rested is not None and not np.any(rested.detected):
        raise EstimationError(f"{job.log_path}: {rested.findings[0].text}")
    report("fixing", 1, 3)
    calibration = initial_calibration(site, float(np.mean(phasor_samples.time)))
    samples, gravity = fix_inputs(phasor_samples, log, site)
    result = explained_fixes(
        samples,
        calibration,
        gravity=gravity,
        free_parameters=free_parameters,
        risk=risk,
        report=report,
    )
    report("done", 3, 3)
    fixes, states = result.fixes, result.states
    of_log = recorded(recording, site, BRIDGED_CODES, beacons=True, detection=detection)
    trust = _trust(result, samples, calibration, of_log)
    of_rests = Figures()
    if rested is not None:
        trust |= Trust(rested.findings)
        dropped, of_rests = rested.dropped, rest_figures(rested)
    figures = heading("fix", log.name) | trust_figures(trust) | fix_figures(fixes, site)
    figures |= dropped_figures(dropped) | level_figures(states, len(site.beacons)) | of_rests
    figures |= Figures(where_found("gain_spread", result.gain_spread > 0.0, result.gain_spread))
    figures |= Figures(Figure("elapsed_s", time.perf_counter() - began, "s"))
    with claimed as whole:
        directory = found_in(whole, trust)
        figures = write_fix_result(directory, log, site, fixes, figures, states, trust)
        if directory != whole:
            (directory / "report.json").rename(whole / "report.json")
    refuse_failed(job.log_path, job.output, trust)
    return figures


def _read(
    job: Job, lockin: LockinSettings | None, *, by_rests: bool, report: Report
) -> tuple[Log, Site]:
    """Return log and site, restricted to what fixes of windows or of whole rests can use."""
    from magfusion.jobs.inputs import read_job

    log, site = read_job(
        job,
        fewer=True,
        separately=True,
        amplitudes=True,
        several=True,
        lockin=lockin,
        reference=by_rests,
        select_beacons=not by_rests,
        report=report,
    )
    if by_rests and site.platform.magnetometer.lacking:
        raise InputError(
            "--at-rest integrates samples of three axes; omit it for a receiver of fewer"
        )
    return log, site


def _trust(
    result: ExplainedFixes,
    samples: FieldSamples,
    calibration: Calibration,
    of_log: tuple[Finding, ...],
) -> Trust:
    """Return the findings of fixes, of the place and of several magnetometers; the recording."""
    fixes = result.fixes
    best = (fixes.world_from_body, fixes.position_world, fixes.pose_cov)
    place = of_place(calibration.site, fixes.time, *(part[:, 0] for part in best))
    several = contradicting_magnetometers(samples, calibration)
    return result.trust | Trust((*place, *of_log, *several))


def _run_coil(
    claimed: AbstractContextManager[Path],
    job: Job,
    log: Log,
    site: Site,
    lockin: LockinSettings | None,
    free_parameters: tuple[str, ...],
    report: Report,
) -> Figures:
    """Fix a receiver of one axis, whose roll about it is unobservable."""
    from magfusion.estimation.demodulation.demodulation import fix_inputs, phasors
    from magfusion.jobs.fix_coil import find_coil
    from magfusion.jobs.inputs import named
    from magfusion.jobs.result_directory import found_in, refuse_failed

    with named(job.log_path):
        samples, _ = fix_inputs(phasors(log, site, lockin)[0], log, site)
    result = find_coil(log, samples, site, free_parameters, report)
    with claimed as whole:
        directory = found_in(whole, result.trust)
        figures = write_fix_result(
            directory,
            result.log,
            site,
            result.fixes,
            result.figures,
            result.states,
            result.trust,
            relation=result.relation,
            columns=result.columns,
            nearest=result.compared,
        )
        if directory != whole:
            (directory / "report.json").rename(whole / "report.json")
    refuse_failed(job.log_path, job.output, result.trust)
    return figures


def write_fix_result(
    directory: Path,
    log: Log,
    site: Site,
    fixes: Fixes,
    figures: Figures,
    states: StateTrust | None = None,
    trust: Trust | None = None,
    *,
    relation: NDArray[np.str_] | None = None,
    columns: Mapping[str, Array] | None = None,
    nearest: Trajectory | None = None,
) -> Figures:
    """Write the fixes; return the figures with the errors against the truth.

    `relation`: as in `write_hypotheses`, if not that of the symmetries. `columns`: additional
    columns. `nearest`: trajectory compared with the truth, if not that of the best hypotheses.
    """
    from magfusion.results.axes import axis_figures
    from magfusion.results.page_motion import MotionPage
    from magfusion.results.recording import write_recording
    from magfusion.results.report import compared_with_truth, write_report

    best = fixes.best()
    errors, compared = compared_with_truth(best if nearest is None else nearest, log)
    if nearest is None:
        compared = axis_figures(best, errors) | compared
    write_tum(best, directory / "trajectory.tum", log.epoch_ns)
    write_trajectory(best, directory / "trajectory.parquet", log.epoch_ns, states)
    write_hypotheses(
        directory / "fixes.parquet",
        log.epoch_ns,
        fixes.time,
        fixes.world_from_body,
        fixes.position_world,
        fixes.cost,
        fixes.probability,
        fixes.determined,
        relations(fixes, site).label if relation is None else relation,
        states,
        columns=columns or {},
    )
    write_recording(
        directory / "run.rrd",
        site,
        best,
        truth=log.truth,
        errors=errors,
        trust=trust,
        states=states,
    )
    residual = fixes.residual_rms[:, 0]
    motion = MotionPage(site, best, log.truth, errors, trust=states, residual=residual)
    write_report(directory, figures | compared, motion)
    return figures | compared


COMMAND = Command(FixSettings, run, example="magfusion fix log -o fixes")
