"""Recording of a coverage for the rerun viewer: each point in the colour of its accuracy."""

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from magfusion.model.site import Beacon, Site
from magfusion.results.coverage import Coverage
from magfusion.results.recording import eye_on, layout, log_beacons
from magfusion.results.recording_file import whole_recording
from magfusion.results.shapes import Scale
from magfusion.units import Array

# From the most accurate to the least.
_COLOURS = {
    "blue": (40, 70, 200),
    "cyan": (40, 180, 220),
    "green": (70, 200, 90),
    "yellow": (240, 220, 50),
    "orange": (245, 140, 40),
    "red": (225, 50, 50),
}
_OPEN = (120, 120, 120)
_EXTRA = (255, 255, 255)


def write_coverage_recording(
    path: Path, site: Site, found: Coverage, spacing: float, extra: Beacon | None
) -> None:
    """Write a recording of the points, coloured by position sigma, among the beacons.

    Parameters
    ----------
    spacing : float
        Of the points (m).
    extra : Beacon, optional
        Where one more beacon adds most.
    """
    places = np.vstack([found.position_world, *(b.position_world for b in site.beacons)])
    low, high = places.min(axis=0), places.max(axis=0)
    scale = Scale(0.5 * (low + high), max(float(np.linalg.norm(high - low)), 1.0), 1)
    with whole_recording(path, "coverage") as recording:
        log_beacons(recording, site, scale)
        _log_points(recording, found, spacing)
        if extra is not None:
            mark = rr.Points3D(
                [extra.position_world],
                radii=0.012 * scale.size,
                colors=_EXTRA,
                labels="one more beacon adds most here",
            )
            recording.log("world/extra_beacon", mark, static=True)
        legend = rr.TextDocument(_legend(found, extra), media_type=rr.MediaType.MARKDOWN)
        recording.log("legend", legend, static=True)
        recording.send_blueprint(_blueprint(scale))


def _bounds(found: Coverage) -> Array:
    """Return the bounds between the colours in equal ratios (m), shape (colours - 1,)."""
    sigma = found.position_sigma[found.determined]
    low, high = np.quantile(sigma, [0.05, 0.95]) if len(sigma) else (0.01, 1.0)
    return np.geomspace(low, max(high, 1.1 * low), len(_COLOURS) - 1)


def _log_points(recording: rr.RecordingStream, found: Coverage, spacing: float) -> None:
    kind = np.digitize(found.position_sigma, _bounds(found))
    for index, (name, colour) in enumerate(_COLOURS.items()):
        rows = found.determined & (kind == index)
        centres = found.position_world[rows]
        points = rr.Points3D(centres, radii=0.07 * spacing, colors=colour)
        recording.log(f"world/position_sigma/{name}", points, static=True)
        way = 0.35 * spacing * found.worst_world[rows]
        lines = rr.LineStrips3D(
            list(np.stack([centres - way, centres + way], axis=1)),
            radii=rr.Radius.ui_points(0.8),
            colors=colour,
        )
        recording.log(f"world/worst_direction/{name}", lines, static=True)
    grey = rr.Points3D(found.position_world[~found.determined], radii=0.07 * spacing, colors=_OPEN)
    recording.log("world/position_sigma/not_determined", grey, static=True)


def _legend(found: Coverage, extra: Beacon | None) -> str:
    bounds = _bounds(found)
    kind = np.digitize(found.position_sigma, bounds)
    lines = ["| drawn | position sigma, three axes together | share |", "|---|---|---|"]
    for index, name in enumerate(_COLOURS):
        share = 100 * np.mean(found.determined & (kind == index))
        if index < len(bounds):
            interval = f"below {1e3 * bounds[index]:.3g} mm"
        else:
            interval = f"above {1e3 * bounds[-1]:.3g} mm"
        lines.append(f"| **{name}** | {interval} | {share:.0f} % |")
    lines.append(f"| **grey** | not determined | {100 * np.mean(~found.determined):.0f} % |")
    lines += [
        "",
        "The Cramér-Rao bound: no estimator does better from one window of the fields alone.",
        "",
        "A line through a point is the direction in which it is least certain.",
        "",
        "Arrows, loops and thin shells are the beacons, as in every recording.",
    ]
    if extra is not None:
        lines += ["", "The white ball is where one more beacon adds most."]
    return "\n".join(lines)


def _blueprint(scale: Scale) -> rrb.Blueprint:
    scene = rrb.Spatial3DView(origin="world", name="Position sigma", eye_controls=eye_on(scale))
    return layout(scene, rrb.TextDocumentView(origin="legend", name="Legend"), shares=(3, 1))
