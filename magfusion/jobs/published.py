"""The job that fixes a log as paper 004 does, from a survey: for comparison."""

import time
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.fixes.fingerprint import (
    NEIGHBOURS,
    FingerprintDatabase,
    amplitude_of,
    calibrated,
    fingerprint_database,
)
from magfusion.fixes.published import LEAST_BEACONS, Method, RotatingFields, fix_as_published
from magfusion.fusion.source import phasors
from magfusion.job import Job, claim, named, read_job
from magfusion.receiver.ellipse import plane_normal
from magfusion.records.samples import FieldSamples
from magfusion.records.survey import read_survey
from magfusion.records.trajectory_table import write_trajectory
from magfusion.records.tum import write_tum
from magfusion.report import Figures, compared_with_truth, dropped_figures, write_report
from magfusion.site import Beacon, Site
from magfusion.trajectory import Trajectory
from magfusion.units import Array, BoolArray
from magfusion.view import write_recording

ROUND = 1e-3  # least ratio of a rotating moment's axes


def run_published_fix(
    job: Job, method: Method, survey_path: Path | None, block: float | None = None
) -> Figures:
    """Fix every epoch on its own by an algorithm of paper 004.

    The poses have no covariance, because the algorithms give none.

    Parameters
    ----------
    job : Job
    method : {"paper-lines", "paper-knn", "paper-knn-nt", "paper-fingerprint"}
    survey_path : Path
        A survey's table, or the directory that ``magfusion survey`` wrote.
    block : float, optional
        Of ``paper-lines``: fit lines in blocks of this size (m).

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError
        Where there is no survey, it names a beacon that the site does not know, it and the site
        share fewer than three rotating beacons, or no epoch hears as many.
    EstimationError
    """
    if survey_path is None:
        raise InputError(f"--method {method} locates by a survey; name one with --survey SURVEY")
    if block is not None and not 0.0 < block < np.inf:
        raise InputError(f"--block must be above 0 m; got {block:g}")
    claimed = claim(job.output, "smooth", "fix")
    log, site = read_job(job)
    table = survey_path / "survey.parquet" if survey_path.is_dir() else survey_path
    with named(table):
        database, axis_world = _rotating(fingerprint_database(read_survey(table), site), site)
    began = time.perf_counter()
    with named(job.log_path):
        samples, windows_dropped = phasors(log, site, job.lockin)
    fields = rotating_fields(samples, site, database.beacons, axis_world)
    fixes = fix_as_published(database, fields, method, block)
    if len(fixes.epoch) == 0:
        reasons = ", ".join(f"{count} {reason}" for reason, count in fixes.dropped.items())
        raise InputError(
            f"{job.log_path}: none of its {len(samples)} epochs can be located with {table}"
            f" ({reasons}); make the survey where the log was recorded"
        )
    lever_world = fixes.world_from_body @ site.platform.magnetometer.position_body
    found = Trajectory(
        samples.time[fixes.epoch], fixes.world_from_body, fixes.position_world - lever_world
    )
    errors, compared = compared_with_truth(found, log)
    figures: Figures = {
        "job": "fix",
        "log": log.name,
        "method": method,
        "epochs": len(found),
        "fingerprints": len(database),
        "epochs_dropped": len(samples) - len(found),
    }
    figures |= {"epochs_dropped_" + k.replace(" ", "_"): n for k, n in fixes.dropped.items()}
    figures |= dropped_figures(windows_dropped) | compared
    figures["elapsed_s"] = time.perf_counter() - began
    with claimed as directory:
        write_tum(found, directory / "trajectory.tum", log.epoch_ns)
        write_trajectory(found, directory / "trajectory.parquet", log.epoch_ns)
        write_recording(directory / "run.rrd", site, found, truth=log.truth, errors=errors)
        write_report(directory, figures)
    return figures


def _rotating(database: FingerprintDatabase, site: Site) -> tuple[FingerprintDatabase, Array]:
    """Return the fingerprints of rotating beacons alone, and the axes about which these turn."""
    axis = np.array([rotation_axis_world(b) for b in _beacons(site, database)])
    columns = np.flatnonzero(np.isfinite(axis).all(axis=1))
    if len(columns) < LEAST_BEACONS:
        raise InputError(
            f"the algorithms of paper 004 need {LEAST_BEACONS} rotating beacons, two coils on one"
            f" tone; site and survey share {len(columns)}; take --method likelihood, or add beacons"
        )
    kept = FingerprintDatabase(
        tuple(database.beacons[c] for c in columns),
        database.beacons_world[columns],
        database.position_world,
        database.amplitude[:, columns],
    )
    useful = int(np.sum(_enough(kept.amplitude)))
    if useful < NEIGHBOURS:
        raise InputError(
            f"holds {useful} points that hear {LEAST_BEACONS} rotating beacons, and {NEIGHBOURS}"
            " are needed; survey more places"
        )
    return kept, axis[columns]


def _beacons(site: Site, database: FingerprintDatabase) -> list[Beacon]:
    return [b for b in site.beacons if b.name in database.beacons]


def _enough(amplitude: Array) -> BoolArray:
    return np.asarray(np.sum(np.isfinite(amplitude), axis=1) >= LEAST_BEACONS)


def rotation_axis_world(beacon: Beacon) -> Array:
    """Return the unit vector about which a beacon's moment turns; NaN where it does not."""
    if len(beacon.tones) != 1:
        return np.full(3, np.nan)
    drive = (beacon.moments_beacon.T @ beacon.excitation)[:, 0]
    normal = plane_normal(drive)
    size = float(np.linalg.norm(normal))
    if size < ROUND * float(np.sum(np.abs(drive) ** 2)):
        return np.full(3, np.nan)
    return np.asarray(beacon.world_from_beacon @ normal / size)


def rotating_fields(
    samples: FieldSamples, site: Site, beacons: tuple[str, ...], axis_world: Array
) -> RotatingFields:
    """Return the amplitudes and normals of rotating beacons (`rotation_axis_world`)."""
    own = [site.channels.index((name, 0)) for name in beacons]
    phasor = calibrated(samples.phasor_sensor[:, own], site)
    body_from_sensor = site.platform.magnetometer.body_from_sensor
    return RotatingFields(
        axis_world=axis_world,
        amplitude=amplitude_of(phasor[:, :, None]),
        normal_body=plane_normal(phasor) @ body_from_sensor.T,
    )
