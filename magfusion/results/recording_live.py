"""The rerun viewer with live states."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.graph.state import POSITION, State
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.recording import log_beacons
from magfusion.results.recording_layout import layout, plot
from magfusion.results.recording_plots import AXES, TIMELINE, beacon_colour
from magfusion.results.shapes import ellipsoids, scene_scale

_PATH = (70, 170, 255)
_PIECE = 50  # states to a strip of the path


class LiveView:
    """Draws states one by one.

    `recording`: connected to a viewer, or to a file.
    """

    def __init__(self, site: Site, recording: rr.RecordingStream) -> None:
        self.recording = recording
        self._scale = scene_scale(
            site, Trajectory(np.empty(0), np.empty((0, 3, 3)), np.empty((0, 3)))
        )
        self._path: list[list[float]] = []
        self._strips = 0
        log_beacons(recording, site, self._scale)
        recording.log(
            "world/estimate/body", rr.TransformAxes3D(0.06 * self._scale.size), static=True
        )
        for place in ("plots/position_m", "plots/position_sigma_mm"):
            for axis, colour in AXES.items():
                style = rr.SeriesLines(colors=colour, names=axis, widths=1.5)
                recording.log(f"{place}/{axis}", style, static=True)
        for index, beacon in enumerate(site.beacons):
            style = rr.SeriesLines(colors=beacon_colour(index), names=f"beacon {beacon.name}")
            recording.log(_innovation(beacon.name), style, static=True)
        recording.send_blueprint(_blueprint())

    def show(self, state: State, distortion: dict[str, float]) -> None:
        """Draw a state, and the residual of each beacon's field."""
        recording = self.recording
        recording.set_time(TIMELINE, duration=state.time)
        turn = Rotation.from_matrix(state.world_from_body).as_quat()
        place = state.position_world
        pose = rr.Transform3D(translation=place, quaternion=rr.Quaternion(xyzw=turn))
        recording.log("world/estimate/body", pose)
        self._extend(place.tolist())
        half_sizes, axes = ellipsoids(
            state.world_from_body[None], state.cov[None, POSITION, POSITION]
        )
        sigma = rr.Ellipsoids3D(
            half_sizes=3.0 * half_sizes,
            centers=[place],
            quaternions=Rotation.from_matrix(axes).as_quat(),
            colors=(*_PATH, 110),
        )
        recording.log("world/estimate/three_sigma", sigma)
        for axis, value in zip(AXES, place, strict=True):
            recording.log(f"plots/position_m/{axis}", rr.Scalars(float(value)))
        spread = state.world_from_body @ state.cov[POSITION, POSITION] @ state.world_from_body.T
        for axis, variance in zip(AXES, np.diagonal(spread), strict=True):
            recording.log(
                f"plots/position_sigma_mm/{axis}", rr.Scalars(1e3 * float(np.sqrt(variance)))
            )
        for name, level in distortion.items():
            recording.log(_innovation(name), rr.Scalars(float(np.sqrt(level))))

    def _extend(self, place: list[float]) -> None:
        """Draw the path in strips, so that message size does not grow with the run."""
        self._path.append(place)
        strip = rr.LineStrips3D([self._path], radii=rr.Radius.ui_points(1.2), colors=_PATH)
        self.recording.log(f"world/estimate/path/{self._strips}", strip, static=True)
        if len(self._path) >= _PIECE:
            self._path, self._strips = [place], self._strips + 1


def _innovation(beacon: str) -> str:
    return f"plots/innovations/{rr.escape_entity_path_part(beacon)}"


def spawned() -> rr.RecordingStream:
    """Open a viewer; return a recording that is connected to it.

    Raises InputError where no viewer can be started.
    """
    recording = rr.RecordingStream("magfusion")
    try:
        recording.spawn()
    except RuntimeError as error:
        raise InputError(
            f"--live: the viewer cannot be started ({str(error).splitlines()[0]}); omit it"
        ) from error
    return recording


def open_live_view(site: Site) -> LiveView:
    """Open a viewer for live states; raises as `spawned`."""
    return LiveView(site, spawned())


def _blueprint() -> rrb.Blueprint:
    plots = rrb.Vertical(
        plot("plots/position_m", "Position (m)", None),
        plot("plots/position_sigma_mm", "Sigma of the position (mm)", None),
        plot("plots/innovations", "Residuals of the fields (1 expected)", None),
    )
    scene = rrb.Spatial3DView(origin="world", name="Scene")
    return layout(scene, plots, shares=(3, 2), play="following")
