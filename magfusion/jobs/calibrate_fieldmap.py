"""The job that maps deviations of the field from the model: survey or log in, site out."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magfusion.calibration.fieldmap import MapFit, MapPoints, learn_field_map, thinned
from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.estimation.graph.same_epoch import SAME_TIME
from magfusion.files.site import load_site, save_site
from magfusion.files.survey import Survey, read_survey
from magfusion.jobs.receiver_axes import three_axes
from magfusion.jobs.settings import Command, Settings, argument, option
from magfusion.model.parameters import initial_calibration
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory, interpolate
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.figures import Figure, Figures, heading
from magfusion.results.verdict import trust_figures

MAX_GAP = 1.0  # s, of the trajectory that is interpolated across
MAX_POINTS = 600  # the posterior takes the cube of their number
UNEXPLAINED = 0.3  # relative error of the mapped field, from which it contradicts the site
WORSE = 1.2  # the same with the map by that without it


@dataclass(frozen=True, kw_only=True)
class MapSettings(Settings):
    """Source of a map's points.

    Poses estimated from the same field contain its error, and are of little use.
    """

    source: Path = argument("Survey (a table, or a directory with one), or a log")
    site: Path | None = option(None, "Site file", note="default: site.yaml with the survey or log")
    trajectory: Path | None = option(
        None, "For a log: poses, best not from this field", note="default: the log's truth"
    )
    spacing: float = option(0.25, "For a log: one point per cube of this edge", unit="m", above=0.0)


def run_calibrate_fieldmap(settings: MapSettings, output: Path, report: Report = quiet) -> Figures:
    """Estimate the field map of a site's beacons; write the site with the map."""
    from magfusion.jobs.result_directory import claim, result_in
    from magfusion.results.plots.fieldmap import write_plot

    claimed = claim(output, "calibrate fieldmap")
    report("reading", 0, 2)
    survey = _survey_path(settings.source)
    if survey is None:
        site, points, extra, streams = _from_log(settings)
    else:
        site, points, extra = _from_survey(settings, survey)
        streams = ()
    if len(points) > MAX_POINTS:
        raise InputError(
            f"{settings.source}: gives {len(points)} points; a map has at most {MAX_POINTS};"
            " choose a larger --spacing"
        )
    report("learning", 1, 2)
    try:
        fit = learn_field_map(site, points)
    except EstimationError as error:
        raise InputError(f"{settings.source}: {error}") from error
    report("done", 2, 2)
    trust = judge_map(fit, streams)
    figures = heading("calibrate fieldmap", settings.source.stem) | trust_figures(trust)
    figures |= Figures(Figure("points", len(points))) | _figures(fit) | extra
    with result_in(claimed, figures, trust, settings.source, output) as directory:
        save_site(fit.site, directory / "site.yaml")
        write_plot(directory / "field_map.png", fit)
    return figures


def judge_map(fit: MapFit, streams: tuple[Finding, ...] = ()) -> Trust:
    """Return whether a map is valid at points not used in it.

    `streams`: of the log that the points come from.
    """
    result = []
    for beacon, error in fit.error_with.items():
        without = fit.error_without[beacon]
        findings = (
            f"Beacon {beacon}: at left-out points the field error with the map is"
            f" {100.0 * error:.2g} %, without it {100.0 * without:.2g} %"
        )
        if error > UNEXPLAINED:
            text = f"{findings}: check that the survey is of this site, and its frame and units."
            result.append(Finding("transfer", text, Verdict.FAILED, error / UNEXPLAINED))
        elif error > WORSE * without:
            text = f"{findings}: survey more densely, or omit the map."
            result.append(Finding("transfer", text, weight=error / without))
    return Trust((*result, *streams))


def _survey_path(path: Path) -> Path | None:
    if path.is_dir():
        inside = path / "survey.parquet"
        return inside if inside.is_file() else None
    return path if path.suffix in (".parquet", ".csv") else None


def _from_survey(settings: MapSettings, path: Path) -> tuple[Site, MapPoints, Figures]:
    if settings.trajectory is not None:
        raise InputError(f"{path}: a survey has its own poses; omit --trajectory")
    others = path.parent / "site.yaml"
    site_path = others if settings.site is None else settings.site
    if settings.site is None and not others.is_file():
        raise InputError(f"{path}: has no site.yaml next to it; give it with --site SITE.yaml")
    site = three_axes(load_site(site_path), site_path)
    return site, points_of(read_survey(path), site, path), Figures()


def points_of(survey: Survey, site: Site, path: Path) -> MapPoints:
    """Return a survey's points with the channels in the site's order.

    Raises InputError where the survey has amplitudes only, or channels that are not in the site.
    """
    if survey.phasor_sensor is None:
        raise InputError(f"{path}: has amplitudes, but a field map requires phasors; survey again")
    for beacon, tone in survey.channels:
        if (beacon, tone) not in site.channels:
            known = ", ".join(b.name for b in site.beacons)
            raise InputError(
                f"{path}: tone {tone} of beacon {beacon} is not in the site (it has {known}); give"
                " the site of the survey"
            )
    shape = (len(survey), len(site.channels))
    phasor = np.full((*shape, 3), np.nan + 0j)
    sigma = np.full(shape, np.nan)
    for c, channel in enumerate(survey.channels):
        phasor[:, site.channels.index(channel)] = survey.phasor_sensor[:, c]
        sigma[:, site.channels.index(channel)] = survey.sigma[:, c]
    return MapPoints(survey.world_from_body, survey.position_world, phasor, sigma)


def _from_log(settings: MapSettings) -> tuple[Site, MapPoints, Figures, tuple[Finding, ...]]:
    from magfusion.jobs.inputs import Job, known_poses, named, read_job
    from magfusion.results.report import dropped_figures

    site_path, result = settings.site, settings.trajectory
    if site_path is None and result is not None and (result / "site.yaml").is_file():
        site_path = result / "site.yaml"
    log, site = read_job(Job(settings.source, site_path, Path()))
    poses, log = known_poses(log, settings.source, result)
    with named(settings.source):
        samples, dropped = _samples(log, site, poses)
    there, exists = interpolate(poses, samples.time, MAX_GAP)
    if not np.any(exists):
        raise InputError(f"{settings.source}: the trajectory and the log do not overlap in time")
    sigma = np.sqrt(np.trace(samples.phasor_cov[exists], axis1=2, axis2=3) / 3.0)
    points = MapPoints(
        there.world_from_body, there.position_world, samples.phasor_sensor[exists], sigma
    )
    streams = recorded(log, site, BRIDGED_CODES)
    return site, thinned(points, site, settings.spacing), dropped_figures(dropped), streams


def _samples(log: Log, site: Site, poses: Trajectory) -> tuple[FieldSamples, dict[str, int]]:
    """Return phasors, corrected for motion in each window where the poses are the log's own."""
    from magfusion.estimation.demodulation.demodulation import demodulated

    source = demodulated(log, site, None)
    calibration = initial_calibration(site, 0.0)
    samples = source.fields
    whole = poses.velocity_world is not None and poses.gyro_bias_body is not None
    same = len(poses) == len(samples) and np.all(np.abs(poses.time - samples.time) < SAME_TIME)
    if log.waveform is not None and whole and same:
        samples = source.compensated(calibration, poses).fields
    return samples, dict(source.dropped)


def _figures(fit: MapFit) -> Figures:
    result = fit.site.beacons[0].field_map
    assert result is not None
    by_beacon: list[tuple[str, str, Mapping[str, float]]] = [
        ("points", "points", fit.points),
        ("relative_error_without", "relative error without the map", fit.error_without),
        ("relative_error_with", "relative error with the map", fit.error_with),
    ]
    return Figures(
        Figure("length_scale_m", result.length_scale, "m"),
        Figure("gain_sigma", result.gain_sigma),
        Figure("rotation_sigma_deg", float(np.rad2deg(result.rotation_sigma)), "deg"),
        Figure("residual", result.residual),
        *(
            Figure(f"{name}_{{beacon}}", values[beacon], "", beacon, label=label)
            for name, label, values in by_beacon
            for beacon in fit.points
        ),
    )


COMMAND = Command(
    MapSettings,
    run_calibrate_fieldmap,
    output="field_map",
    example="magfusion calibrate fieldmap survey --site site.yaml -o mapped",
)
