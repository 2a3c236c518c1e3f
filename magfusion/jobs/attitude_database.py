"""The job that builds an attitude database: a log of known attitudes in, the database out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from magfusion.calibration.static_field import average, window_length
from magfusion.errors import InputError
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.files.attitude_table import write_database
from magfusion.jobs.settings import Command, LogSettings, Settings, option
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.model.truth_poses import truth_poses
from magfusion.papers.p001_magnetometer.matching import predict_field
from magfusion.papers.p001_magnetometer.matching_database import Index, build_database, prepare
from magfusion.receiver.admission import sample_rate_hz
from magfusion.results.figures import Figure, Figures, heading
from magfusion.results.verdict import trust_figures
from magfusion.units import DEGREE, Array

if TYPE_CHECKING:
    pass


TABLE = "attitudes.parquet"
MIN_FIELD = 1e-7  # T; a two hundredth of the Earth's at its weakest
DISTORTED, CONTRADICTED = 0.15, 0.3  # of the field: doubt, and more than iron on a platform does
_TAPER = 1.5  # by which a raised cosine averages white noise less than equal weights do


@dataclass(frozen=True, kw_only=True)
class Sampling(Settings):
    """Extraction of the static field from the waveform: averages that remove tones, or raw."""

    raw: bool = option(
        False,
        "Use every sample as it is: no beacon transmits, or the platform spins fast",
        common=True,
    )
    step: float | None = option(
        None, "Interval of epochs", unit="s", note="default: half a window", common=True
    )


@dataclass(frozen=True, kw_only=True)
class DatabaseSettings(LogSettings, Sampling):
    """Angles of a database, and the source of its attitudes."""

    angles: Literal["roll", "roll-pitch", "roll-pitch-yaw"] | None = option(
        None, "Angles that vary in the log", note="default: detected"
    )
    step_deg: float = option(
        1.0,
        "Measurements in cells of this size are averaged",
        unit="degrees",
        least=0.05,
        most=15.0,
    )
    trajectory: Path | None = option(
        None, "Reference: result of smooth, or a table", note="default: the log's truth"
    )


class Steady(NamedTuple):
    """The calibrated static field of a log."""

    time: Array  # (n,) (s)
    field_body: Array  # (n, 3) (T)
    force_body: Array | None  # (n, 3), mean specific force (m/s^2); None for raw samples
    # sigma, force_sigma: white noise of each component (T, m/s^2)
    sigma: float
    force_sigma: float
    length: float  # of a window (s)


def run_attitude_database(settings: DatabaseSettings, output: Path) -> Figures:
    """Build the database of a log with known attitudes: table, picture and report."""
    from magfusion.jobs.inputs import known_poses, named, read_job
    from magfusion.jobs.result_directory import claim, result_in
    from magfusion.results.plots.match import write_database_plot

    job, claimed = settings.job(output), claim(output, "calibrate attitude-database")
    log, site = read_job(job)
    reference, log = known_poses(log, job.log_path, settings.trajectory)
    with named(job.log_path):
        result = steady(log, site, settings)
    poses, known, reason = truth_poses(reference, result.time)
    if not np.any(known):
        raise InputError(
            f"{settings.trajectory or job.log_path}: does not cover the magnetometer's times:"
            f" {reason}; give another"
        )
    with named(job.log_path):
        built = build_database(
            result.field_body[known],
            poses.world_from_body,
            log.name,
            settings.angles,
            settings.step_deg * DEGREE,
        )
        index = prepare(built.database)
    entries = built.database
    _, pitch, yaw = entries.rpy[0] / DEGREE
    fixed = [Figure("held_pitch_deg", float(pitch), "deg")] if entries.angles == "roll" else []
    trust = judge_database(index, site, log)
    figures = (
        heading("calibrate attitude-database", log.name)
        | trust_figures(trust)
        | Figures(
            Figure("angles", entries.angles),
            Figure("entries", len(entries)),
            Figure("measurements", int(np.sum(known))),
            Figure("measurements_beyond_fold", built.beyond_fold),
            Figure("held_yaw_deg", float(yaw), "deg"),
            Figure("spacing_t", index.spacing, "T"),
            Figure("unexplained_by_a_uniform_field_t", index.sigma, "T"),
            *fixed,
        )
    )
    with result_in(claimed, figures, trust, job.log_path, output) as directory:
        write_database(entries, directory / TABLE)
        remaining = entries.field_body - predict_field(entries.rpy, index.field_world)
        write_database_plot(directory / "attitudes.png", entries, remaining)
    return figures


def judge_database(index: Index, site: Site, log: Log) -> Trust:
    """Return whether a database is consistent with one uniform field.

    Iron on the platform may distort it, which is the purpose of a database; attitudes without any
    similarity to a uniform field are wrong.
    """
    result = list(recorded(log, site, BRIDGED_CODES))
    size = float(np.linalg.norm(index.field_world))
    share = float(np.sqrt(3.0)) * index.sigma / size
    if share > DISTORTED:
        verdict = Verdict.FAILED if share > CONTRADICTED else Verdict.DOUBTFUL
        text = (
            f"One uniform field leaves {100.0 * share:.2g} % of the measurements unexplained: the"
            " attitudes are not those of this log (other clock, axes or mounting), or strong iron"
            " is on the platform."
        )
        result.append(Finding("earth_field", text, verdict, share / DISTORTED))
    if site.earth_field_world is not None:
        declared = float(np.linalg.norm(site.earth_field_world))
        off = max(size / declared, declared / size) - 1.0
        if off > CONTRADICTED:
            text = (
                f"The field of the database is {1e6 * size:.3g} uT and the site's Earth field"
                f" {1e6 * declared:.3g} uT: check the unit of magnetometer.parquet and the sensor's"
                " calibration."
            )
            result.append(Finding("earth_field", text, Verdict.FAILED, off / CONTRADICTED))
    return Trust(tuple(result))


def steady(log: Log, site: Site, sampling: Sampling) -> Steady:
    """Return the calibrated static field of a log in body axes.

    Raises InputError where the log has no waveform, or no stretch of it is long enough.
    """
    if log.waveform is None:
        raise InputError(
            "has no magnetometer.parquet, whose static part is the Earth's field; give the raw log"
        )
    if sampling.raw and sampling.step is not None:
        raise InputError("--raw uses every sample; omit --step")
    sensor, imu = site.platform.magnetometer, site.platform.imu
    if sampling.raw:
        time, measured, force = log.waveform.time, log.waveform.measured_sensor, None
        length = effective = 1.0 / sample_rate_hz(log.waveform)
    else:
        length = window_length(site)
        effective = length / _TAPER
        windows = _windows(log, imu.time_offset, length, sampling.step)
        means = average(log.waveform, log.imu, imu.time_offset, sensor, *windows)
        time, measured, force = means.time, means.measured_sensor, means.accel_body
    body_from_measured = sensor.body_from_sensor @ np.linalg.inv(sensor.matrix)
    field_body = (measured - sensor.offset) @ body_from_measured.T
    weakest = int(np.argmin(np.linalg.norm(field_body, axis=1)))
    if np.linalg.norm(field_body[weakest]) < MIN_FIELD:
        raise InputError(
            f"magnetometer: the field is zero at {time[weakest]:.3f} s, despite the Earth's field;"
            " check the instrument and its calibration, or exclude that part with --start and"
            " --end"
        )
    return Steady(
        time=time,
        field_body=field_body,
        force_body=force,
        sigma=float(sensor.noise_density * np.sqrt(0.5 / effective)),
        force_sigma=float(imu.accel_noise / np.sqrt(effective)),
        length=length,
    )


def _windows(
    log: Log, time_offset: float, length: float, step: float | None
) -> tuple[Array, Array]:
    """Return centre and length of windows that lie within both streams."""
    distance = 0.5 * length if step is None else step
    if not length / 100.0 <= distance <= 60.0:
        raise InputError(
            f"--step must lie between {length / 100.0:.3g} s and 60 s; got {distance:g}"
        )
    assert log.waveform is not None
    stamps = log.imu.time + time_offset
    begin = max(log.waveform.time[0], stamps[0]) + 0.5 * length
    end = min(log.waveform.time[-1], stamps[-1]) - 0.5 * length
    centre = np.arange(begin, end, distance)
    return centre, np.full(len(centre), length)


COMMAND = Command(
    DatabaseSettings,
    run_attitude_database,
    example="magfusion calibrate attitude-database log -o database",
)
