"""Recordings for the rerun viewer: the scene in three dimensions beside the error plots."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.shapes import Scale, beads, coil_loop, coverage_shell, ellipsoids, scene_scale
from magfusion.site import Site
from magfusion.trajectory import Trajectory
from magfusion.units import Array, IntArray

TIMELINE = "time"  # seconds since the log's epoch
MAX_ROWS = 5000  # of each series: more than a screen can show
ELLIPSOIDS = 30  # along the path
COVERAGE = 1e-6  # T, RMS, on the shell drawn around a beacon

_ESTIMATE = (70, 170, 255)
_TRUTH = (110, 220, 120)
_SIGMA = (150, 150, 160)
_AXES = {"x": (235, 85, 85), "y": (90, 200, 90), "z": (95, 145, 255)}
_BEACONS = ((240, 165, 30), (205, 115, 220), (245, 100, 60), (240, 228, 66), (30, 190, 165))


class Errors(Protocol):
    """What is drawn of a trajectory's errors; `TrajectoryErrors` has it all."""

    @property
    def time(self) -> Array:
        """Seconds since the log's epoch, shape (n,)."""

    @property
    def position_world(self) -> Array:
        """Estimate minus truth (m), shape (n, 3)."""

    @property
    def attitude_body(self) -> Array:
        """Rotation vector from truth to estimate (rad), shape (n, 3)."""

    @property
    def position_sigma_world(self) -> Array | None:
        """Claimed standard deviation (m), shape (n, 3)."""

    @property
    def attitude_sigma_body(self) -> Array | None:
        """Claimed standard deviation (rad), shape (n, 3)."""


def write_recording(
    path: Path,
    site: Site,
    trajectory: Trajectory,
    *,
    truth: Trajectory | None = None,
    errors: Errors | None = None,
    innovations: Mapping[str, tuple[Array, Array]] | None = None,
) -> None:
    """Write a recording with its layout, complete or not at all.

    Parameters
    ----------
    path : Path
        Of the ``.rrd`` file; ``open_viewer`` shows it.
    site : Site
        Beacons as the estimator knows them.
    trajectory : Trajectory
        The estimate; its biases and covariance are drawn where it has them.
    truth : Trajectory, optional
    errors : Errors, optional
        `TrajectoryErrors` of the estimate against the truth.
    innovations : mapping, optional
        Of each beacon: times (s) and RMS of the whitened residual at them, one where noise and
        model are as declared.
    """
    scale = scene_scale(site, trajectory)
    unfinished = path.with_name(f".{os.getpid()}.{path.name}")
    recording = rr.RecordingStream("magfusion")
    recording.save(unfinished)
    try:
        recording.send_recording_name(path.resolve().parent.name)
        log_beacons(recording, site, scale)
        _log_path(recording, "world/estimate", trajectory, _ESTIMATE, 1.2)
        _log_body(recording, trajectory, scale)
        _log_sigmas(recording, trajectory, scale)
        if truth is not None:
            _log_path(recording, "world/truth", truth, _TRUTH, 0.8)
            _log_beads(recording, truth, scale)
        _log_position(recording, trajectory, truth)
        if errors is not None:
            _log_errors(recording, errors)
        _log_biases(recording, trajectory)
        if innovations:
            _log_innovations(recording, site, innovations, trajectory.time[[0, -1]])
        _log_legend(recording, trajectory, truth is not None, bool(innovations), scale)
        recording.send_blueprint(_blueprint(site, trajectory, errors, bool(innovations), scale))
        recording.disconnect()
        unfinished.replace(path)
    finally:
        recording.disconnect()
        unfinished.unlink(missing_ok=True)


def open_viewer(path: Path) -> None:
    """Show a recording in a viewer of its own, and return at once.

    Raises
    ------
    InputError
        Where there is no such file.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the path of a recording (.rrd).")
    subprocess.Popen([sys.executable, "-m", "rerun", str(path)], start_new_session=True)


def _rows(count: int, limit: int = MAX_ROWS) -> IntArray:
    return np.unique(np.linspace(0, count - 1, min(count, limit)).astype(np.int64))


def _gaps(time: Array) -> IntArray:
    """Return where the series resumes after a gap; no line is drawn across."""
    step = np.diff(time)
    return np.flatnonzero(step > 5.0 * np.median(step)) + 1 if len(step) else _rows(0)


def _beacon_place(name: str) -> str:
    return f"world/beacons/{rr.escape_entity_path_part(name)}"


def _beacon_colour(index: int) -> tuple[int, int, int]:
    return _BEACONS[index % len(_BEACONS)]


def log_beacons(recording: rr.RecordingStream, site: Site, scale: Scale) -> None:
    """Draw the beacons: axes, moments, coils, and the shell of their coverage."""
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    longest = max(np.linalg.norm(b.moments_beacon, axis=1).max() for b in site.beacons)
    for index, beacon in enumerate(site.beacons):
        colour = _beacon_colour(index)
        place = _beacon_place(beacon.name)
        turn = rr.Quaternion(xyzw=Rotation.from_matrix(beacon.world_from_beacon).as_quat())
        pose = rr.Transform3D(translation=beacon.position_world, rotation=turn)
        recording.log(place, pose, rr.TransformAxes3D(0.05 * scale.size), static=True)
        centre = rr.Points3D(
            [[0.0, 0.0, 0.0]],
            radii=0.006 * scale.size,
            colors=colour,
            labels=f"{beacon.name} {beacon.frequency_hz:g} Hz",
        )
        recording.log(f"{place}/centre", centre, static=True)
        arrows = rr.Arrows3D(
            origins=beacon.centres_beacon,
            vectors=beacon.moments_beacon * (0.08 * scale.size / longest),
            radii=0.002 * scale.size,
            colors=colour,
        )
        recording.log(f"{place}/moments", arrows, static=True)
        loops = [coil_loop(coil, 0.02 * scale.size) for coil in beacon.coils]
        wires = rr.LineStrips3D(loops, radii=0.0012 * scale.size, colors=colour)
        recording.log(f"{place}/coils", wires, static=True)
        faint = tuple(channel // 3 for channel in colour)
        shell = rr.LineStrips3D(
            coverage_shell(beacon, COVERAGE), radii=rr.Radius.ui_points(0.6), colors=faint
        )
        recording.log(f"{place}/coverage", shell, static=True)


def _log_path(
    recording: rr.RecordingStream,
    place: str,
    trajectory: Trajectory,
    colour: tuple[int, int, int],
    width: float,
) -> None:
    pieces = np.split(trajectory.position_world, _gaps(trajectory.time))
    strips = [piece[_rows(len(piece))] for piece in pieces]
    recording.log(
        f"{place}/path",
        rr.LineStrips3D(strips, radii=rr.Radius.ui_points(width), colors=colour),
        static=True,
    )


def _log_beads(recording: rr.RecordingStream, truth: Trajectory, scale: Scale) -> None:
    """Put beads on the true path: a line would vanish in that of a good estimate."""
    places = beads(truth.position_world, 0.02 * scale.size)
    points = rr.Points3D(places[_rows(len(places))], radii=0.004 * scale.size, colors=_TRUTH)
    recording.log("world/truth/beads", points, static=True)


def _log_body(recording: rr.RecordingStream, trajectory: Trajectory, scale: Scale) -> None:
    rows = _rows(len(trajectory))
    turn = Rotation.from_matrix(trajectory.world_from_body[rows]).as_quat()
    recording.send_columns(
        "world/estimate/body",
        [rr.TimeColumn(TIMELINE, duration=trajectory.time[rows])],
        rr.Transform3D.columns(translation=trajectory.position_world[rows], quaternion=turn),
    )
    recording.log("world/estimate/body", rr.TransformAxes3D(0.06 * scale.size), static=True)
    half = np.array([1.0, 0.7, 0.35]) * 0.012 * scale.size
    box = rr.Boxes3D(half_sizes=[half], colors=_ESTIMATE, fill_mode=rr.components.FillMode.Solid)
    recording.log("world/estimate/body/platform", box, static=True)


def _log_sigmas(recording: rr.RecordingStream, trajectory: Trajectory, scale: Scale) -> None:
    if trajectory.pose_cov is None:
        return
    rows = _rows(len(trajectory), ELLIPSOIDS)
    turn = Rotation.from_matrix(trajectory.world_from_body[rows])
    half_sizes, axes = ellipsoids(turn, trajectory.pose_cov[rows, 3:, 3:])
    drawn = rr.Ellipsoids3D(
        half_sizes=3.0 * scale.sigma * half_sizes,
        centers=trajectory.position_world[rows],
        quaternions=axes.as_quat(),
        colors=(*_ESTIMATE, 110),
        line_radii=rr.Radius.ui_points(0.5),
    )
    recording.log(f"world/estimate/three_sigma_x{scale.sigma}", drawn, static=True)


def _log_series(
    recording: rr.RecordingStream,
    place: str,
    time: Array,
    value: Array,
    style: rr.SeriesLines,
) -> None:
    """Send a series; the columns of a two-dimensional value are lines of one entity."""
    recording.log(place, style, static=True)
    rows = _rows(len(time))
    gaps = _gaps(time[rows])
    # A value that is not finite interrupts the line.
    time, value = (
        np.insert(time[rows], gaps, time[rows][gaps - 1] + 1e-6),
        np.insert(value[rows], gaps, np.nan, axis=0),
    )
    columns = rr.Scalars.columns(scalars=value.ravel())
    if value.ndim == 2:
        columns = columns.partition(np.full(len(time), value.shape[1]))
    recording.send_columns(place, [rr.TimeColumn(TIMELINE, duration=time)], columns)


def _log_position(
    recording: rr.RecordingStream, trajectory: Trajectory, truth: Trajectory | None
) -> None:
    for i, (axis, colour) in enumerate(_AXES.items()):
        style = rr.SeriesLines(colors=colour, names=f"{axis} estimate", widths=1.5)
        place = f"plots/position_m/{axis}"
        _log_series(recording, place, trajectory.time, trajectory.position_world[:, i], style)
        if truth is not None:
            pale = rr.SeriesLines(colors=_SIGMA, names=f"{axis} truth", widths=1.0)
            place = f"plots/position_m/{axis}_truth"
            _log_series(recording, place, truth.time, truth.position_world[:, i], pale)


def _log_errors(recording: rr.RecordingStream, errors: Errors) -> None:
    kinds = (
        ("position_error_mm", 1e3, errors.position_world, errors.position_sigma_world),
        (
            "attitude_error_deg",
            np.rad2deg(1.0),
            errors.attitude_body,
            errors.attitude_sigma_body,
        ),
    )
    for name, unit, error, sigma in kinds:
        for i, (axis, colour) in enumerate(_AXES.items()):
            place = f"plots/{name}/{axis}"
            style = rr.SeriesLines(colors=colour, names=f"{axis} error", widths=1.5)
            _log_series(recording, f"{place}/error", errors.time, unit * error[:, i], style)
            if sigma is not None:
                bound = 3.0 * unit * sigma[:, i, None] * np.array([1.0, -1.0])
                names = ["+3 sigma", "-3 sigma"]
                band = rr.SeriesLines(colors=[_SIGMA, _SIGMA], names=names, widths=[1.0, 1.0])
                _log_series(recording, f"{place}/three_sigma", errors.time, bound, band)


def _log_biases(recording: rr.RecordingStream, trajectory: Trajectory) -> None:
    kinds = (
        ("gyro_bias_deg_s", np.rad2deg(1.0), trajectory.gyro_bias_body),
        ("accel_bias_m_s2", 1.0, trajectory.accel_bias_body),
    )
    for name, unit, bias in kinds:
        if bias is not None:
            for i, (axis, colour) in enumerate(_AXES.items()):
                style = rr.SeriesLines(colors=colour, names=axis, widths=1.5)
                place = f"plots/{name}/{axis}"
                _log_series(recording, place, trajectory.time, unit * bias[:, i], style)


def _log_innovations(
    recording: rr.RecordingStream,
    site: Site,
    innovations: Mapping[str, tuple[Array, Array]],
    span: Array,
) -> None:
    colours = {beacon.name: _beacon_colour(i) for i, beacon in enumerate(site.beacons)}
    for name, (time, rms) in innovations.items():
        present = np.isfinite(rms)
        if not present.any():
            continue
        style = rr.SeriesLines(colors=colours[name], names=name, widths=1.0)
        place = f"plots/innovations/beacons/{rr.escape_entity_path_part(name)}"
        _log_series(recording, place, time[present], rms[present], style)
    style = rr.SeriesLines(colors=(255, 255, 255), names="expected", widths=1.5)
    _log_series(recording, "plots/innovations/expected", span, np.ones(2), style)


def _log_legend(
    recording: rr.RecordingStream,
    trajectory: Trajectory,
    has_truth: bool,
    has_innovations: bool,
    scale: Scale,
) -> None:
    lines = [
        "| drawn | meaning |",
        "|---|---|",
        "| **blue line and box** | estimated path and body; body axes x red, y green, z blue |",
    ]
    if has_truth:
        lines.append("| **green beads** | true path, with its gaps |")
    if trajectory.pose_cov is not None:
        lines.append(f"| **blue ellipsoids** | 3-sigma position, drawn {scale.sigma} x as large |")
    lines += [
        "| **arrows and loops** | moments and coils of the beacons, in one colour each |",
        f"| **thin shells** | where a beacon's RMS field is {COVERAGE * 1e9:g} nT |",
    ]
    if has_innovations:
        lines.append("| **innovations** | RMS of whitened residuals; 1 where all is as declared |")
    document = rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
    recording.log("legend", document, static=True)


def _plot(origin: str, name: str, span: rr.TimeRange, legend: bool = True) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=rrb.TimeAxis(view_range=span),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )


def _by_axis(origin: str, name: str, unit: str, span: rr.TimeRange) -> rrb.Vertical:
    views = [
        _plot(f"{origin}/{axis}", f"{axis}: error, ±3 sigma ({unit})", span, legend=False)
        for axis in _AXES
    ]
    return rrb.Vertical(*views, name=name)


def _blueprint(
    site: Site, trajectory: Trajectory, errors: Errors | None, innovations: bool, scale: Scale
) -> rrb.Blueprint:
    first, last = (rr.TimeInt(seconds=float(trajectory.time[i])) for i in (0, -1))
    span = rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(first), end=rr.TimeRangeBoundary.absolute(last)
    )
    upper: list[rrb.Container | rrb.View] = []
    if errors is not None:
        upper.append(_by_axis("plots/position_error_mm", "Position error", "mm, world", span))
        upper.append(_by_axis("plots/attitude_error_deg", "Attitude error", "deg, body", span))
    upper.append(_plot("plots/position_m", "Position (m)", span))
    lower: list[rrb.Container | rrb.View] = []
    if innovations:
        lower.append(_plot("plots/innovations", "Innovations", span))
    if trajectory.gyro_bias_body is not None:
        lower.append(_plot("plots/gyro_bias_deg_s", "Gyro bias (deg/s)", span))
    if trajectory.accel_bias_body is not None:
        lower.append(_plot("plots/accel_bias_m_s2", "Accel bias (m/s²)", span))
    lower.append(rrb.TextDocumentView(origin="legend", name="Legend"))
    eye = rrb.EyeControls3D(
        position=scale.centre_world + scale.size * np.array([-0.54, -0.86, 0.66]),
        look_target=scale.centre_world,
        eye_up=(0.0, 0.0, 1.0),
    )
    untouched = rrb.EntityBehavior(interactive=False)  # a shell would catch every click
    scene = rrb.Spatial3DView(
        origin="world",
        name="Scene",
        eye_controls=eye,
        overrides={f"{_beacon_place(b.name)}/coverage": untouched for b in site.beacons},
    )
    plots = rrb.Vertical(rrb.Tabs(*upper), rrb.Tabs(*lower), row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(scene, plots, column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )
