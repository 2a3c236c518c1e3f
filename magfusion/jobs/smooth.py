"""The job that smooths a log: trajectory, refined site, report and recording."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from magfusion.errors import EstimationError, InputError
from magfusion.jobs.settings import (
    Command,
    EarthSettings,
    EstimateSettings,
    LogSettings,
    RiskSettings,
    WindowSettings,
    option,
)
from magfusion.model.progress import Report, quiet
from magfusion.results.figures import Column, Figure, Figures, Section, heading

if TYPE_CHECKING:
    from magfusion.estimation.batch import Smoothed, SmootherSettings
    from magfusion.jobs.inputs import Job
    from magfusion.model.samples import Log
    from magfusion.model.site import Site
    from magfusion.model.trust import Risk
    from magfusion.units import Array


OPEN = "the measurements leave a direction of the motion open"
CONTRADICTION = "fields and inertial data contradict each other so much that nothing can be solved"


@dataclass(frozen=True, kw_only=True)
class SmoothSettings(LogSettings, WindowSettings, EarthSettings, EstimateSettings, RiskSettings):
    """How a log is smoothed."""

    coupling: Literal["tight", "loose"] = option("tight", "Phasors or fixes in the graph")
    robust: str | None = option(
        "cauchy",
        "Robust loss of the fields",
        words={"none": None, "huber": "huber", "cauchy": "cauchy"},
    )
    tune: bool = option(
        True, "Find noise and model error from the residuals; what is declared is a prior"
    )
    imu_rate: bool = option(
        False,
        "Epochs of the written trajectory",
        name="rate",
        words={"field": False, "imu": True},
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.earth and self.coupling == "loose":
            raise InputError("--earth needs the phasors themselves; leave --coupling loose out")

    def smoother(self, job: Job) -> SmootherSettings:
        """Return the settings of the estimator."""
        from magfusion.estimation.batch import SmootherSettings

        return SmootherSettings(
            coupling=self.coupling,
            loss=self.robust,
            tune=self.tune,
            estimate=self.groups,
            earth=self.earth,
            lockin=self.lockin(job),
        )


def run(settings: SmoothSettings, output: Path, report: Report = quiet) -> Figures:
    """Smooth a log as the settings ask; see `run_smooth`."""
    job = settings.job(output)
    smoother = settings.smoother(job)
    return run_smooth(job, smoother, imu_rate=settings.imu_rate, risk=settings.risks, report=report)


def run_smooth(
    job: Job,
    settings: SmootherSettings,
    *,
    imu_rate: bool = False,
    risk: Risk | None = None,
    report: Report = quiet,
) -> Figures:
    """Smooth a log: trajectory, refined site, report and recording.

    Parameters
    ----------
    imu_rate : bool
        Write the trajectory at every IMU sample rather than at the field epochs.
    risk : Risk, optional
        What the protection levels promise.

    Raises
    ------
    InputError, EstimationError
        In the latter case the single-epoch fixes have been saved in the output directory.
    """
    from magfusion.estimation.between_epochs import at_imu_rate
    from magfusion.estimation.integrity.diagnosis import with_cause
    from magfusion.estimation.integrity.judge import judged
    from magfusion.estimation.integrity.smoothed_exclusion import (
        separated_smooth,
        states_between,
        states_judged,
    )
    from magfusion.estimation.self_survey import smooth_and_place
    from magfusion.files.site import save_site
    from magfusion.files.trajectory_table import write_trajectory
    from magfusion.files.tum import write_tum
    from magfusion.jobs.inputs import claim, found_in, named, read_job, refuse_failed
    from magfusion.results.page_motion import Motion
    from magfusion.results.recording import write_recording
    from magfusion.results.refinement import result_site
    from magfusion.results.report import (
        FAILED,
        compared_with_truth,
        placement_figures,
        smoothed_figures,
        where_found,
        write_report,
    )
    from magfusion.results.verdict import level_figures, trust_figures

    claimed = claim(job.output, "smooth", "fix")
    log, site = read_job(job, unknown=True)
    began = time.perf_counter()
    try:
        with named(job.log_path):
            result, placed = smooth_and_place(log, site, settings, report)
    except RuntimeError as error:  # GTSAM's own, of a singular system, or an EstimationError
        reason = _reason(error)
        if any(beacon.unknown is not None for beacon in site.beacons):
            raise EstimationError(f"{job.log_path}: {reason}") from error
        with claimed as whole:
            said = _save_fixes_instead(whole, settings, log, site, reason)
        raise EstimationError(
            f"{job.log_path}: {said}; the single-epoch fixes were saved in {job.output / FAILED}"
        ) from error
    separated = separated_smooth(result, risk)
    result, trust = judged(separated.result, log)
    trust = with_cause(trust | separated.trust, log, site, settings.lockin)
    by_state = states_judged(separated, result, trust.verdict)
    figures = (
        heading("smooth", log.name)
        | trust_figures(trust)
        | Figures(where_found("coupling", settings.coupling != "tight", settings.coupling))
    )
    figures |= smoothed_figures(result) | level_figures(by_state)
    figures |= Figures(Figure("elapsed_s", time.perf_counter() - began, "s"))
    errors, compared = compared_with_truth(result.states, log)
    figures |= compared | placement_figures(placed, result.calibration.site)
    if errors is not None and not placed:
        figures |= _fixed_survey_figures(log, site, settings, result)
    refined, innovations = result_site(result, log.name), _innovations(result)
    written = at_imu_rate(result, log) if imu_rate else result.states
    with claimed as whole:
        directory = found_in(whole, trust)
        write_tum(written, directory / "trajectory.tum", log.epoch_ns)
        rows = states_between(by_state, result.states, written)
        write_trajectory(written, directory / "trajectory.parquet", log.epoch_ns, rows)
        save_site(refined, directory / "site.yaml")
        write_recording(
            directory / "run.rrd",
            refined,
            result.states,
            truth=log.truth,
            errors=errors,
            innovations=innovations,
            trust=trust,
            states=by_state,
        )
        motion = Motion(refined, result.states, log.truth, errors, innovations, by_state)
        write_report(whole, figures, motion)
    refuse_failed(job.log_path, output=job.output, trust=trust)
    return figures


def _innovations(result: Smoothed) -> dict[str, tuple[Array, Array]]:
    import numpy as np

    channels = result.fields.channels
    found = {}
    for name in dict.fromkeys(beacon for beacon, _ in channels):
        own = result.residual[:, [beacon == name for beacon, _ in channels]]
        seen = np.isfinite(own).all(axis=(1, 2))
        if np.any(seen):
            found[name] = (result.fields.time[seen], np.sqrt(np.mean(own[seen] ** 2, axis=(1, 2))))
    return found


def _fixed_survey_figures(
    log: Log, site: Site, settings: SmootherSettings, result: Smoothed
) -> Figures:
    """Return the errors with the calibration as surveyed: what estimating it was worth."""
    from magfusion.estimation.batch import smooth
    from magfusion.results.errors import trajectory_errors
    from magfusion.results.report import error_figures

    kept = ("phase", "time-offset")
    if all(block.group in kept for block in result.blocks):
        return Figures()
    try:
        fixed = smooth(log, site, replace(settings, estimate=kept))
    except RuntimeError as error:
        return Figures(Figure("held_failed", _reason(error), section=Section.REPORT))
    assert log.truth is not None
    return error_figures(trajectory_errors(fixed.states, log.truth), Column.FIXED, "held_")


def _reason(error: RuntimeError) -> str:
    if isinstance(error, EstimationError):
        return str(error)
    if "Indeterminate" in str(error):
        return OPEN
    raise error


def _save_fixes_instead(
    whole: Path, settings: SmootherSettings, log: Log, site: Site, reason: str
) -> str:
    """Write the fixes where there is no trajectory, below a name that says so; return why."""
    import numpy as np

    from magfusion.estimation.demodulation import first_fixes, phasors
    from magfusion.estimation.integrity.diagnosis import OF_CATCH_ALL, with_cause
    from magfusion.estimation.integrity.recording import BRIDGED, recorded
    from magfusion.jobs.fix import write_fix_result
    from magfusion.jobs.inputs import found_in
    from magfusion.model.parameters import initial_calibration
    from magfusion.model.trust import Finding, Trust, Verdict
    from magfusion.results.report import dropped_figures, fix_figures
    from magfusion.results.verdict import trust_figures

    samples, dropped = phasors(log, site, settings.lockin)
    fixes = first_fixes(samples, log, initial_calibration(site, float(np.mean(samples.time))))
    code = "no_solution"
    if reason.startswith(OPEN):
        code = "geometry" if np.mean(fixes.determined[:, 0]) < 0.5 else "diverged"
        what = f"{OPEN}: add a beacon or a coil"
        reason = what if code == "geometry" else CONTRADICTION
    text = f"There is no trajectory: {reason}."
    none = Finding(code, text, Verdict.FAILED, weight=0.0)
    trust = Trust((none, *recorded(log, site, BRIDGED, beacons=True)))
    if code != "geometry":  # of poses that no epoch determines nothing can be tried
        trust = with_cause(trust, log, site, settings.lockin)
    if trust.ordered[0].weight >= OF_CATCH_ALL:
        reason = trust.ordered[0].text.rstrip(".")
    figures = heading("smooth", log.name) | trust_figures(trust)
    figures |= Figures(Figure("failed", reason, section=Section.REPORT))
    figures |= fix_figures(fixes, site) | dropped_figures(dropped)
    directory = found_in(whole, trust)
    write_fix_result(directory, log, site, fixes, figures)
    (directory / "report.json").rename(whole / "report.json")
    return reason


COMMAND = Command(SmoothSettings, run, example="magfusion smooth log --site site.yaml -o run")
