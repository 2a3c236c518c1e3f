"""The job that builds an attitude database: a log of known attitudes in, the database out."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from magfusion.calibration.steady_field import average, window_length
from magfusion.errors import InputError
from magfusion.fixes.matching import predict_field
from magfusion.fixes.matching_database import build_database, prepare
from magfusion.job import Job, claim, named, read_estimate, read_job
from magfusion.plots.match import write_database_plot
from magfusion.receiver.windows import sample_rate_hz
from magfusion.records.attitude_table import write_database
from magfusion.records.samples import Log
from magfusion.report import Figures, write_report
from magfusion.site import Site
from magfusion.trajectory import Trajectory, interpolate
from magfusion.units import DEGREE, Array

TABLE = "attitudes.parquet"
LEAST_FIELD = 1e-7  # T; a two hundredth of the Earth's at its weakest
MAX_GAP = 0.2  # s; of the reference, across which it is interpolated
_TAPER = 1.5  # by which a raised cosine averages white noise less than equal weights do


@dataclass(frozen=True)
class Sampling:
    """How the steady field is taken from the waveform.

    Parameters
    ----------
    raw : bool
        Every sample as it is, where no beacon radiates; else averages over which tones vanish.
    step : float, optional
        Distance of the averages (s); default: half their length.
    """

    raw: bool = False
    step: float | None = None


@dataclass(frozen=True)
class DatabaseSettings:
    """What a database shall tell, and whence its attitudes are known.

    Parameters
    ----------
    angles : str, optional
        "roll" or "roll-pitch"; default: what varies.
    step_deg : float
        Cells in which measurements are averaged.
    trajectory : Path, optional
        Reference in place of the log's truth: a result's directory, TUM file or table.
    sampling : Sampling
    """

    angles: str | None = None
    step_deg: float = 1.0
    trajectory: Path | None = None
    sampling: Sampling = field(default_factory=Sampling)


class Steady(NamedTuple):
    """The steady field of a log, calibrated.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    field_body : ndarray, shape (n, 3)
        (T)
    force_body : ndarray, shape (n, 3), optional
        Mean specific force (m/s^2); None where every sample is taken as it is.
    sigma, force_sigma : float
        White noise of each component (T, m/s^2).
    length : float
        Of a window (s).
    """

    time: Array
    field_body: Array
    force_body: Array | None
    sigma: float
    force_sigma: float
    length: float


def run_attitude_database(job: Job, settings: DatabaseSettings) -> Figures:
    """Build the database of a log whose attitudes are known: table, picture and report.

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError
        Where the log has no reference, an angle varies that one vector cannot tell, or ``output``
        is in the way.
    """
    if not 0.05 <= settings.step_deg <= 15.0:
        raise InputError(f"--step-deg must lie between 0.05 and 15; got {settings.step_deg:g}")
    claimed = claim(job.output, "calibrate attitude-database")
    log, site = read_job(job)
    reference, place = _reference(job, log, settings.trajectory)
    with named(job.log_path):
        found = steady(log, site, settings.sampling)
    poses, known = interpolate(reference, found.time, MAX_GAP)
    if not np.any(known):
        raise InputError(f"{place}: does not cover the magnetometer's time; give one that does")
    with named(job.log_path):
        built = build_database(
            found.field_body[known],
            poses.world_from_body,
            log.name,
            settings.angles,
            settings.step_deg * DEGREE,
        )
        index = prepare(built.database)
    entries = built.database
    _, pitch, yaw = entries.rpy[0] / DEGREE
    figures: Figures = {
        "job": "calibrate attitude-database",
        "log": log.name,
        "angles": entries.angles,
        "entries": len(entries),
        "measurements": int(np.sum(known)),
        "measurements_beyond_fold": built.beyond_fold,
        "held_yaw_deg": float(yaw),
        "spacing_t": index.spacing,
        "unexplained_by_a_uniform_field_t": index.sigma,
    }
    if entries.angles == "roll":
        figures["held_pitch_deg"] = float(pitch)
    with claimed as directory:
        write_database(entries, directory / TABLE)
        left = entries.field_body - predict_field(entries.rpy, index.field_world)
        write_database_plot(directory / "attitudes.png", entries, left)
        write_report(directory, figures)
    return figures


def _reference(job: Job, log: Log, trajectory: Path | None) -> tuple[Trajectory, Path]:
    if trajectory is not None:
        return read_estimate(trajectory, log.epoch_ns), trajectory
    if log.truth is None:
        raise InputError(
            f"{job.log_path}: holds no truth; name the result of magfusion smooth with --trajectory"
        )
    return log.truth, job.log_path


def steady(log: Log, site: Site, sampling: Sampling) -> Steady:
    """Return the calibrated steady field of a log in body axes.

    Raises
    ------
    InputError
        Where the log has no waveform, or no stretch of it is long enough.
    """
    if log.waveform is None:
        raise InputError(
            "holds no magnetometer.parquet, in whose steady part the Earth's field is; give the raw"
            " log"
        )
    if sampling.raw and sampling.step is not None:
        raise InputError("--raw takes every sample; leave out --step")
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
    if np.linalg.norm(field_body[weakest]) < LEAST_FIELD:
        raise InputError(
            f"magnetometer: no field at {time[weakest]:.3f} s, where the Earth's is everywhere;"
            " check the instrument and its calibration, or leave that part out by --start and --end"
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
