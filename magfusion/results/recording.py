"""Recordings for the rerun viewer: the scene in three dimensions beside the error plots."""

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.files.atomic import real
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import StateTrust, Trust
from magfusion.results.errors import TrajectoryErrors
from magfusion.results.recording_file import whole_recording
from magfusion.results.recording_plots import (
    AXES,
    TIMELINE,
    beacon_colour,
    gaps_of,
    log_biases,
    log_errors,
    log_innovations,
    log_position,
    rows_of,
)
from magfusion.results.recording_trust import (
    BANNER,
    LEVELS,
    has_levels,
    log_doubtful,
    log_levels,
    log_verdict,
)
from magfusion.results.shapes import (
    Scale,
    beads,
    coil_loop,
    coverage_shell,
    ellipsoids,
    scene_scale,
)
from magfusion.units import Array

ELLIPSOIDS = 30  # along the path
COVERAGE = 1e-6  # T, RMS, on the shell drawn around a beacon

_ESTIMATE = (70, 170, 255)
_TRUTH = (110, 220, 120)


def write_recording(
    path: Path,
    site: Site,
    trajectory: Trajectory,
    *,
    truth: Trajectory | None = None,
    errors: TrajectoryErrors | None = None,
    innovations: Mapping[str, tuple[Array, Array]] | None = None,
    trust: Trust | None = None,
    states: StateTrust | None = None,
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
    errors : TrajectoryErrors, optional
        Of the estimate against the truth.
    innovations : mapping, optional
        Of each beacon: times (s) and RMS of the whitened residual at them, one where noise and
        model are as declared.
    trust : Trust, optional
        The verdict and its reasons, shown above all.
    states : StateTrust, optional
        Of the states of the trajectory: protection levels and where it is in doubt.
    """
    scale = scene_scale(site, trajectory)
    with whole_recording(path, real(path).parent.name) as recording:
        log_beacons(recording, site, scale)
        _log_path(recording, "world/estimate", trajectory, _ESTIMATE, 1.2)
        _log_body(recording, trajectory, scale)
        _log_sigmas(recording, trajectory, scale)
        if truth is not None:
            _log_path(recording, "world/truth", truth, _TRUTH, 0.8)
            _log_beads(recording, truth, scale)
        log_position(recording, trajectory, truth)
        if errors is not None:
            log_errors(recording, errors)
        log_biases(recording, trajectory)
        if innovations:
            log_innovations(recording, site, innovations, trajectory.time[[0, -1]])
        if trust is not None:
            log_verdict(recording, trust)
        if states is not None:
            log_doubtful(recording, trajectory, states, 0.008 * scale.size)
            log_levels(recording, trajectory, states, errors)
        levels = has_levels(states)
        _log_legend(recording, trajectory, truth is not None, bool(innovations), levels, scale)
        shown = _Shown(errors is not None, bool(innovations), levels, trust is not None)
        recording.send_blueprint(_blueprint(site, trajectory, shown, scale))


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


def _beacon_place(name: str) -> str:
    return f"world/beacons/{rr.escape_entity_path_part(name)}"


def log_beacons(recording: rr.RecordingStream, site: Site, scale: Scale) -> None:
    """Draw the beacons: axes, moments, coils, and the shell of their coverage."""
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    longest = max(np.linalg.norm(b.moments_beacon, axis=1).max() for b in site.beacons)
    for index, beacon in enumerate(site.beacons):
        colour = beacon_colour(index)
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
    pieces = np.split(trajectory.position_world, gaps_of(trajectory.time))
    strips = [piece[rows_of(len(piece))] for piece in pieces]
    recording.log(
        f"{place}/path",
        rr.LineStrips3D(strips, radii=rr.Radius.ui_points(width), colors=colour),
        static=True,
    )


def _log_beads(recording: rr.RecordingStream, truth: Trajectory, scale: Scale) -> None:
    """Put beads on the true path: a line would vanish in that of a good estimate."""
    places = beads(truth.position_world, 0.02 * scale.size)
    points = rr.Points3D(places[rows_of(len(places))], radii=0.004 * scale.size, colors=_TRUTH)
    recording.log("world/truth/beads", points, static=True)


def _log_body(recording: rr.RecordingStream, trajectory: Trajectory, scale: Scale) -> None:
    rows = rows_of(len(trajectory))
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
    rows = rows_of(len(trajectory), ELLIPSOIDS)
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


def _log_legend(
    recording: rr.RecordingStream,
    trajectory: Trajectory,
    has_truth: bool,
    has_innovations: bool,
    levels: bool,
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
    if levels:
        lines.append(
            "| **yellow lines** | protection level: no larger error unnoticed, but for `--risk` |"
        )
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
        for axis in AXES
    ]
    return rrb.Vertical(*views, name=name)


class _Shown(NamedTuple):
    """What a recording holds beside the path."""

    errors: bool
    innovations: bool
    levels: bool
    verdict: bool


def _blueprint(site: Site, trajectory: Trajectory, shown: _Shown, scale: Scale) -> rrb.Blueprint:
    first, last = (rr.TimeInt(seconds=float(trajectory.time[i])) for i in (0, -1))
    span = rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(first), end=rr.TimeRangeBoundary.absolute(last)
    )
    upper: list[rrb.Container | rrb.View] = []
    if shown.errors:
        upper.append(_by_axis("plots/position_error_mm", "Position error", "mm, world", span))
        upper.append(_by_axis("plots/attitude_error_deg", "Attitude error", "deg, body", span))
    upper.append(_plot("plots/position_m", "Position (m)", span))
    lower: list[rrb.Container | rrb.View] = []
    if shown.levels:
        upper += [_plot(place, name, span) for place, name in LEVELS.items()]
    if shown.innovations:
        lower.append(_plot("plots/innovations", "Innovations", span))
    if trajectory.gyro_bias_body is not None:
        lower.append(_plot("plots/gyro_bias_deg_s", "Gyro bias (deg/s)", span))
    if trajectory.accel_bias_body is not None:
        lower.append(_plot("plots/accel_bias_m_s2", "Accel bias (m/s²)", span))
    lower.append(rrb.TextDocumentView(origin="legend", name="Legend"))
    untouched = rrb.EntityBehavior(interactive=False)  # a shell would catch every click
    scene = rrb.Spatial3DView(
        origin="world",
        name="Scene",
        eye_controls=eye_on(scale),
        overrides={f"{_beacon_place(b.name)}/coverage": untouched for b in site.beacons},
    )
    plots = rrb.Vertical(rrb.Tabs(*upper), rrb.Tabs(*lower), row_shares=[3, 2])
    return layout(scene, plots, banner=BANNER if shown.verdict else None)


def eye_on(scale: Scale) -> rrb.EyeControls3D:
    """Return a view of the whole scene from above its corner."""
    return rrb.EyeControls3D(
        position=scale.centre_world + scale.size * np.array([-0.54, -0.86, 0.66]),
        look_target=scale.centre_world,
        eye_up=(0.0, 0.0, 1.0),
    )


def layout(
    *parts: rrb.Container | rrb.View, shares: tuple[int, ...] = (3, 2), banner: str | None = None
) -> rrb.Blueprint:
    """Return a layout of parts side by side, the viewer's own panels out of the way.

    Parameters
    ----------
    banner : str, optional
        Entity of a text that stands above them.
    """
    body: rrb.Container = rrb.Horizontal(*parts, column_shares=list(shares))
    if banner is not None:
        view = rrb.TextDocumentView(origin=banner, name="Verdict")
        body = rrb.Vertical(view, body, row_shares=[1, 6])
    return rrb.Blueprint(
        body,
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )
