"""Motion on a page: its path, its errors or sigmas over time, residuals by beacon."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import numpy as np

from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import StateTrust
from magfusion.results.errors import TrajectoryErrors
from magfusion.results.plots.chart import Chart, ChartBand, ChartLine, ChartMark, svg
from magfusion.units import DEGREE, Array

TIME = "time (s)"
MAX_BEACONS = 24  # with a chart of residuals of their own
_FAR = 3.0  # of the path's size; beyond, a beacon would hide the path
_GAP = 10.0  # times the usual step; a line across it would invent states


@dataclass(frozen=True, eq=False)
class MotionPage:
    """A trajectory with its results; as `magfusion.results.recording.write_recording`.

    `residual` (n,): of each state, RMS over all beacons, where those of each are unknown.
    """

    site: Site
    states: Trajectory
    truth: Trajectory | None = None
    errors: TrajectoryErrors | None = None
    innovations: Mapping[str, tuple[Array, Array]] | None = None
    trust: StateTrust | None = None
    residual: Array | None = None


def path_section(motion: MotionPage) -> str:
    """Return plan and height."""
    _, away = _beacons_near(motion)
    note = f"<p>Outside the plan: {escape(', '.join(away))}.</p>" if away else ""
    return f"{_charts(path_charts(motion))}{note}"


def path_charts(motion: MotionPage) -> list[Chart]:
    """Return plan and height, with the truth where there is one."""
    time, position = motion.states.time, _interrupted(motion.states)
    lines = [ChartLine(position[:, 0], position[:, 1], "estimate")]
    upright = [ChartLine(time, position[:, 2], "estimate")]
    truth = _truth_within(motion)
    if truth is not None:
        path = truth.position_world
        lines.append(ChartLine(path[:, 0], path[:, 1], "truth", "truth"))
        upright.append(ChartLine(truth.time, path[:, 2], "truth", "truth"))
    beacons, _ = _beacons_near(motion)
    first = motion.states.position_world[0]
    start = ChartMark(float(first[0]), float(first[1]), "start", "start")
    plan = Chart("Plan", "x (m)", "y (m)", tuple(lines), marks=(*beacons, start), equal=True)
    bands: tuple[ChartBand, ...] = ()
    high, limits = motion.states.position_world[:, 2], None
    if motion.states.pose_cov is not None:
        sigma, _ = _sigmas(motion.states.pose_cov, motion.states.world_from_body)
        bands = (ChartBand(time, high - 3.0 * sigma[:, 2], high + 3.0 * sigma[:, 2], "3 sigma"),)
        room = 0.05 * float(np.ptp(high)) + 3.3 * _upper_percentile(sigma[:, 2], 95.0) + 1e-3
        limits = (float(high.min()) - room, float(high.max()) + room)
    height = Chart("Height", TIME, "z (m)", tuple(upright), bands, y_limits=limits)
    return [plan, height]


def error_section(motion: MotionPage) -> tuple[str, str]:
    """Return heading and charts of the errors, or of the sigmas where there is no truth."""
    if motion.errors is not None:
        return "Errors against the truth", _charts([*_of_axes(motion.errors), *size_charts(motion)])
    charts = size_charts(motion)
    return ("Estimated accuracy (no truth available)", _charts(charts)) if charts else ("", "")


def residual_section(motion: MotionPage) -> str:
    """Return a chart for each beacon, all with one scale, so that the worst is visible."""
    result = {f"Beacon {name}": rows for name, rows in (motion.innovations or {}).items()}
    if motion.residual is not None:
        result["All beacons together"] = (motion.states.time, motion.residual)
    if not result:
        return ""
    maximum = max(
        3.0, 1.3 * _upper_percentile(np.concatenate([rms for _, rms in result.values()]), 99.5)
    )
    charts = []
    for title, (time, rms) in list(result.items())[:MAX_BEACONS]:
        ends = time[[0, -1]]
        lines = (ChartLine(ends, np.ones(2), "", "expected"), ChartLine(time, rms, "", dots=True))
        charts.append(
            Chart(title, TIME, "residual", lines, y_limits=(0.0, maximum), width=330, height=190)
        )
    remaining = len(result) - len(charts)
    more = f"<p>{remaining} more beacons are in run.rrd.</p>" if remaining else ""
    return (
        "<p>Residuals of the fields, in units of their declared sigma: about 1 (the line) where"
        " noise and model are as declared; values above the frame are drawn at its edge.</p>"
        + _charts(charts)
        + more
    )


def excluded_rows(motion: MotionPage) -> list[tuple[str, int]]:
    """Return the number of states in which each beacon was excluded."""
    counts: dict[str, int] = {}
    for names in () if motion.trust is None else motion.trust.excluded:
        for name in names:
            counts[name] = counts.get(name, 0) + 1
    return [(f"states without beacon {name}, which contradicts", n) for name, n in counts.items()]


def _charts(charts: list[Chart]) -> str:
    return f'<div class="charts">{"".join(map(svg, charts))}</div>' if charts else ""


def _of_axes(errors: TrajectoryErrors) -> list[Chart]:
    """Return the errors by axis with their bands: of position in the world, of attitude in body."""
    position_sigma = attitude_sigma = None
    if errors.pose_cov is not None:
        position_sigma, attitude_sigma = _sigmas(errors.pose_cov, errors.world_from_body)
    size, unit = _unit_of(errors.position_world, position_sigma)
    charts = []
    for k, axis in enumerate("xyz" * errors.has_position):
        title = f"Position, {axis} of the world"
        sigma = None if position_sigma is None else position_sigma[:, k] / size
        charts.append(_error(title, unit, errors.time, errors.position_world[:, k] / size, sigma))
    for k, axis in enumerate("xyz" * errors.has_attitude):
        title = f"Attitude, about {axis} of the body"
        sigma = None if attitude_sigma is None else attitude_sigma[:, k] / DEGREE
        value = errors.attitude_body[:, k] / DEGREE
        charts.append(_error(title, "deg", errors.time, value, sigma))
    return charts


def _error(title: str, unit: str, time: Array, value: Array, sigma: Array | None) -> Chart:
    bands = () if sigma is None else (ChartBand(time, -3.0 * sigma, 3.0 * sigma, "3 sigma"),)
    line = ChartLine(time, value, "error", "error")
    reach = _upper_percentile(np.abs(value), 100.0)
    if sigma is not None:
        reach = max(
            reach, 3.0 * _upper_percentile(sigma, 95.0)
        )  # an open direction's would hide all others
    limits = (-1.1 * reach, 1.1 * reach) if reach > 0.0 else None
    label = f"error ({unit})"
    return Chart(title, TIME, label, (line,), bands, y_limits=limits, width=330, height=200)


def size_charts(motion: MotionPage) -> list[Chart]:
    """Return a chart each of position and attitude: error, three sigma and protection level."""
    states, errors, trust = motion.states, motion.errors, motion.trust
    if states.pose_cov is None:
        return []
    charts = []
    for name, part, unit, size in (
        ("Position", slice(3, 6), "m", 1.0),
        ("Attitude", slice(0, 3), "deg", DEGREE),
    ):
        largest = _largest(states.pose_cov[:, part, part])
        radius = 3.0 * np.sqrt(np.maximum(largest, 0.0)) / size
        lines = [ChartLine(states.time, radius, "3 sigma, worst direction", "sigma")]
        if trust is not None:
            level = trust.protection_level_m if unit == "m" else trust.protection_level_deg
            if np.any(np.isfinite(level)):
                lines.append(ChartLine(states.time, level, "protection level", "level"))
        if errors is not None and np.isfinite(errors.pose_body[:, part]).all():
            result = np.linalg.norm(errors.pose_body[:, part], axis=1) / size
            lines.append(ChartLine(errors.time, result, "error", "error"))
        title = f"{name}: size and bounds"
        charts.append(Chart(title, TIME, unit, tuple(lines), log=True))
    return charts


def _sigmas(pose_cov: Array, world_from_body: Array) -> tuple[Array, Array]:
    """Return sigmas of position in the world and attitude in body axes; NaN where there is none."""
    known = np.isfinite(pose_cov).all(axis=(1, 2), keepdims=True)
    cov = np.where(known, pose_cov, np.nan)
    cov_world = world_from_body @ cov[:, 3:, 3:] @ world_from_body.swapaxes(1, 2)
    parts = (cov_world, cov[:, :3, :3])
    position, attitude = (np.sqrt(np.diagonal(part, axis1=1, axis2=2)) for part in parts)
    return position, attitude


def _largest(cov: Array) -> Array:
    """Return the largest eigenvalue of each covariance; NaN of one that is not finite."""
    out = np.full(len(cov), np.nan)
    known = np.isfinite(cov).all(axis=(1, 2))
    out[known] = np.linalg.eigvalsh(cov[known])[:, -1]
    return out


def _upper_percentile(values: Array, percentile: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percentile)) if len(known) else 0.0


def _unit_of(values: Array, sigma: Array | None) -> tuple[float, str]:
    largest = max(
        _upper_percentile(np.abs(values), 100.0),
        0.0 if sigma is None else 3.0 * _upper_percentile(sigma, 95.0),
    )
    return (1e-3, "mm") if largest < 0.1 else (1.0, "m")


def _truth_within(motion: MotionPage) -> Trajectory | None:
    truth, time = motion.truth, motion.states.time
    if truth is None or not truth.has_position:
        return None
    inside = (truth.time >= time[0]) & (truth.time <= time[-1])
    return truth.rows(inside) if inside.any() else None


def _interrupted(states: Trajectory) -> Array:
    """Return positions, those after a gap as NaN so that no line crosses it."""
    position = states.position_world.copy()
    step = np.diff(states.time)
    if len(step):
        position[1:][step > _GAP * np.median(step)] = np.nan
    return position


def _beacons_near(motion: MotionPage) -> tuple[list[ChartMark], list[str]]:
    """Return the beacons inside the plan, and a note on the others."""
    path = motion.states.position_world[:, :2]
    low, high = path.min(axis=0), path.max(axis=0)
    reach = _FAR * max(float(np.max(high - low)), 3.0)
    shown, away = [], []
    for beacon in motion.site.beacons:
        x, y, z = beacon.position_world.tolist()
        if np.all(np.abs([x, y] - 0.5 * (low + high)) < reach):
            shown.append(ChartMark(x, y, beacon.name))
        else:
            away.append(f"beacon {beacon.name} at ({x:.4g}, {y:.4g}, {z:.4g}) m")
    return shown, away
