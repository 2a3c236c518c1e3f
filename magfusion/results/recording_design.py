"""Recording of a design for the rerun viewer: the hall before and after, side by side."""

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation

from magfusion.model.hall import Hall, Prism
from magfusion.model.site import Beacon
from magfusion.results.coverage_colours import COLOURS, bounds_of, length
from magfusion.results.design.pattern import pattern_axis, peak_moment
from magfusion.results.plots.design import Panel
from magfusion.results.recording_file import whole_recording
from magfusion.results.recording_layout import eye_on, layout
from magfusion.results.shapes import Scale, coil_loop
from magfusion.units import Array

_WALLS, _FORBIDDEN, _OPEN, _BEACON = (90, 90, 90), (200, 60, 60), (120, 120, 120), (230, 70, 60)


def write_design_recording(path: Path, hall: Hall, panels: list[Panel], spacing: float) -> None:
    """Write a recording of layouts in their hall, each point in the colour of its level.

    `spacing`: of the points (m).
    """
    low, high = hall.room.box_world
    scale = Scale(0.5 * (low + high), max(float(np.linalg.norm(high - low)), 1.0), 1)
    both = np.concatenate([panel.level for panel in panels])
    between = bounds_of(both[np.isfinite(both)])
    views = []
    with whole_recording(path, "design") as recording:
        for number, panel in enumerate(panels):
            place = f"layout_{number}"
            recording.log(place, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            _log_hall(recording, place, hall)
            _log_points(recording, place, panel, between, spacing)
            for beacon in panel.site.beacons:
                _log_beacon(recording, f"{place}/beacons/{beacon.name}", beacon, scale)
            view = rrb.Spatial3DView(
                origin=place,
                name=panel.words.capitalize(),
                line_grid=rrb.LineGrid3D(spacing=1.0),
                eye_controls=eye_on(Scale(scale.centre_world, 0.9 * scale.size, 1)),
            )
            views.append(view)
        legend = rr.TextDocument(_legend(panels, between), media_type=rr.MediaType.MARKDOWN)
        recording.log("legend", legend, static=True)
        text = rrb.TextDocumentView(origin="legend", name="Legend")
        recording.send_blueprint(layout(rrb.Vertical(*views), text, shares=(3, 1)))


def _log_hall(recording: rr.RecordingStream, place: str, hall: Hall) -> None:
    parts = [("walls", hall.room, _WALLS)]
    parts += [(f"forbidden_{i}", p, _FORBIDDEN) for i, p in enumerate(hall.mounts.forbidden)]
    for name, prism, colour in parts:
        lines = rr.LineStrips3D(
            _strips(prism, hall.room.heights), radii=rr.Radius.ui_points(1.2), colors=colour
        )
        recording.log(f"{place}/hall/{name}", lines, static=True)


def _strips(prism: Prism, heights: Array) -> list[Array]:
    low, high = np.clip(prism.heights, *heights)
    ring = np.vstack([prism.polygon, prism.polygon[:1]])
    rings = [np.column_stack([ring, np.full(len(ring), z)]) for z in (low, high)]
    return [*rings, *np.stack([rings[0][:-1], rings[1][:-1]], axis=1)]


def _log_points(
    recording: rr.RecordingStream, place: str, panel: Panel, between: Array, spacing: float
) -> None:
    known = np.isfinite(panel.level)
    kind = np.digitize(panel.level, between)
    where = panel.coverage.position_world
    for index, (name, colour) in enumerate(COLOURS.items()):
        points = rr.Points3D(where[known & (kind == index)], radii=0.14 * spacing, colors=colour)
        recording.log(f"{place}/level/{name.replace(' ', '_')}", points, static=True)
    grey = rr.Points3D(where[~known], radii=0.08 * spacing, colors=_OPEN)
    recording.log(f"{place}/level/none", grey, static=True)


def _log_beacon(recording: rr.RecordingStream, place: str, beacon: Beacon, scale: Scale) -> None:
    turn = rr.Quaternion(xyzw=Rotation.from_matrix(beacon.world_from_beacon).as_quat())
    pose = rr.Transform3D(translation=beacon.position_world, rotation=turn)
    recording.log(place, pose, static=True)
    label = f"{beacon.name} {beacon.frequency_hz:g} Hz"
    centre = rr.Points3D(
        [[0.0, 0.0, 0.0]], radii=0.008 * scale.size, colors=_BEACON, labels=label, show_labels=True
    )
    recording.log(f"{place}/centre", centre, static=True)
    loops = [coil_loop(coil, 0.025 * scale.size) for coil in beacon.coils]
    wires = rr.LineStrips3D(loops, radii=0.0012 * scale.size, colors=_BEACON)
    recording.log(f"{place}/coils", wires, static=True)
    axis = pattern_axis(beacon)
    if axis is not None:
        way = 0.06 * scale.size * axis
        line = rr.LineStrips3D([[-way, way]], radii=0.002 * scale.size, colors=(255, 255, 255))
        recording.log(f"{place}/axis", line, static=True)


def _legend(panels: list[Panel], between: Array) -> str:
    heads = ["before", "after"][: len(panels)]
    lines = [f"| drawn | protection level | {' | '.join(heads)} |", "|---|---|---|---|"]
    for index, name in enumerate(COLOURS):
        limit = (
            f"below {length(between[index])}"
            if index < len(between)
            else f"above {length(between[-1])}"
        )
        shares = [
            np.mean(np.isfinite(p.level) & (np.digitize(p.level, between) == index)) for p in panels
        ]
        lines.append(f"| **{name}** | {limit} | {' | '.join(f'{100 * s:.0f} %' for s in shares)} |")
    none = " | ".join(f"{100 * np.mean(np.isinf(p.level)):.0f} %" for p in panels)
    lines.append(f"| **grey** | none | {none} |")
    worst = " | ".join(
        length(float(np.max(p.level))) if np.all(np.isfinite(p.level)) else "none" for p in panels
    )
    lines += [f"| worst | | {worst} |", "", "Bound of a fix's error with one undetected fault."]
    lines += ["", "The selected beacons; a white line is the axis:", ""]
    lines += ["| beacon | x, y, z (m) | Hz | A m² |", "|---|---|---|---|"]
    for beacon in panels[-1].site.beacons:
        place = ", ".join(f"{v:.3g}" for v in beacon.position_world)
        tones = ", ".join(f"{f:g}" for f in beacon.tone_frequencies_hz)
        lines.append(f"| {beacon.name} | {place} | {tones} | {peak_moment(beacon):.3g} |")
    lines += ["", "Red lines: forbidden for beacons. A square of the grid is 1 m."]
    return "\n".join(lines)
