"""Fixes of every epoch by an algorithm of paper 004."""

import time
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.files.survey import read_survey
from magfusion.files.table import TIME, Span, write_table
from magfusion.files.trajectory_table import write_trajectory
from magfusion.files.tum import write_tum
from magfusion.jobs.inputs import Job, named, read_job
from magfusion.jobs.result_directory import claim, found_in, refuse_failed
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Trust, uniform_trust
from magfusion.model.truth_poses import truth_poses
from magfusion.papers.p004_fingerprints.algorithms import Method, PublishedFixes, fix_as_published
from magfusion.papers.p004_fingerprints.fingerprint import fingerprint_database
from magfusion.papers.p004_fingerprints.rotating import (
    MAX_TILT,
    attitude_is_valid,
    axis_spread,
    rotating_beacons,
    rotating_fields,
)
from magfusion.receiver.windows import LockinSettings
from magfusion.results.errors import TrajectoryErrors
from magfusion.results.figures import Figure, Figures, heading
from magfusion.results.page_motion import MotionPage
from magfusion.results.recording import write_recording
from magfusion.results.report import compared_with_truth, dropped_figures, write_report
from magfusion.results.verdict import trust_figures
from magfusion.units import DEGREE, Array, BoolArray


def run_published_fix(
    job: Job, method: Method, survey: Path, block: float | None, lockin: LockinSettings | None
) -> Figures:
    """Fix every epoch on its own by an algorithm of paper 004.

    The poses have no covariance, because the algorithms give none.  Epochs at which the beacons'
    axes or the accelerometer show that Eq 18 cannot hold have no attitude, and as the lever arm
    requires one, only the position of the magnetometer (``positions.parquet``).
    """
    claimed = claim(job.output, "smooth", "fix")
    log, site = read_job(job)
    table = survey / "survey.parquet" if survey.is_dir() else survey
    with named(table):
        database, axis_world = rotating_beacons(
            fingerprint_database(read_survey(table), site), site
        )
    began = time.perf_counter()
    with named(job.log_path):
        samples, windows_dropped = phasors(log, site, lockin)
    fields = rotating_fields(samples, site, database.beacons, axis_world)
    fixes = fix_as_published(database, fields, method, block)
    if len(fixes.epoch) == 0:
        reasons = ", ".join(f"{count} {reason}" for reason, count in fixes.dropped.items())
        raise InputError(
            f"{job.log_path}: none of its {len(samples)} epochs can be located with {table}"
            f" ({reasons}); make the survey where the log was recorded"
        )
    stamps = samples.time[fixes.epoch]
    valid = attitude_is_valid(axis_world, stamps, log.imu)
    result = _poses(fixes, stamps, site, valid)
    trust = Trust(
        (*_findings(method, valid, axis_spread(axis_world)), *recorded(log, site, BRIDGED_CODES))
    )
    errors, compared = compared_with_truth(result, log) if len(result) else (None, Figures())
    figures = (
        heading("fix", log.name)
        | trust_figures(trust)
        | Figures(
            Figure("method", method),
            Figure("epochs", len(stamps)),
            Figure("epochs_without_attitude", int(np.sum(~valid))),
            Figure("fingerprints", len(database)),
        )
    )
    figures |= dropped_figures(fixes.dropped, "epochs") | dropped_figures(windows_dropped)
    figures |= compared
    if not np.all(valid):
        figures |= _position_figures(fixes.position_world, stamps, log, site)
    figures |= Figures(Figure("elapsed_s", time.perf_counter() - began, "s"))
    with claimed as whole:
        directory = found_in(whole, trust)
        if not np.all(valid):
            _write_positions(fixes.position_world, stamps, log.epoch_ns, directory)
        if len(result):
            _write_poses(result, directory, log, site, trust, errors)
        page = MotionPage(site, result, log.truth, errors) if len(result) else None
        write_report(whole, figures, page)
    refuse_failed(job.log_path, job.output, trust)
    return figures


def _poses(fixes: PublishedFixes, stamps: Array, site: Site, valid: BoolArray) -> Trajectory:
    """Return the body's poses at the epochs whose attitude is valid."""
    rotation = fixes.world_from_body[valid]
    lever_world = rotation @ site.platform.magnetometer.position_body
    return Trajectory(stamps[valid], rotation, fixes.position_world[valid] - lever_world)


def _findings(method: str, valid: BoolArray, spread: float) -> tuple[Finding, ...]:
    text = f"--method {method} has no covariance: the accuracy of a pose is unknown."
    findings = (Finding("no_covariance", text),)
    if np.all(valid):
        return findings
    limit = f"{MAX_TILT / DEGREE:g}°"
    cause = (
        f"the beacons' rotation axes differ by {spread / DEGREE:.0f}° from a common one"
        if spread > MAX_TILT
        else f"the accelerometer shows a tilt of more than {limit}"
    )
    text = (
        f"{np.sum(~valid)} of {len(valid)} epochs have no attitude: {cause}. Eq 18 of paper 004"
        f" requires rotations about one axis that all beacons share (limit {limit})."
        " Use --method likelihood; positions.parquet has the positions of the magnetometer."
    )
    return (*findings, Finding("attitude_refused", text))


def _position_figures(position_world: Array, stamps: Array, log: Log, site: Site) -> Figures:
    """Return the error of the magnetometer's positions against the log's truth, if it has one."""
    if log.truth is None or not log.truth.has_poses:
        return Figures()
    true, compared, _ = truth_poses(log.truth, stamps)
    if len(true) == 0:
        return Figures()
    lever_world = true.world_from_body @ site.platform.magnetometer.position_body
    error = position_world[compared] - true.position_world - lever_world
    rms = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return Figures(Figure("magnetometer_position_rmse_m", rms, "m"))


def _write_positions(position_world: Array, stamps: Array, epoch_ns: int, directory: Path) -> None:
    names = ("position_x", "position_y", "position_z")
    columns: dict[str, object] = {TIME: Span(epoch_ns).stamps(stamps)}
    columns |= dict(zip(names, position_world.T, strict=True))
    write_table(columns, directory / "positions.parquet")


def _write_poses(
    result: Trajectory,
    directory: Path,
    log: Log,
    site: Site,
    trust: Trust,
    errors: TrajectoryErrors | None,
) -> None:
    write_tum(result, directory / "trajectory.tum", log.epoch_ns)
    rows = uniform_trust(len(result), trust.verdict)
    write_trajectory(result, directory / "trajectory.parquet", log.epoch_ns, rows)
    recording = directory / "run.rrd"
    write_recording(recording, site, result, truth=log.truth, errors=errors, trust=trust)
