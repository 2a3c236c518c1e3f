"""The rerun viewer on a guided rotation: directions visited and missing, and the sigmas."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from magfusion.calibration.turn_coverage import DIRECTIONS, TurnStatus
from magfusion.results.recording_file import whole_recording
from magfusion.results.recording_live import spawned
from magfusion.results.recording_plots import TIMELINE

_VISITED, _MISSING, _NOW = (90, 200, 120), (200, 70, 60), (250, 220, 90)


class TurnView:
    """Draws statuses one by one.

    `recording`: connected to a viewer, or to a file.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        scene = rrb.Spatial3DView(origin="sensor", name="Orientations of the sensor")
        sigmas = rrb.TimeSeriesView(origin="sigma_ut", name="Sigma (uT)")
        recording.send_blueprint(rrb.Blueprint(rrb.Horizontal(scene, sigmas)))
        recording.log("sensor/axes", rr.TransformAxes3D(0.5), static=True)

    def show(self, status: TurnStatus) -> None:
        """Draw a status."""
        recording = self._recording
        recording.set_time(TIMELINE, duration=status.time)
        colours = np.where(status.visited[:, None], _VISITED, _MISSING)
        recording.log("sensor/directions", rr.Points3D(DIRECTIONS, colors=colours, radii=0.05))
        if status.now is not None:
            recording.log("sensor/now", rr.Arrows3D(vectors=[status.now], colors=[_NOW]))
        for name, sigma in (("offset", status.offset_sigma), ("matrix", status.matrix_sigma)):
            if sigma is not None:
                recording.log(f"sigma_ut/{name}", rr.Scalars(1e6 * sigma))


def open_turn_view() -> TurnView:
    """Open a viewer for statuses.

    Raises InputError where no viewer can be started.
    """
    return TurnView(spawned())


def write_turns(path: Path, name: str, statuses: Iterable[TurnStatus]) -> None:
    """Write a recording of statuses."""
    with whole_recording(path, name) as recording:
        view = TurnView(recording)
        for status in statuses:
            view.show(status)
