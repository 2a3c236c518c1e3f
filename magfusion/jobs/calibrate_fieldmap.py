"""The job that learns where the field is not what the model says: survey or log in, site out."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magfusion.calibration.fieldmap import MapFit, MapPoints, learn_field_map, thinned
from magfusion.errors import EstimationError, InputError
from magfusion.fusion.source import open_source
from magfusion.job import Job, claim, named, read_estimate, read_job
from magfusion.parameters import initial_calibration
from magfusion.plots.fieldmap import write_plot
from magfusion.records.samples import FieldSamples, Log
from magfusion.records.survey import Survey, read_survey
from magfusion.report import Figures, dropped_figures, write_report
from magfusion.site import Site
from magfusion.site_file import load_site, save_site
from magfusion.trajectory import Trajectory, interpolate

LONGEST_GAP = 1.0  # s, of the trajectory that is interpolated across
SAME_TIME = 1e-6  # s
MOST_POINTS = 600  # the posterior takes the cube of their number
Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class MapSource:
    """Where the points of a map come from.

    Parameters
    ----------
    path : Path
        A survey (Parquet, CSV, or a directory with survey.parquet), or a log.
    site_path : Path, optional
        None takes ``site.yaml`` of the trajectory's directory, then that of ``path``.
    trajectory_path : Path, optional
        Of a log: the result of a job, or a table; None takes the log's truth.  Poses that were
        found by the same field have taken up its error, and teach little of it.
    spacing : float
        One epoch of a log for each cube of this edge (m).
    """

    path: Path
    site_path: Path | None = None
    trajectory_path: Path | None = None
    spacing: float = 0.25


def run_calibrate_fieldmap(source: MapSource, output: Path, *, report: Report) -> Figures:
    """Learn the field map of a site's beacons; write the site that carries it.

    Returns
    -------
    dict
        The figures of ``report.json``.

    Raises
    ------
    InputError
    """
    claimed = claim(output, "calibrate fieldmap")
    if not 0.0 < source.spacing < np.inf:
        raise InputError(f"--spacing must be above 0 m; got {source.spacing:g}")
    report("reading", 0, 2)
    survey = _survey_path(source.path)
    if survey is None:
        site, points, extra = _from_log(source)
    else:
        site, points, extra = _from_survey(source, survey)
    if len(points) > MOST_POINTS:
        raise InputError(
            f"{source.path}: gives {len(points)} points where a map takes {MOST_POINTS};"
            " choose a larger --spacing"
        )
    report("learning", 1, 2)
    try:
        fit = learn_field_map(site, points)
    except EstimationError as error:
        raise InputError(f"{source.path}: {error}") from error
    report("done", 2, 2)
    figures: Figures = {"job": "calibrate fieldmap", "log": source.path.stem, "points": len(points)}
    figures |= _figures(fit) | extra
    with claimed as directory:
        save_site(fit.site, directory / "site.yaml")
        write_plot(directory / "field_map.png", fit)
        write_report(directory, figures)
    return figures


def _survey_path(path: Path) -> Path | None:
    if path.is_dir():
        inside = path / "survey.parquet"
        return inside if inside.is_file() else None
    return path if path.suffix in (".parquet", ".csv") else None


def _from_survey(source: MapSource, path: Path) -> tuple[Site, MapPoints, Figures]:
    if source.trajectory_path is not None:
        raise InputError(f"{path}: a survey has its own poses; leave --trajectory out")
    beside = path.parent / "site.yaml"
    site_path = beside if source.site_path is None else source.site_path
    if source.site_path is None and not beside.is_file():
        raise InputError(f"{path}: has no site.yaml beside it; name the site with --site SITE.yaml")
    site = load_site(site_path)
    return site, points_of(read_survey(path), site, path), {}


def points_of(survey: Survey, site: Site, path: Path) -> MapPoints:
    """Return a survey's points with the channels in the site's order.

    Raises
    ------
    InputError
        Where the survey holds amplitudes only, or channels that the site does not have.
    """
    if survey.phasor_sensor is None:
        raise InputError(f"{path}: holds amplitudes, and a field map needs phasors; survey again")
    for beacon, tone in survey.channels:
        if (beacon, tone) not in site.channels:
            known = ", ".join(b.name for b in site.beacons)
            raise InputError(
                f"{path}: tone {tone} of beacon {beacon} is unknown to the site (it has {known});"
                " give the site that was surveyed"
            )
    shape = (len(survey), len(site.channels))
    phasor = np.full((*shape, 3), np.nan + 0j)
    sigma = np.full(shape, np.nan)
    for c, channel in enumerate(survey.channels):
        phasor[:, site.channels.index(channel)] = survey.phasor_sensor[:, c]
        sigma[:, site.channels.index(channel)] = survey.sigma[:, c]
    return MapPoints(survey.world_from_body, survey.position_world, phasor, sigma)


def _from_log(source: MapSource) -> tuple[Site, MapPoints, Figures]:
    site_path, result = source.site_path, source.trajectory_path
    if site_path is None and result is not None and (result / "site.yaml").is_file():
        site_path = result / "site.yaml"
    log, site = read_job(Job(source.path, site_path, Path()))
    if result is None and log.truth is None:
        raise InputError(
            f"{source.path}: holds no truth; smooth it and name the result with --trajectory RUN"
        )
    poses = log.truth if result is None else read_estimate(result, log.epoch_ns)
    assert poses is not None
    with named(source.path):
        samples, dropped = _samples(log, site, poses)
    there, exists = interpolate(poses, samples.time, LONGEST_GAP)
    if not np.any(exists):
        raise InputError(f"{source.path}: the trajectory and the log do not overlap in time")
    sigma = np.sqrt(np.trace(samples.phasor_cov[exists], axis1=2, axis2=3) / 3.0)
    points = MapPoints(
        there.world_from_body, there.position_world, samples.phasor_sensor[exists], sigma
    )
    return site, thinned(points, site, source.spacing), dropped_figures(dropped)


def _samples(log: Log, site: Site, poses: Trajectory) -> tuple[FieldSamples, dict[str, int]]:
    """Return phasors; with the motion in each window taken off where the poses are its own."""
    source = open_source(log, site, None)
    calibration = initial_calibration(site, 0.0)
    samples = source.first(calibration)
    whole = poses.velocity_world is not None and poses.gyro_bias_body is not None
    same = len(poses) == len(samples) and np.all(np.abs(poses.time - samples.time) < SAME_TIME)
    if log.waveform is not None and whole and same:
        samples = source.about(calibration, poses).fields
    return samples, dict(source.dropped)


def _figures(fit: MapFit) -> Figures:
    found = fit.site.beacons[0].field_map
    assert found is not None
    figures: Figures = {
        "length_scale_m": found.length_scale,
        "gain_sigma": found.gain_sigma,
        "rotation_sigma_deg": float(np.rad2deg(found.rotation_sigma)),
        "residual": found.residual,
    }
    for name in fit.points:
        figures[f"points_{name}"] = fit.points[name]
        figures[f"relative_error_without_{name}"] = fit.error_without[name]
        figures[f"relative_error_with_{name}"] = fit.error_with[name]
    return figures
