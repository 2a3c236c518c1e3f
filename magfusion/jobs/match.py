"""The job that estimates attitudes from the Earth's field: a log in, a table of angles out."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.attitude_table import read_database, write_attitudes
from magfusion.jobs.attitude_database import TABLE, Sampling, Steady, steady
from magfusion.jobs.match_trust import judge_matches
from magfusion.jobs.settings import Command, LogSettings, option
from magfusion.model.physics.earth import earth_field_world
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.strapdown import resting
from magfusion.model.trajectory import Trajectory
from magfusion.model.truth_poses import truth_poses
from magfusion.papers.p001_magnetometer.matching import (
    THREE_ANGLES,
    Matches,
    match_roll,
    match_roll_pitch,
    match_with_gravity,
    wrap,
)
from magfusion.papers.p001_magnetometer.matching_database import (
    angles_about,
    match_interpolated,
    match_nearest,
    prepare,
)
from magfusion.results.figures import ErrorColumn, Figure, Figures, Section, heading
from magfusion.results.verdict import trust_figures
from magfusion.units import DEGREE, Array, BoolArray

if TYPE_CHECKING:
    from magfusion.jobs.inputs import Job


Method = Literal["nearest", "interpolated", "closed-form"]
_NAMES = ("roll", "pitch", "yaw")
_BY = " (--yaw-deg; --gravity; magfusion smooth)"


@dataclass(frozen=True, kw_only=True)
class MatchSettings(LogSettings, Sampling):
    """Method and known angles of the attitude match."""

    database: Path | None = option(
        None,
        "Result of calibrate attitude-database",
        note="default: the site's Earth field, as exact",
    )
    method: Method | None = option(
        None, "Method", note="default: interpolated in the database; the closed form without one"
    )
    angles: Literal["roll", "roll-pitch", "roll-pitch-yaw"] | None = option(
        None, "Angles to estimate", note="default: all that can be determined"
    )
    yaw_deg: float | None = option(None, "Known yaw of the platform", unit="degrees")
    pitch_deg: float | None = option(None, "Known pitch", unit="degrees")
    gravity: bool = option(False, "Estimate all three angles, with the accelerometer, at rest")


class _Matched(NamedTuple):
    matches: Matches
    method: str
    angles: tuple[int, ...]  # found, of roll, pitch, yaw


def run_match(settings: MatchSettings, output: Path) -> Figures:
    """Estimate the attitude of every epoch from the Earth's field: table, picture and report."""
    from magfusion.jobs.inputs import named, read_job, require_imu
    from magfusion.jobs.result_directory import claim, result_in
    from magfusion.results.plots.match import write_match_plot

    _check(settings)
    job, claimed = settings.job(output), claim(output, "match")
    log, site = read_job(job, without=True)
    if settings.gravity:
        require_imu(job, log, "gravity requires the accelerometer")
    with named(job.log_path):
        selected = steady(log, site, settings)
    result = _match(job, log, site, selected, settings)
    known = None if settings.database is not None else _earth_field(job, site)
    matches, trust = judge_matches(result.matches, result.angles, known, selected, site, log)
    result = result._replace(matches=matches)
    first = result.matches.determined[:, 0]
    figures = [
        Figure("method", result.method),
        Figure("angles", "-".join(_NAMES[k] for k in result.angles)),
        Figure("epochs", len(selected.time)),
        Figure("epochs_with_two_pitches", int(np.sum(result.matches.ambiguous))),
        Figure("epochs_not_determined", int(np.sum(~first))),
        Figure("window_s", selected.length, "s"),
    ]
    for k in range(3):
        if k not in result.angles:
            given = float(result.matches.rpy[0, 0, k] / DEGREE)
            figures.append(Figure(f"given_{_NAMES[k]}_deg", given, "deg"))
        elif np.any(first):
            sigma = float(np.median(result.matches.sigma[first, 0, k])) / DEGREE
            figures.append(Figure(f"{_NAMES[k]}_sigma_median_deg", sigma, "deg"))
    true_rpy, compared = _compared(log, selected.time, result)
    shown = heading("match", log.name) | trust_figures(trust) | Figures(*figures) | compared
    with result_in(claimed, shown, trust, job.log_path, output) as directory:
        parts = (result.matches.rpy, result.matches.sigma, result.matches.residual)
        path = directory / "attitude.parquet"
        write_attitudes(path, log.epoch_ns, selected.time, *parts, result.matches.determined)
        picture = directory / "attitude.png"
        write_match_plot(picture, selected.time, result.matches, result.angles, true_rpy)
    return shown


def _check(settings: MatchSettings) -> None:
    """Reject incompatible options, and more angles than the vectors determine."""
    if settings.gravity:
        _check_gravity(settings)
        return
    if settings.angles == "roll-pitch-yaw":
        raise InputError(f"--angles roll-pitch-yaw: {THREE_ANGLES}{_BY}")
    if settings.database is None:
        _check_given(settings)
    elif settings.pitch_deg is not None or settings.yaw_deg is not None:
        raise InputError(
            "--pitch-deg and --yaw-deg are those of the database; give them without --database"
        )


def _check_gravity(settings: MatchSettings) -> None:
    if settings.angles not in (None, "roll-pitch-yaw") or _given(settings):
        raise InputError(
            "--gravity determines all three angles; omit --angles, --pitch-deg, --yaw-deg,"
            " --database and --method"
        )
    if settings.raw:
        raise InputError("--gravity requires the specific force of each epoch; omit --raw")


def _check_given(settings: MatchSettings) -> None:
    for name, value, limit in (
        ("--pitch-deg", settings.pitch_deg, 90.0),
        ("--yaw-deg", settings.yaw_deg, 360.0),
    ):
        if value is not None and not abs(value) <= limit:
            raise InputError(f"{name} must lie within {limit:g} degrees of zero; got {value:g}")
    if settings.method not in (None, "closed-form"):
        raise InputError(f"--method {settings.method} requires a database; give it with --database")
    if settings.yaw_deg is None:
        raise InputError(f"without a database {THREE_ANGLES}{_BY}")
    requested = "roll-pitch" if settings.pitch_deg is None else "roll"
    if settings.angles not in (None, requested):
        raise InputError(
            "--angles roll requires --pitch-deg and --yaw-deg; --angles roll-pitch takes no"
            " --pitch-deg"
        )


def _given(settings: MatchSettings) -> bool:
    values = (settings.pitch_deg, settings.yaw_deg, settings.database, settings.method)
    return any(value is not None for value in values)


def _match(job: Job, log: Log, site: Site, selected: Steady, settings: MatchSettings) -> _Matched:
    from magfusion.jobs.inputs import named

    if settings.database is not None:
        return _by_database(settings.database, selected, settings)
    field_world = _earth_field(job, site)
    with named(job.log_path):
        if settings.gravity:
            assert selected.force_body is not None
            bias = site.platform.imu.accel_bias_sigma
            force_sigma = float(np.hypot(selected.force_sigma, bias))
            vectors = (selected.field_body, selected.force_body, field_world, site.gravity)
            matches = match_with_gravity(*vectors, selected.sigma, force_sigma)
            matches.determined[:, 0] &= _resting(log, site, selected.time)
            return _Matched(matches, "gravity", (0, 1, 2))
        assert settings.yaw_deg is not None
        yaw = float(wrap(np.asarray(settings.yaw_deg * DEGREE)))
        if settings.pitch_deg is None:
            matches = match_roll_pitch(selected.field_body, yaw, field_world, selected.sigma)
            return _Matched(matches, "closed-form", (0, 1))
        pitch = settings.pitch_deg * DEGREE
        matches = match_roll(selected.field_body, pitch, yaw, field_world, selected.sigma)
        return _Matched(matches, "closed-form", (0,))


def _resting(log: Log, site: Site, time: Array) -> BoolArray:
    """Return at which times the platform is at rest: otherwise its acceleration acts as gravity."""
    stamps = log.imu.time + site.platform.imu.time_offset
    still = resting(stamps, log.imu.gyro_body, log.imu.accel_body, motion=site.platform.motion)
    return still[np.minimum(np.searchsorted(stamps, time), len(stamps) - 1)]


def _by_database(place: Path, selected: Steady, settings: MatchSettings) -> _Matched:
    from magfusion.jobs.inputs import named

    path = place / TABLE if place.is_dir() else place
    database = read_database(path)
    if settings.angles not in (None, database.angles):
        raise InputError(
            f"--angles {settings.angles}: {path} has {database.angles}; build another with"
            " magfusion calibrate attitude-database"
        )
    with named(path):
        index = prepare(database)
    result = (0,) if database.angles == "roll" else (0, 1)
    method: Method = settings.method or "interpolated"
    if method == "nearest":
        return _Matched(match_nearest(index, selected.field_body, selected.sigma), method, result)
    if method == "interpolated":
        return _Matched(
            match_interpolated(index, selected.field_body, selected.sigma), method, result
        )
    _, pitch, yaw = database.rpy[0]
    known = (index.field_world, float(np.hypot(selected.sigma, index.sigma)))
    if database.angles == "roll":
        return _Matched(match_roll(selected.field_body, pitch, yaw, *known), method, result)
    matches = match_roll_pitch(selected.field_body, yaw, *known, side=index.side)
    return _Matched(matches, method, result)


def _earth_field(job: Job, site: Site) -> Array:
    if site.earth_field_world is not None:
        return site.earth_field_world
    place = site.location
    if place is None:
        name = job.log_path / "site.yaml" if job.site_path is None else job.site_path
        raise InputError(
            f"{name}: gives no Earth field; add world.earth_field_t or world.location, or give a"
            " database with --database"
        )
    day = datetime.date.fromisoformat(place.date)
    return earth_field_world(place.latitude_deg, place.longitude_deg, place.height_m, day)


def _compared(log: Log, time: Array, result: _Matched) -> tuple[Array | None, Figures]:
    """Return the true angles (NaN where there are none) and the errors against them."""
    if log.truth is None or not log.truth.has_attitude:
        return None, Figures()
    poses, exists, _ = truth_poses(log.truth, time)
    used = exists & result.matches.determined[:, 0]
    if not np.any(used):
        reason = "the truth covers no epoch whose attitude is determined"
        note = f"There is no comparison with the truth: {reason}"
        return None, Figures(Figure("not_compared", reason, section=Section.REPORT, note=note))
    rpy = result.matches.rpy
    true_rpy = np.full((len(time), 3), np.nan)
    true_rpy[exists] = _true_angles(poses.world_from_body, rpy[0, 0], result.angles)
    figures = [Figure("compared_epochs", int(np.sum(used)))]
    for k in result.angles:
        either = np.abs(wrap(rpy[..., k] - true_rpy[:, None, k]))[used] / DEGREE
        rms = float(np.sqrt(np.mean(either[:, 0] ** 2)))
        figures += [
            Figure(f"{_NAMES[k]}_rms_deg", rms, "deg"),
            Figure(f"{_NAMES[k]}_max_deg", float(np.max(either[:, 0])), "deg"),
        ]
    if result.matches.ambiguous[used].any():
        worst = np.max(np.abs(wrap(rpy - true_rpy[:, None]))[used], axis=2)
        nearer = float(np.nanmin(worst, axis=1).max() / DEGREE)
        figures.append(Figure("max_of_nearer_solution_deg", nearer, "deg"))
    return true_rpy, Figures(*figures, _whole_attitude(poses, rpy[exists, 0], used[exists]))


def _whole_attitude(poses: Trajectory, rpy: Array, used: BoolArray) -> Figure:
    """Return the error of the attitude with the given angles, and of these angles."""
    true = Rotation.from_matrix(poses.world_from_body[used])
    turn = true.inv() * Rotation.from_euler("xyz", rpy[used])
    rms = float(np.sqrt(np.mean(turn.magnitude() ** 2)) / DEGREE)
    return Figure(
        "attitude_rmse_deg", rms, "deg", None, Section.ERRORS, "attitude", ErrorColumn.RMS
    )


def _true_angles(world_from_body: Array, given: Array, angles: tuple[int, ...]) -> Array:
    """Return the true values of the given angles."""
    if 2 in angles:
        heading = np.arctan2(world_from_body[:, 1, 0], world_from_body[:, 0, 0])
        return angles_about(world_from_body, heading)
    return angles_about(world_from_body, float(given[2]), None if 1 in angles else float(given[1]))


COMMAND = Command(MatchSettings, run_match, example="magfusion match log --yaw-deg 30 -o matched")
