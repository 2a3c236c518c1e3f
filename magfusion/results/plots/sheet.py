"""A setting-out sheet: plan to scale, coordinates, axes, tolerances and check distances, as PDF."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from magfusion.model.hall import Hall
from magfusion.model.site import Beacon, Site
from magfusion.results.design.pattern import pattern_axis, peak_moment
from magfusion.results.plots.plan import draw_beacons, draw_hall
from magfusion.units import DEGREE, Array

PAGE = (11.69, 8.27)  # inches; A4, landscape
PLAN = (10.3, 5.6)  # inches for the plan
INCH = 0.0254  # m
SCALES = (10, 20, 50, 100, 200, 250, 500, 1000, 2000, 5000, 10_000, 100_000)
ROWS = 24  # of a table on a page
TOLERANCE = 2.0  # sigmas


@dataclass(frozen=True)
class CheckRow:
    """A distance to check on site.

    Parameters
    ----------
    begin, end : str
    distance, tolerance : float
        (m)
    """

    begin: str
    end: str
    distance: float
    tolerance: float


def write_sheet(
    path: Path,
    site: Site,
    hall: Hall,
    marks_world: Mapping[str, Array],
    checks: Sequence[CheckRow],
    title: str,
) -> None:
    """Write the sheet.

    Parameters
    ----------
    marks_world : mapping
        Marks on the floor by their names, shape (3,) (m).
    """
    with PdfPages(path, metadata={"CreationDate": None}) as pages:
        pages.savefig(_plan(site, hall, marks_world, title))
        beacons = [_beacon_row(beacon) for beacon in site.beacons]
        tables = [
            (
                f"Beacons: coordinates, axes and moments; tolerances are {TOLERANCE:g} sigmas",
                _BEACON_COLUMNS,
                beacons,
            ),
            (
                "Marks: stop on each for some seconds, in any heading",
                ("mark", "x (m)", "y (m)", "z (m)"),
                [(name, *(f"{v:.3f}" for v in place)) for name, place in marks_world.items()],
            ),
            (
                "Check distances: measure, and write into distances.csv",
                ("from", "to", "distance (m)", "tolerance (mm)", "measured (m)"),
                [
                    (c.begin, c.end, f"{c.distance:.3f}", f"± {1e3 * c.tolerance:.0f}", "")
                    for c in checks
                ],
            ),
        ]
        for heading, columns, rows in tables:
            for start in range(0, len(rows), ROWS):
                pages.savefig(_table(heading, columns, rows[start : start + ROWS], title))


_BEACON_COLUMNS = (
    "beacon",
    "x (m)",
    "y (m)",
    "z (m)",
    "± (mm)",
    "axis from x\nin plan (deg)",
    "axis above\nplan (deg)",
    "± (deg)",
    "moment\n(A m²)",
    "± (%)",
    "frequency (Hz)",
)


def _beacon_row(beacon: Beacon) -> tuple[str, ...]:
    axis = pattern_axis(beacon)
    azimuth = elevation = "any"
    if axis is not None:
        x, y, z = beacon.world_from_beacon @ axis
        azimuth = f"{np.arctan2(y, x) / DEGREE + 0.0:.1f}" if np.hypot(x, y) > 1e-6 else "-"
        elevation = f"{np.arcsin(np.clip(z, -1.0, 1.0)) / DEGREE + 0.0:.1f}"
    sigma = beacon.sigma
    return (
        beacon.name,
        *(f"{value:.3f}" for value in beacon.position_world),
        f"{TOLERANCE * 1e3 * float(np.max(sigma.position_world)):.0f}",
        azimuth,
        elevation,
        f"{TOLERANCE * float(np.max(sigma.rotation_beacon)) / DEGREE:.1f}",
        f"{peak_moment(beacon):.4g}",
        f"{TOLERANCE * 100.0 * float(np.max(sigma.log_moment)):.1f}",
        ", ".join(f"{f:g}" for f in beacon.tone_frequencies_hz),
    )


def _plan(site: Site, hall: Hall, marks_world: Mapping[str, Array], title: str) -> Figure:
    figure = Figure(figsize=PAGE)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_hall(axes, hall)
    size = np.array([axes.get_xlim()[1] - axes.get_xlim()[0], np.ptp(axes.get_ylim())])
    scale = next(s for s in SCALES if np.all(size / s / INCH <= PLAN) or s == SCALES[-1])
    width, height = size / scale / INCH / PAGE
    axes.set_position((0.5 - 0.5 * width, 0.52 - 0.5 * height, width, height))
    axes.grid(color="0.9", linewidth=0.5)
    axes.set_axisbelow(True)
    if marks_world:
        places = np.array([place[:2] for place in marks_world.values()])
        axes.scatter(*places.T, s=22, marker="+", c="tab:blue", linewidths=0.9, label="mark")
        for name, place in zip(marks_world, places, strict=True):
            axes.annotate(
                name,
                tuple(place),
                xytext=(3, 3),
                textcoords="offset points",
                fontsize=5.5,
                color="tab:blue",
            )
    draw_beacons(axes, site.beacons, float(np.max(np.ptp(hall.room.polygon, axis=0))))
    figure.legend(loc="lower center", ncols=4, fontsize=9, frameon=False)
    figure.text(0.5, 0.95, f"Setting-out sheet: {title}", ha="center", fontsize=14)
    figure.text(
        0.5,
        0.905,
        f"Plan 1:{scale} on A4 printed at 100 %.  x and y as drawn, z upwards from the floor's"
        f" zero; floor {hall.room.heights[0]:g} m, ceiling {hall.room.heights[1]:g} m.",
        ha="center",
        fontsize=9,
    )
    return figure


def _table(
    heading: str, columns: Sequence[str], rows: Sequence[Sequence[str]], title: str
) -> Figure:
    figure = Figure(figsize=PAGE)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.04, 0.05, 0.92, 0.82))
    axes.set_axis_off()
    table = axes.table(cellText=rows, colLabels=columns, loc="upper center", cellLoc="center")
    table.auto_set_font_size(False)
    table.set_fontsize(9)
    table.scale(1.0, 1.35)
    for column in range(len(columns)):
        cell = table[0, column]
        cell.set_height(1.7 * cell.get_height())
        cell.set_facecolor("0.92")
    figure.text(0.5, 0.94, heading, ha="center", fontsize=12)
    figure.text(0.5, 0.02, title, ha="center", fontsize=8, color="0.4")
    return figure
