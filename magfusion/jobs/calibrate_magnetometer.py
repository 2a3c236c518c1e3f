"""The job that calibrates a magnetometer: a log of turning in, a refined site out."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from magfusion.calibration.magnetometer import field_from_measured, spread
from magfusion.calibration.magnetometer_log import LogCalibration, calibrate_log
from magfusion.errors import InputError
from magfusion.job import Job, claim, named, read_job
from magfusion.plots.magnetometer import write_magnetometer_plot
from magfusion.records.samples import Log
from magfusion.report import Figures, write_report
from magfusion.site import Magnetometer, Site
from magfusion.site_file import save_site
from magfusion.units import DEGREE, NANOTESLA, Array

JOB = "calibrate magnetometer"
DETERMINED_RATIO = 0.5  # posterior over prior sigma below which the data, not the prior, spoke
CONTRADICTED = 4.0  # declared sigmas
_AXES = "xyz"


def run_calibrate_magnetometer(job: Job, *, positions: bool = False) -> Figures:
    """Calibrate the magnetometer of a log: refined site, picture and report.

    Parameters
    ----------
    job : Job
        Its log holds inertial samples and the raw waveform.
    positions : bool
        Use only the stops, twelve of them, instead of all the turning.

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError
        For what a user must mend: no waveform, NaN or a wrong unit in it, too few orientations, no
        rest for ``positions``, or ``job.output`` in the way.
    EstimationError
        Where the calibration has no solution.
    """
    claimed = claim(job.output, JOB)
    log, site = read_job(job)
    if log.waveform is None:
        raise InputError(
            f"{job.log_path}: holds no waveform, only phasors, which do not hold the Earth's field;"
            " give the log with magnetometer.parquet"
        )
    with named(job.log_path):
        found = calibrate_log(log.waveform, log.imu, site, at_stops=positions)
    declared = site.platform.magnetometer
    before, after = _fields(found, declared), _fields(found, found.magnetometer)
    size = float(np.linalg.norm(found.prior.field_world))
    figures = _figures(log, found, declared, before, after)
    with claimed as directory:
        save_site(_refined_site(site, found, log.name, figures), directory / "site.yaml")
        _plot(directory / "magnetometer.png", found, before, after, size)
        write_report(directory, figures)
    return figures


def _fields(found: LogCalibration, magnetometer: Magnetometer) -> Array:
    measured = found.readings.measured_sensor
    return field_from_measured(measured, magnetometer.matrix, magnetometer.offset)


def _plot(path: Path, found: LogCalibration, before: Array, after: Array, size: float) -> None:
    write_magnetometer_plot(path, found.readings.time, before, after, size)


def _refined_site(site: Site, found: LogCalibration, log_name: str, figures: Figures) -> Site:
    record = {
        "log": log_name,
        "determined": figures["determined"],
        "undetermined": figures["undetermined"],
    }
    platform = replace(site.platform, magnetometer=found.magnetometer)
    known = site.correlation
    return replace(
        site,
        platform=platform,
        calibration=record,
        correlation=known and known.without(("magnetometer",), ["magnetometer"]),
    )


@dataclass(frozen=True)
class _Told:
    """One parameter before and after, with the name of its figure."""

    name: str
    change: float
    sigma: float
    prior_sigma: float


def _told(found: LogCalibration, declared: Magnetometer) -> list[_Told]:
    fit, prior = found.graph.fit, found.prior
    names = [f"magnetometer.matrix_{row}{column}" for row in _AXES for column in _AXES]
    names += [f"magnetometer.offset_nt_{axis}" for axis in _AXES]
    change = np.concatenate([(fit.matrix - declared.matrix).ravel(), fit.offset - declared.offset])
    sigma, before = (np.sqrt(np.diagonal(cov)) for cov in (fit.cov, prior.cov))
    unit = np.repeat([1.0, NANOTESLA], [9, 3])
    values = zip(names, change / unit, sigma / unit, before / unit, strict=True)
    return [_Told(name, float(c), float(s), float(p)) for name, c, s, p in values]


def _figures(
    log: Log, found: LogCalibration, declared: Magnetometer, before: Array, after: Array
) -> Figures:
    told, graph, readings = _told(found, declared), found.graph, found.readings
    figures: Figures = {
        "job": JOB,
        "log": log.name,
        "readings": len(readings),
        "window_s": float(np.median(readings.window)),
        "spread_before": spread(before),
        "spread_after": spread(after),
        "spread_unseen": found.spread_unseen,
        "field_size_before_t": float(np.mean(np.linalg.norm(before, axis=1))),
        "field_size_after_t": float(np.mean(np.linalg.norm(after, axis=1))),
        "field_noise_t": found.field_sigma,
        "scale_from": "the site's Earth field" if found.scale_known else "the declared matrix",
        "dip_change_deg": graph.dip_change / DEGREE,
        "accel_bias_m_s2_largest": float(np.max(np.abs(graph.accel_bias_body))),
        "gyro_bias_rad_s_largest": float(np.max(np.abs(graph.gyro_bias_body))),
        "field_residual_rms": float(np.sqrt(np.mean(graph.field_residual**2))),
    }
    for parameter in told:
        figures[parameter.name] = parameter.change
        figures[f"{parameter.name}_sigma"] = parameter.sigma
        figures[f"{parameter.name}_prior_sigma"] = parameter.prior_sigma
    settled = {p.name: p.sigma < DETERMINED_RATIO * p.prior_sigma for p in told}
    figures["determined"] = [name for name, yes in settled.items() if yes]
    figures["undetermined"] = [name for name, yes in settled.items() if not yes]
    figures["notes"] = _notes(found, told)
    return figures


def _notes(found: LogCalibration, told: list[_Told]) -> list[str]:
    notes = [f"{sentence[0].upper()}{sentence[1:]}." for sentence in found.missing]
    if not found.scale_known:
        notes.append(
            "The site has no Earth field: the scale of the matrix is the declared one, and only"
            " ratios, angles and offset are found; give earth_field_t or a location."
        )
    if found.shape_kept:
        notes.append(
            "The declared shape and offset leave no more spread than what one half of the log finds"
            " for the other: they were kept, and only the sensor's rotation was taken."
        )
    largest = max(told, key=lambda p: abs(p.change) / p.prior_sigma)
    if abs(largest.change) > CONTRADICTED * largest.prior_sigma:
        notes.append(
            f"{largest.name} changed by {abs(largest.change) / largest.prior_sigma:.0f} of the"
            " site's sigmas; declare larger ones if the sensor was not calibrated before."
        )
    return notes
