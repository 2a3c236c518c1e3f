"""Recordings for the rerun viewer: the scene in three dimensions with the error plots."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.integrity.steel_map import SteelMap
from magfusion.files.atomic import real
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import StateTrust, Trust
from magfusion.results.errors import TrajectoryErrors
from magfusion.results.recording_file import whole_recording
from magfusion.results.recording_layout import (
    about_zero,
    eye_on,
    layout,
    plot,
    readable_range,
    span_of,
)
from magfusion.results.recording_plots import (
    AXES,
    ERRORS,
    TIMELINE,
    ErrorPlot,
    beacon_colour,
    biases,
    gaps_of,
    log_biases,
    log_errors,
    log_innovations,
    log_position,
    rows_of,
)
from magfusion.results.recording_steel import log_steel
from magfusion.results.recording_trust import (
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
MAX_POSES = 200_000  # of the body
COVERAGE = 1e-6  # T, RMS, on the shell drawn around a beacon

_ESTIMATE = (70, 170, 255)
_TRUTH = (110, 220, 120)
_PROPAGATED = (250, 200, 90)


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
    propagated: Trajectory | None = None,
    steel: SteelMap | None = None,
) -> None:
    """Write a recording with its layout, complete or not at all.

    Parameters
    ----------
    path : Path
        Of the ``.rrd`` file; ``open_viewer`` shows it.
    site : Site
        Beacons as known to the estimator.
    trajectory : Trajectory
        The estimate; its biases and covariance are drawn if available.
    errors : TrajectoryErrors, optional
        Of the estimate against the truth.
    innovations : mapping, optional
        Of each beacon: times (s) and RMS of the whitened residual at them, one where noise and
        model are as declared.
    trust : Trust, optional
        The verdict and its reasons, shown above all views.
    states : StateTrust, optional
        Of the states of the trajectory: protection levels and doubtful states.
    propagated : Trajectory, optional
        The states between those of the trajectory: the body moves along them.
    steel : SteelMap, optional
        Of the steel near the path.
    """
    scale = scene_scale(site, trajectory)
    with whole_recording(path, real(path).parent.name) as recording:
        log_beacons(recording, site, scale)
        if steel is not None:
            log_steel(recording, steel)
        _log_path(recording, "world/estimate", trajectory, _ESTIMATE, 1.2)
        _log_body(recording, trajectory if propagated is None else propagated, scale)
        if propagated is not None:
            _log_path(recording, "world/carried", propagated, _PROPAGATED, 0.6)
        _log_sigmas(recording, trajectory, scale)
        if truth is not None and truth.has_position:
            _log_path(recording, "world/truth", truth, _TRUTH, 0.8)
            _log_beads(recording, truth, scale)
        log_position(recording, trajectory, truth)
        if errors is not None:
            log_errors(recording, errors)
        log_biases(recording, trajectory)
        if innovations:
            log_innovations(recording, site, innovations, trajectory.time[[0, -1]])
        banner = None
        if trust is not None:
            banner = log_verdict(recording, trust, _summary(trajectory, errors))
        if states is not None:
            log_doubtful(recording, trajectory, states, 0.008 * scale.size)
            log_levels(recording, trajectory, states, errors)
        known = truth is not None, propagated is not None
        _log_legend(recording, trajectory, *known, scale, has_steel=steel is not None)
        plots = trajectory, errors, innovations or {}, states
        recording.send_blueprint(_blueprint(site, *plots, scale, banner))


def _summary(trajectory: Trajectory, errors: TrajectoryErrors | None) -> str:
    """Return the path's length, and errors and sigmas on the same terms."""
    time = trajectory.time
    findings = [f"{len(time)} poses in {time[-1] - time[0]:.3g} s"]
    if errors is not None:
        met = [f"{1e3 * errors.ate:.2g} mm"] * errors.has_position
        met += [f"{errors.attitude_rmse_deg:.2g} deg"] * errors.has_attitude
        findings.append(f"error {' and '.join(met)}")
    if trajectory.pose_cov is not None:
        place, turn = (
            float(np.sqrt(np.mean(np.trace(trajectory.pose_cov[:, p, p], axis1=1, axis2=2))))
            for p in (slice(3, 6), slice(0, 3))
        )
        findings.append(f"sigma {1e3 * place:.2g} mm and {np.rad2deg(turn):.2g} deg")
    return "; ".join(findings) + (" (rms, three axes together)" if len(findings) > 1 else "")


def open_viewer(path: Path) -> None:
    """Show a recording in a separate viewer, and return at once.

    Raises InputError where there is no such file. Raises EstimationError where there is no display.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the path of a recording (.rrd).")
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise EstimationError(
            f"{path}: there is no display to show it on; copy it to a computer with one and run"
            " magfusion view there, or serve it to a browser: rerun --serve-web run.rrd"
        )
    subprocess.Popen([sys.executable, "-m", "rerun", str(path)], start_new_session=True)


def _beacon_place(name: str) -> str:
    return f"world/beacons/{rr.escape_entity_path_part(name)}"


def log_beacons(recording: rr.RecordingStream, site: Site, scale: Scale) -> None:
    """Draw the beacons: axes, moments, coils, and the shell of their coverage."""
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    sizes = [float(np.linalg.norm(b.moments_beacon, axis=1).max()) for b in site.beacons]
    longest = max(sizes, default=1.0)
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
        weak = tuple(channel // 3 for channel in colour)
        shell = rr.LineStrips3D(
            coverage_shell(beacon, COVERAGE), radii=rr.Radius.ui_points(0.6), colors=weak
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
    """Put beads on the true path: a line would be hidden by that of a good estimate."""
    places = beads(truth.position_world, 0.02 * scale.size)
    points = rr.Points3D(places[rows_of(len(places))], radii=0.004 * scale.size, colors=_TRUTH)
    recording.log("world/truth/beads", points, static=True)


def _log_body(recording: rr.RecordingStream, trajectory: Trajectory, scale: Scale) -> None:
    rows = rows_of(len(trajectory), MAX_POSES)
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
    own = trajectory.world_from_body[rows], trajectory.pose_cov[rows, 3:, 3:]
    half_sizes, axes = ellipsoids(*own)
    drawn = rr.Ellipsoids3D(
        half_sizes=3.0 * scale.sigma * half_sizes,
        centers=trajectory.position_world[rows],
        quaternions=Rotation.from_matrix(axes).as_quat(),
        colors=(*_ESTIMATE, 110),
        line_radii=rr.Radius.ui_points(0.5),
    )
    recording.log(f"world/estimate/three_sigma_x{scale.sigma}", drawn, static=True)


def _log_legend(
    recording: rr.RecordingStream,
    trajectory: Trajectory,
    has_truth: bool,
    has_propagated: bool,
    scale: Scale,
    *,
    has_steel: bool,
) -> None:
    lines = [
        "| drawn | meaning |",
        "|---|---|",
        "| **blue line, box** | estimate; body axes x red, y green, z blue |",
    ]
    if has_propagated:
        lines.append("| **yellow line** | current states, propagated between field epochs |")
    if has_truth:
        lines.append("| **green beads** | true path, with its gaps |")
    if trajectory.pose_cov is not None:
        lines.append(f"| **blue ellipsoids** | 3-sigma position, {scale.sigma} x as large |")
    if has_steel:
        lines.append("| **orange spheres** | steel, iron of this size; grey: below two sigma |")
    lines += [
        "| **arrows, loops** | moments and coils of a beacon |",
        f"| **grid** | {scale.grid:g} m, at height 0 |",
        f"| **shells** (hidden) | where a beacon's RMS field is {COVERAGE * 1e9:g} nT |",
    ]
    document = rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
    recording.log("legend", document, static=True)


def _by_axis(kind: ErrorPlot, errors: TrajectoryErrors, span: rr.TimeRange) -> rrb.Vertical:
    """Return the three components one above the other, on one scale."""
    error, sigma = kind.of(errors)
    values = about_zero(error) if sigma is None else about_zero(error, 3.0 * sigma)
    views = [
        plot(
            f"{kind.place}/{axis}", kind.title(axis, sigma is not None), span, values, legend=False
        )
        for axis in AXES
    ]
    return rrb.Vertical(*views, name=kind.name)


def scene_view(site: Site, scale: Scale, name: str = "Scene") -> rrb.Spatial3DView:
    """Return the view of all entities in the world, the beacons' shells hidden."""
    # Shells would hide the path and catch every click; the viewer's own panel shows them.
    hidden = rrb.EntityBehavior(interactive=False, visible=False)
    return rrb.Spatial3DView(
        origin="world",
        name=name,
        line_grid=rrb.LineGrid3D(spacing=scale.grid),
        eye_controls=eye_on(scale),
        overrides={f"{_beacon_place(b.name)}/coverage": hidden for b in site.beacons},
    )


def _blueprint(
    site: Site,
    trajectory: Trajectory,
    errors: TrajectoryErrors | None,
    innovations: Mapping[str, tuple[Array, Array]],
    states: StateTrust | None,
    scale: Scale,
    banner: tuple[str, str] | None,
) -> rrb.Blueprint:
    span = span_of(trajectory.time)
    upper: list[rrb.Container | rrb.View] = []
    if errors is not None:
        upper += [_by_axis(kind, errors, span) for kind in ERRORS]
    if states is not None and has_levels(states):
        upper += [
            plot(level.place, level.name, span, readable_range(level.of(states), zero=True))
            for level in LEVELS
        ]
    lower: list[rrb.Container | rrb.View] = []
    if innovations:
        name = "Residuals (1 expected)"
        values = readable_range(np.ones(1), *(v for _, v in innovations.values()), zero=True)
        lower.append(plot("plots/innovations", name, span, values))
    for place, name, unit, bias in biases(trajectory):
        if bias is not None:
            lower.append(plot(place, name, span, readable_range(unit * bias)))
    position = plot("plots/position_m", "Position (m)", span)
    if errors is None:
        upper.insert(0, position)
    else:  # below the scene where nothing else would stand there
        (upper if lower else lower).append(position)
    legend = rrb.TextDocumentView(origin="legend", name="Legend")
    below: rrb.Container | rrb.View = legend
    if lower:
        below = rrb.Horizontal(rrb.Tabs(*lower), legend, column_shares=[1, 1])
    remaining = rrb.Vertical(scene_view(site, scale), below, row_shares=[8, 5])
    return layout(remaining, rrb.Tabs(*upper), shares=(3, 2), banner=banner)
