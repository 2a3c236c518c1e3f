"""The job that smooths a log: trajectory, refined site, report and recording."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.data_quality import beyond
from magfusion.estimation.rests.stationary_integration import IntegratedRests
from magfusion.estimation.snapshot.coil_gain import with_found_gain
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.files.checkpoint import claim_checkpoint, read_position, run_key
from magfusion.jobs.failure import reason_of
from magfusion.jobs.rates import RateSettings, refuse_rate
from magfusion.jobs.region import RegionSettings
from magfusion.jobs.rest_settings import RestSettings
from magfusion.jobs.settings import (
    Command,
    EarthSettings,
    EstimateSettings,
    LogsSettings,
    RiskSettings,
    WindowSettings,
    option,
)
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Risk
from magfusion.results.figures import Figure, Figures
from magfusion.results.rest_figures import rest_figures
from magfusion.units import Rate

if TYPE_CHECKING:
    from magfusion.estimation.batch.batch import SmootherSettings
    from magfusion.estimation.batch.outer_iterations import PassFile
    from magfusion.jobs.inputs import Job
    from magfusion.jobs.smooth_result import Finished


@dataclass(frozen=True, kw_only=True)
class SmoothSettings(
    LogsSettings,
    RegionSettings,
    WindowSettings,
    RestSettings,
    EarthSettings,
    EstimateSettings,
    RiskSettings,
    RateSettings,
):
    """Settings of the smoother."""

    coupling: Literal["tight", "loose"] = option("tight", "Phasors or fixes in the graph")
    robust: str | None = option(
        "cauchy",
        "Robust loss of the fields",
        words={"none": None, "huber": "huber", "cauchy": "cauchy"},
    )
    engine: Literal["bordered", "gtsam"] = option(
        "bordered", "Optimiser of a log: its own loop, or GTSAM's Levenberg-Marquardt to check it"
    )
    tune: bool = option(
        True, "Estimate noise and model error from the residuals, with the declared as a prior"
    )
    map_steel: bool = option(
        False, "Map the steel near the path, and use the map if it predicts beacons left out"
    )
    checkpoint: Path | None = option(
        None, "File that stores the result of each pass over the log, while the job runs"
    )
    resume: bool = option(False, "Continue from the checkpoint, if there is one")
    free: str | None = option(
        None, "Unknown parameter of a receiver of one axis: gain", metavar="gain"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.earth and self.coupling == "loose":
            raise InputError("--earth requires phasors; omit --coupling loose")
        if self.free not in (None, "gain"):
            raise InputError(f"--free {self.free!r}: smooth estimates gain only; write --free gain")
        if self.at_rest:
            self._check_rests()
        if self.map_steel and (self.at_rest or self.coupling == "loose"):
            raise InputError(
                "--map-steel maps the steel along the path by its fields; omit --at-rest and"
                " --coupling loose"
            )
        if self.more and self.engine != "bordered":
            raise InputError(
                "--engine gtsam solves one log; omit it, or smooth the logs one by one"
            )
        if self.resume and self.checkpoint is None:
            raise InputError("--resume requires a file; give it with --checkpoint FILE")
        if self.checkpoint is not None and self.more:
            raise InputError(
                "--checkpoint stores the passes over one log; with several, finished logs are"
                " stored in the output: omit it and repeat the command"
            )
        if self.free and self.more:
            raise InputError("--free gain uses one log; smooth the logs one by one")

    def _check_rests(self) -> None:
        if self.more:
            raise InputError(
                "--at-rest integrates one log; make phasors of each with magfusion demodulate"
                " --at-rest, and smooth these together"
            )
        if self.earth or self.free:
            raise InputError(
                "--at-rest gives phasors of whole rests, which do not support the Earth field"
                " or a common gain; omit --earth and --free"
            )

    def smoother(self, job: Job) -> SmootherSettings:
        """Return the settings of the estimator."""
        from magfusion.estimation.batch.batch import SmootherSettings

        return SmootherSettings(
            coupling=self.coupling,
            loss=self.robust,
            tune=self.tune,
            engine=self.engine,
            estimate=self.groups,
            earth=self.earth,
            lockin=self.lockin(job),
        )


def run(settings: SmoothSettings, output: Path, report: Report = quiet) -> Figures:
    """Smooth a log, or several together; see `run_smooth`, `run_joint`."""
    from magfusion.jobs.without_beacons import without_beacons

    job = settings.job(output)
    if not settings.more and without_beacons(job):
        from magfusion.jobs.orientation import run_orientation

        return run_orientation("smooth", job, settings.rates, back=True, report=report)
    smoother = settings.smoother(job)
    if settings.more:
        from magfusion.jobs.joint_result import run_joint

        return run_joint(
            "smooth",
            settings,
            smoother,
            output,
            report,
            rate=settings.rates,
            risk=settings.risks,
            mapping=settings.map_steel,
        )
    place = settings.checkpoint
    return run_smooth(
        job,
        smoother,
        rate=settings.rates,
        risk=settings.risks,
        free_gain=settings.free is not None,
        rest=settings if settings.at_rest else None,
        kept=None if place is None else (place, settings.resume),
        mapping=settings.map_steel,
        report=report,
    )


def run_smooth(
    job: Job,
    settings: SmootherSettings,
    *,
    rate: Rate = "field",
    risk: Risk | None = None,
    free_gain: bool = False,
    rest: RestSettings | None = None,
    kept: tuple[Path, bool] | None = None,
    mapping: bool = False,
    report: Report = quiet,
) -> Figures:
    """Smooth a log: trajectory, refined site, report and recording.

    Parameters
    ----------
    rate : 'field', 'imu' or float
        Rate of the written trajectory: at the field epochs, at every inertial sample, or so many
        a second (Hz).
    risk : Risk, optional
        Specification of the protection levels.
    free_gain : bool
        Whether the gain of a receiver of one axis starts at the single-epoch estimate.
    rest : RestSettings, optional
        Settings for integration of whole rests, instead of windows.
    kept : tuple of (Path, bool), optional
        File with the result of each pass, and whether to resume from it.
    mapping : bool
        Whether steel near the path is mapped.
    """
    from magfusion.estimation.batch.self_survey import smooth_and_place
    from magfusion.estimation.integrity.magnetometer_exclusion import agreed_smoothed
    from magfusion.estimation.integrity.steel_map import MOVED, explained_without_map
    from magfusion.jobs.inputs import named
    from magfusion.jobs.result_directory import claim, refuse_failed
    from magfusion.jobs.smooth_correction import corrected
    from magfusion.jobs.smooth_result import finished, with_errors, write_finished

    claimed = claim(job.output, "smooth", "fix")
    recording, site = _read(job, settings, by_rests=rest is not None, report=report)
    rested, log = None, recording
    if rest is not None:
        rested = _rested(job, log, site, rest, settings)
        log = rested.log(log)
    refuse_rate(job.log_path, log, rate)
    if free_gain:
        site = _with_gain(job, log, site, settings)
    _refuse_placing(job, site)
    iterations_file = None if kept is None else _iterations_file(*kept, log, site, settings)
    began = time.perf_counter()
    try:
        with named(job.log_path):
            result, placed = smooth_and_place(log, site, settings, report, iterations_file)
            moved = explained_without_map(result)
            if moved:
                site = site.without_steel()
                result, placed = smooth_and_place(log, site, settings, report)
            log, site, result, findings = agreed_smoothed(result, log, site, settings, risk)
    except RuntimeError as error:  # GTSAM's own, of a singular system, or an EstimationError
        done, placed = _without_result(job, log, site, settings, risk, error, report, claimed), ()
    else:
        give_back_memory()
        findings += () if rested is None else beyond(recording, log, site)
        findings += (MOVED,) if moved else ()
        done = finished(log, site, settings, result, risk, findings=findings, mapping=mapping)
        parts = done.corrections, done.trust.reasons, findings, report
        done = corrected(log, site, settings, risk, *parts, mapping=mapping) or done
    figures = done.figures | Figures(Figure("elapsed_s", time.perf_counter() - began, "s"))
    figures |= Figures() if rested is None else rest_figures(rested)
    done = with_errors(replace(done, figures=figures), log, placed, (done.site, settings))
    with claimed as whole:
        write_finished(whole, log, done, rate=rate)
    if iterations_file is not None:
        iterations_file.place.unlink(missing_ok=True)
    refuse_failed(job.log_path, output=job.output, trust=done.trust)
    return done.figures


def _without_result(
    job: Job,
    log: Log,
    site: Site,
    settings: SmootherSettings,
    risk: Risk | None,
    error: RuntimeError,
    report: Report,
    claimed: AbstractContextManager[Path],
) -> Finished:
    """Return the result with a corrected site where there is none with the declared one.

    Raises EstimationError with the reason if there is none, and saves the single-epoch fixes in the
    directory that is claimed.
    """
    from magfusion.estimation.integrity.correction import corrections
    from magfusion.jobs.smooth_correction import corrected
    from magfusion.jobs.smooth_failure import failure_of, save_failure
    from magfusion.results.report import FAILED

    reason = reason_of(error)
    if _has_unknown(site):
        raise EstimationError(f"{job.log_path}: {reason}") from error
    failure = failure_of(log, site, settings, reason)
    possible = corrections(site, (), (), failure.cause)
    reasons = failure.trust.reasons
    done = corrected(log, site, settings, risk, possible, reasons, report=report)
    if done is not None:
        return done
    with claimed as directory:
        save_failure(directory, failure, log, site)
    saved = f"the single-epoch fixes are saved in {job.output / FAILED}"
    raise EstimationError(f"{job.log_path}: {failure.reason}; {saved}") from error


def _has_unknown(site: Site) -> bool:
    """Return whether a site has beacons that were never surveyed."""
    return any(beacon.unknown is not None for beacon in site.beacons)


def _refuse_placing(job: Job, site: Site) -> None:
    """Reject beacons that were never surveyed with several magnetometers."""
    if site.platform.further and _has_unknown(site):
        raise InputError(
            f"{job.declared_path}: beacons that were never surveyed require a single magnetometer;"
            " give a site with one"
        )


def _read(
    job: Job, settings: SmootherSettings, *, by_rests: bool, report: Report
) -> tuple[Log, Site]:
    """Return log and site, restricted to what smoothing of windows or whole rests can use."""
    from magfusion.jobs.inputs import read_job

    return read_job(
        job,
        unknown=True,
        fewer=not by_rests,
        amplitudes=not by_rests,
        several=True,
        reread=not by_rests,
        lockin=settings.lockin,
        reference=by_rests,
        select_beacons=not by_rests,
        report=report,
    )


def _iterations_file(
    place: Path, resume: bool, log: Log, site: Site, settings: SmootherSettings
) -> PassFile:
    """Return the file of the passes, for a log with this site and these settings."""
    from magfusion.estimation.batch.outer_iterations import PassFile

    if any(beacon.unknown is not None for beacon in site.beacons):
        raise InputError("--checkpoint requires a site whose beacons are all surveyed; omit it")
    if not place.parent.is_dir():
        raise InputError(f"{place.parent}: is no directory; create it, or give another path")
    streams = [s for s in (log.imu, log.waveform, log.fields) if s is not None]
    key = run_key("smooth", site, settings, log.epoch_ns, streams)
    if resume:
        read_position(place, key)
    else:
        claim_checkpoint(place)
    return PassFile(place, key, resume)


def _rested(
    job: Job, log: Log, site: Site, rest: RestSettings, settings: SmootherSettings
) -> IntegratedRests:
    """Return the rests of a log, in any of which at least one beacon is detected."""
    from magfusion.jobs.inputs import named

    if site.platform.further:
        raise InputError(
            f"{job.declared_path}: --at-rest integrates the samples of one magnetometer; omit it,"
            " or give a site of the one to integrate"
        )
    with named(job.log_path):
        rested = rest.integrated(log, site, settings.lockin, least=2)
    assert rested is not None
    if not np.any(rested.detected):
        raise EstimationError(f"{job.log_path}: {rested.findings[-1].text}")
    return rested


def _with_gain(job: Job, log: Log, site: Site, settings: SmootherSettings) -> Site:
    """Return the site with the gain estimated from the epochs of a receiver of one axis."""
    from magfusion.estimation.demodulation.demodulation import fix_inputs, phasors
    from magfusion.jobs.inputs import named

    if len(site.platform.magnetometer.axes) != 1:
        raise InputError(
            "--free gain: is the common gain of a receiver of one axis; for more axes declare the"
            " uncertainty of the gains as platform.magnetometer.sigma.matrix"
        )
    with named(job.log_path):
        fields, _ = fix_inputs(phasors(log, site, settings.lockin)[0], log, site)
        return with_found_gain(fields, site)


COMMAND = Command(SmoothSettings, run, example="magfusion smooth log --site site.yaml -o run")
