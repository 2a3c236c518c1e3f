"""A setting-out sheet: plan to scale, coordinates, axes, tolerances and check distances, as PDF."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from magfusion.model.hall import Hall
from magfusion.model.site import Beacon, Site
from magfusion.results.design.coil_drive import DriveRow
from magfusion.results.design.pattern import pattern_axis, peak_moment
from magfusion.results.plots.plan import MARGIN, draw_beacons, draw_hall
from magfusion.units import DEGREE, Array

PAGE = (11.69, 8.27)  # inches; A4, landscape
PLAN = (10.3, 5.6)  # inches for the plan
INCH = 0.0254  # m
SCALES = (10, 20, 50, 100, 200, 250, 300, 400, 500, 1000, 2000, 5000, 10_000, 100_000)
DETAILED = 100  # scale of the pages of parts, where the whole has a smaller one
MAX_PARTS = 12
ROWS = 24  # of a table on a page
TOLERANCE = 2.0  # sigmas


@dataclass(frozen=True)
class CheckRow:
    """A distance to check on site.

    `distance`, `tolerance` (m).
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
    drives: Sequence[DriveRow] = (),
) -> None:
    """Write the sheet.

    `marks_world`: marks on the floor by their names, shape (3,) (m). `drives`: of the coils, if
    wire and form are known.
    """
    with PdfPages(path, metadata={"CreationDate": None}) as pages:
        for figure in _plans(site, hall, marks_world, title):
            pages.savefig(figure)
        beacons = [_beacon_row(beacon) for beacon in site.beacons]
        tables: list[tuple[str, Sequence[str], list[tuple[str, ...]]]] = [
            (
                f"Beacons: coordinates, axes and moments; tolerances are {TOLERANCE:g} sigmas",
                _BEACON_COLUMNS,
                beacons,
            ),
            (
                "Coils: drive, and temperature in still air",
                _DRIVE_COLUMNS,
                [_drive_row(row) for row in drives],
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


_DRIVE_COLUMNS = (
    "beacon",
    "frequency (Hz)",
    "moment (A m²)",
    "peak current (A)",
    "peak voltage (V)",
    "power (W)",
    "temperature (°C)",
)


def _drive_row(row: DriveRow) -> tuple[str, ...]:
    head = (row.beacon, f"{row.frequency_hz:g}", f"{row.moment:.4g}")
    if row.point is None:
        return (*head, "-", "-", "-", "too hot")
    point = row.point
    numbers = (point.current, point.voltage, point.power, point.temperature_degc)
    return (*head, *(f"{value:.3g}" for value in numbers))


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


def _plans(
    site: Site, hall: Hall, marks_world: Mapping[str, Array], title: str
) -> Iterator[Figure]:
    """Yield the plan of the whole hall, and of its parts where that is small."""
    box = hall.room.box_world[:, :2]
    box = box + MARGIN * float(np.max(box[1] - box[0])) * np.array([[-1.0], [1.0]])
    size = box[1] - box[0]
    scale = next(s for s in SCALES if np.all(size / s / INCH <= PLAN) or s == SCALES[-1])
    yield _plan(site, hall, marks_world, box, scale, title)
    if scale <= DETAILED:
        return
    part = np.array(PLAN) * INCH * DETAILED
    count = np.ceil(np.ptp(hall.room.polygon, axis=0) / part).astype(int)
    if np.prod(count) > MAX_PARTS:
        return
    step = np.ptp(hall.room.polygon, axis=0) / count
    middle = hall.room.box_world[0, :2] + 0.5 * step
    for k, (row, column) in enumerate(np.ndindex(count[1], count[0]), 1):
        place = middle + step * np.array([column, row])
        own = np.stack([place - 0.5 * part, place + 0.5 * part])
        yield _plan(site, hall, marks_world, own, DETAILED, f"{title}, part {k}")


def _plan(
    site: Site, hall: Hall, marks_world: Mapping[str, Array], box: Array, scale: int, title: str
) -> Figure:
    """Return a page with a part of the plan, lower and upper corner (2, 2) (m), to scale."""
    figure = Figure(figsize=PAGE)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_hall(axes, hall)
    width, height = (box[1] - box[0]) / scale / INCH / PAGE
    axes.set_position((0.5 - 0.5 * width, 0.5 - 0.5 * height, width, height))
    axes.set(xlim=box[:, 0], ylim=box[:, 1])
    axes.grid(color="0.9", linewidth=0.5)
    axes.set_axisbelow(True)
    inside = {
        name: place
        for name, place in marks_world.items()
        if np.all((place[:2] >= box[0]) & (place[:2] <= box[1]))
    }
    if inside:
        places = np.array([place[:2] for place in inside.values()])
        axes.scatter(
            places[:, 0], places[:, 1], s=22, marker="+", c="tab:blue", linewidths=0.9, label="mark"
        )
        for name, place in zip(inside, places, strict=True):
            if scale <= DETAILED:
                axes.annotate(
                    name,
                    tuple(place),
                    xytext=(3, 3),
                    textcoords="offset points",
                    fontsize=8,
                    color="tab:blue",
                )
    shown = [
        beacon
        for beacon in site.beacons
        if np.all((beacon.position_world[:2] >= box[0]) & (beacon.position_world[:2] <= box[1]))
    ]
    draw_beacons(axes, shown, float(np.max(box[1] - box[0])))
    figure.legend(loc="lower center", ncols=4, fontsize=9, frameon=False)
    figure.text(0.5, 0.955, f"Setting-out sheet: {title}", ha="center", fontsize=14)
    figure.text(
        0.5,
        0.925,
        f"Plan 1:{scale} on A4 printed at 100 %.  x and y as drawn, z upwards; floor at"
        f" {hall.room.heights[0]:g} m, ceiling at {hall.room.heights[1]:g} m.",
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
