"""The job that makes a fingerprint survey: a log and its poses in, a survey out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.data_checks.data_quality import passed_on
from magfusion.files.survey import Survey, write_survey
from magfusion.jobs.settings import Command, LogSettings, WindowSettings, option
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.strapdown import resting
from magfusion.model.trajectory import Trajectory, interpolate
from magfusion.results.figures import Figure, Figures, heading
from magfusion.results.verdict import trust_figures
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

if TYPE_CHECKING:
    pass


Points = Literal["rests", "epochs"]
MAX_GAP = 1.0  # s; of the poses, across which they are interpolated
STILL = 0.02  # m; within a stop, by the poses: at constant speed the IMU feels as if at rest
GAP = 1.5  # of the distance of two windows, beyond which they belong to two stops


@dataclass(frozen=True, kw_only=True)
class SurveySettings(LogSettings, WindowSettings):
    """Selection of survey points; of points too close to each other, the first."""

    trajectory: Path | None = option(
        None, "Result, TUM file or table with the poses", note="default: the log's truth"
    )
    points: Points = option("rests", "One point a stop, or one an epoch")
    spacing: float = option(0.0, "Minimum distance of two points", unit="m", least=0.0)


class _Point(NamedTuple):
    position_world: Array
    world_from_body: Array
    phasor: ComplexArray  # (channels, 3); NaN where a channel is missing
    sigma: Array  # (channels,)


def run_survey(settings: SurveySettings, output: Path) -> Figures:
    """Make a survey of the fields at known poses: table, picture and report."""
    from magfusion.estimation.demodulation.demodulation import fix_inputs, phasors
    from magfusion.jobs.inputs import known_poses, named, read_job
    from magfusion.jobs.result_directory import claim
    from magfusion.results.plots.survey import write_survey_plot
    from magfusion.results.report import dropped_figures, write_report

    job, claimed = settings.job(output), claim(output, "survey")
    lockin = settings.lockin(job)
    log, site = read_job(job)
    poses, log = known_poses(log, job.log_path, settings.trajectory)
    with named(job.log_path):
        slots, windows_dropped = phasors(log, site, lockin)
    samples, _ = fix_inputs(slots, log, site)  # of coils driven in turn whole cycles
    survey, dropped = make_survey(
        samples, poses, log, site, points=settings.points, spacing=settings.spacing
    )
    if len(survey) == 0:
        reasons = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
        raise InputError(
            f"{job.log_path}: none of its {len(samples)} epochs can be a point of a survey"
            f" ({reasons}); rest at known places, or use moving epochs with --points epochs"
        )
    figures = _figures(log, site, survey, dropped) | dropped_figures(windows_dropped)
    with claimed as directory:
        write_survey(survey, directory / "survey.parquet")
        write_survey_plot(directory / "survey.png", site, survey)
        write_report(directory, figures)
    return figures


def make_survey(
    samples: FieldSamples,
    poses: Trajectory,
    log: Log,
    site: Site,
    *,
    points: Points = "rests",
    spacing: float = 0.0,
) -> tuple[Survey, dict[str, int]]:
    """Return the survey, and the number of dropped epochs for each reason.

    A stop's phasors are averaged with the pose over its windows; those of an unsynchronised beacon
    are first rotated to one drive phase, which drifts.  ``sigma`` counts overlapping windows once.
    """
    known, exists = interpolate(poses, samples.time, MAX_GAP)
    detected = samples.valid.any(axis=1)
    still = np.ones(len(samples), dtype=bool)
    if points == "rests":
        still = (
            _is_stationary(samples, log, site)
            if log.inertial
            else _is_stationary_pose(samples, poses)
        )
    used = np.flatnonzero(exists & detected & still)
    dropped = {
        "outside the trajectory": int(np.sum(~exists)),
        "no beacon detected": int(np.sum(exists & ~detected)),
        "moving": int(np.sum(exists & detected & ~still)),
    }
    at = np.searchsorted(np.flatnonzero(exists), used)
    position, attitude = known.position_world[at], known.world_from_body[at]
    stop = np.arange(len(used))
    if points == "rests":
        stop = _stops(samples.time[used], position)
    result = [
        _mean(samples, site, used[stop == s], position[stop == s], attitude[stop == s])
        for s in range(int(np.max(stop, initial=-1)) + 1)
    ]
    kept = _spaced(np.array([p.position_world for p in result]).reshape(-1, 3), spacing)
    dropped["too close to another point"] = int(np.sum(~np.isin(stop, kept)))
    chosen = [result[k] for k in kept]
    shape = (len(chosen), len(samples.channels))
    survey = Survey(
        point=np.arange(len(chosen)),
        position_world=np.array([p.position_world for p in chosen]).reshape(-1, 3),
        world_from_body=np.array([p.world_from_body for p in chosen]).reshape(-1, 3, 3),
        channels=samples.channels,
        sigma=np.array([p.sigma for p in chosen]).reshape(shape),
        phasor_sensor=np.array([p.phasor for p in chosen], complex).reshape(*shape, 3),
    )
    return survey, {reason: number for reason, number in dropped.items() if number}


def _is_stationary(samples: FieldSamples, log: Log, site: Site) -> BoolArray:
    """Return during which windows every inertial sample is at rest."""
    time = log.imu.time + site.platform.imu.time_offset
    motion = site.platform.motion
    moving = ~resting(time, log.imu.gyro_body, log.imu.accel_body, motion=motion)
    total = np.concatenate([[0], np.cumsum(moving)])
    half = samples.window / 2.0
    first = np.searchsorted(time, samples.time - half)
    last = np.searchsorted(time, samples.time + half, side="right")
    return np.asarray((last > first) & (total[last] == total[first]))


def _is_stationary_pose(samples: FieldSamples, poses: Trajectory) -> BoolArray:
    """Return during which windows the known poses stay within `STILL`, without an IMU."""
    still = np.ones(len(samples), dtype=bool)
    ends = []
    for sign in (-0.5, 0.5):
        there, exists = interpolate(poses, samples.time + sign * samples.window, MAX_GAP)
        position = np.full((len(samples), 3), np.nan)
        position[exists] = there.position_world
        ends.append(position)
        still &= exists
    moved = np.linalg.norm(ends[1] - ends[0], axis=1)
    return np.asarray(still & (moved < STILL))


def _stops(time: Array, position: Array) -> IntArray:
    """Return the index of the stop of each window at rest, from 0 in time."""
    number = np.zeros(len(time), dtype=np.int64)
    usual = np.median(np.diff(time)) if len(time) > 1 else 0.0
    first = 0
    for i in range(1, len(time)):
        moved = np.linalg.norm(position[i] - position[first]) > STILL
        new = moved or time[i] - time[i - 1] > GAP * usual
        first = i if new else first
        number[i] = number[i - 1] + new
    return number


def _mean(
    samples: FieldSamples, site: Site, rows: IntArray, position: Array, attitude: Array
) -> _Point:
    """Return the mean of the windows of one stop."""
    valid = samples.valid[rows]
    phasor = np.where(valid[..., None], samples.phasor_sensor[rows], 0.0)
    free_parameters = [not b.synchronised for b in site.beacons for _ in b.tones]
    first = np.take_along_axis(phasor, np.argmax(valid, axis=0)[None, :, None], axis=0)
    lag = np.angle(np.sum(np.conj(first) * phasor, axis=-1))
    phasor = phasor * np.exp(-1j * np.where(free_parameters, lag, 0.0))[..., None]
    count = np.sum(valid, axis=0)
    share = np.where(count > 0, 1.0 / np.maximum(count, 1), np.nan)
    variance = np.trace(samples.phasor_cov[rows], axis1=2, axis2=3) / 3.0
    variance = share * np.sum(np.where(valid, variance, 0.0), axis=0)
    independent = np.minimum(_independent_windows(samples, rows), np.maximum(count, 1))
    return _Point(
        position_world=np.mean(position, axis=0),
        world_from_body=Rotation.from_matrix(attitude).mean().as_matrix(),
        phasor=share[:, None] * np.sum(phasor, axis=0),
        sigma=np.sqrt(variance / independent),
    )


def _independent_windows(samples: FieldSamples, rows: IntArray) -> float:
    """Return the number of non-overlapping windows in a stop."""
    time, window = samples.time[rows], samples.window[rows]
    return float((time[-1] - time[0]) / np.median(window)) + 1.0


def _spaced(position: Array, spacing: float) -> IntArray:
    """Return the points, in order, without those closer to an earlier one than the spacing."""
    if spacing == 0.0 or len(position) == 0:
        return np.arange(len(position))
    keep = np.ones(len(position), dtype=bool)
    near = KDTree(position).query_pairs(spacing * (1.0 - 1e-9), output_type="ndarray")
    for i, j in near[np.lexsort((near[:, 1], near[:, 0]))]:
        if keep[i]:
            keep[j] = False
    return np.flatnonzero(keep)


def _figures(log: Log, site: Site, survey: Survey, dropped: dict[str, int]) -> Figures:
    from magfusion.results.report import dropped_figures

    detected = np.isfinite(survey.sigma)
    own = np.array([name for name, _ in survey.channels])
    by_beacon = {b.name: detected[:, own == b.name].any(axis=1) for b in site.beacons}
    beacons = np.sum(list(by_beacon.values()), axis=0)
    figures = (
        heading("survey", log.name)
        | trust_figures(passed_on(log, site))
        | Figures(
            Figure("points", len(survey)),
            Figure(
                "beacons_per_point_least", int(np.min(beacons)), label="beacons per point, least"
            ),
            Figure(
                "beacons_per_point_mean", float(np.mean(beacons)), label="beacons per point, mean"
            ),
            *(
                Figure(
                    "points_hearing_{beacon}",
                    int(np.sum(own)),
                    "",
                    name,
                    label="points in range of",
                )
                for name, own in by_beacon.items()
            ),
            Figure("noise_of_a_phasor_t", float(np.nanmedian(survey.sigma)), "T"),
        )
    )
    return figures | dropped_figures(dropped, "epochs")


COMMAND = Command(
    SurveySettings, run_survey, example="magfusion survey log --points epochs -o survey"
)
