"""Recording of a coverage for the rerun viewer: each point in the colour of its accuracy."""

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from magfusion.model.site import Beacon, Site
from magfusion.results.coverage import Coverage
from magfusion.results.coverage_colours import COLOURS, bounds, colour_of, length
from magfusion.results.recording import log_beacons, scene_view
from magfusion.results.recording_file import whole_recording
from magfusion.results.recording_layout import layout
from magfusion.results.shapes import Scale

_OPEN = (120, 120, 120)
_EXTRA = (255, 255, 255)


def write_coverage_recording(
    path: Path, site: Site, coverage: Coverage, spacing: float, extra: Beacon | None
) -> None:
    """Write a recording of the points, coloured by position sigma, among the beacons.

    `spacing`: of the points (m). `extra`: best position of one more beacon.
    """
    places = np.vstack([coverage.position_world, *(b.position_world for b in site.beacons)])
    low, high = places.min(axis=0), places.max(axis=0)
    scale = Scale(0.5 * (low + high), max(float(np.linalg.norm(high - low)), 1.0), 1)
    with whole_recording(path, "coverage") as recording:
        log_beacons(recording, site, scale)
        _log_points(recording, coverage, spacing)
        if extra is not None:
            mark = rr.Points3D(
                [extra.position_world],
                radii=0.012 * scale.size,
                colors=_EXTRA,
                labels="best position of one more beacon",
            )
            recording.log("world/extra_beacon", mark, static=True)
        legend = rr.TextDocument(_legend(coverage, extra), media_type=rr.MediaType.MARKDOWN)
        recording.log("legend", legend, static=True)
        recording.send_blueprint(_blueprint(site, scale))


def _part(colour: str) -> str:
    return colour.replace(" ", "_")


def _log_points(recording: rr.RecordingStream, coverage: Coverage, spacing: float) -> None:
    kind = colour_of(coverage)
    for index, (name, colour) in enumerate(COLOURS.items()):
        rows = coverage.determined & (kind == index)
        centres = coverage.position_world[rows]
        points = rr.Points3D(centres, radii=0.11 * spacing, colors=colour)
        recording.log(f"world/position_sigma/{_part(name)}", points, static=True)
        way = 0.35 * spacing * coverage.worst_world[rows]
        lines = rr.LineStrips3D(
            list(np.stack([centres - way, centres + way], axis=1)),
            radii=rr.Radius.ui_points(0.8),
            colors=colour,
        )
        recording.log(f"world/worst_direction/{_part(name)}", lines, static=True)
    grey = rr.Points3D(
        coverage.position_world[~coverage.determined], radii=0.07 * spacing, colors=_OPEN
    )
    recording.log("world/position_sigma/not_determined", grey, static=True)


def _legend(coverage: Coverage, extra: Beacon | None) -> str:
    between, kind = bounds(coverage), colour_of(coverage)
    lines = ["| drawn | position sigma, three axes together | share |", "|---|---|---|"]
    for index, name in enumerate(COLOURS):
        share = 100 * np.mean(coverage.determined & (kind == index))
        if index < len(between):
            interval = f"below {length(between[index])}"
        else:
            interval = f"above {length(between[-1])}"
        lines.append(f"| **{name}** | {interval} | {share:.0f} % |")
    lines.append(f"| **grey** | not determined | {100 * np.mean(~coverage.determined):.0f} % |")
    lines += [
        "",
        "The Cramér-Rao bound: no estimator is better with one window of the fields alone.",
        "",
        "A line through a point is the direction of its largest uncertainty.",
        "",
        "Arrows and loops are the beacons' moments and coils; a square of the grid is 1 m.",
    ]
    if extra is not None:
        lines += ["", "The white ball is the best position of one more beacon."]
    return "\n".join(lines)


def _blueprint(site: Site, scale: Scale) -> rrb.Blueprint:
    scene = scene_view(site, scale, "Position sigma from one window")
    return layout(scene, rrb.TextDocumentView(origin="legend", name="Legend"), shares=(3, 1))
