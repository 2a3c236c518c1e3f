"""The job that writes a setting-out sheet, with the marks and distances that prove the result."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magfusion.errors import InputError
from magfusion.files.distances import FROM, MEASURED, TO
from magfusion.files.hall import load_hall
from magfusion.files.site import load_site, save_site
from magfusion.jobs.coil_drive import DriveSettings
from magfusion.jobs.settings import Command, argument, option
from magfusion.model.aiding import AidingSensor
from magfusion.model.hall import Hall, Mounts, Prism, points_of_use, prism_of
from magfusion.model.site import Site
from magfusion.model.trust import Trust
from magfusion.results.coverage import usual_box
from magfusion.results.design.check_marks import check_marks, check_pairs
from magfusion.results.design.coil_drive import drive_figures
from magfusion.results.figures import Figure, Figures, heading
from magfusion.results.verdict import trust_figures
from magfusion.units import Array

if TYPE_CHECKING:
    from magfusion.results.plots.sheet import CheckRow

MAX_POINTS = 20_000


@dataclass(frozen=True, kw_only=True)
class SheetSettings(DriveSettings):
    """Site and hall of a sheet, and how marks are chosen."""

    site: Path = argument("Site file of the installation, e.g. of design")
    hall: Path | None = option(
        None, "YAML file of the hall", note="default: a box around the beacons"
    )
    spacing: float = option(2.0, "Spacing of possible marks", unit="m", least=0.2, most=100.0)
    mark_sigma: float = option(
        0.007,
        "Standard deviation of a mark, and of the placement on it",
        unit="m",
        least=1e-4,
        most=1.0,
    )
    tape: float = option(
        0.005, "Standard deviation of a check distance", unit="m", least=1e-4, most=1.0
    )


def run_sheet(settings: SheetSettings, output: Path) -> Figures:
    """Write sheet, table of check distances, and the site with its marks."""
    from magfusion.jobs.result_directory import claim
    from magfusion.results.plots.sheet import write_sheet
    from magfusion.results.report import write_report

    claimed = claim(output, "sheet")
    site = load_site(settings.site)
    hall = _hall(settings, site)
    drives = settings.drives(site.beacons)
    site, marks = _with_marks(settings, site, hall)
    checks = check_rows(site, marks, settings.mark_sigma, settings.tape)
    figures = heading("sheet", settings.site.stem) | trust_figures(Trust())
    figures |= Figures(
        Figure("beacons", len(site.beacons)),
        Figure("marks", len(marks)),
        Figure("check_distances", len(checks)),
    )
    figures |= drive_figures(drives)
    with claimed as directory:
        save_site(site, directory / "site.yaml")
        with (directory / "distances.csv").open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow((FROM, TO, "declared_m", "tolerance_m", MEASURED))
            for row in checks:
                numbers = (f"{row.distance:.4f}", f"{row.tolerance:.4f}")
                table.writerow((row.begin, row.end, *numbers, ""))
        title = f"{settings.site.stem}, {len(site.beacons)} beacons"
        write_sheet(directory / "sheet.pdf", site, hall, marks, checks, title, drives)
        write_report(directory, figures)
    return figures


def _hall(settings: SheetSettings, site: Site) -> Hall:
    if settings.hall is not None:
        return load_hall(settings.hall)
    room = prism_of(usual_box(site))
    return Hall(room, Mounts((), room.heights), room)


def _with_marks(
    settings: SheetSettings, site: Site, hall: Hall
) -> tuple[Site, Mapping[str, Array]]:
    """Return the site with marks on the floor, and these; its own if it has some."""
    given = [sensor for sensor in site.aiding if sensor.quantity == "mark"]
    if given:
        return site, given[0].marks_world
    floor = float(hall.room.heights[0])
    height = max(float(hall.use.heights[0]) - floor, 0.0)
    lowest = Prism(hall.use.polygon, np.full(2, floor + height))
    size = np.ptp(hall.use.polygon, axis=0)
    if float(np.prod(size / settings.spacing + 1.0)) > MAX_POINTS:
        raise InputError(
            f"--spacing {settings.spacing:g} gives more than {MAX_POINTS} possible marks; choose"
            " a larger value"
        )
    points = points_of_use(replace(hall, use=lowest), settings.spacing)
    foot = np.array([0.0, 0.0, -height])
    marks = {name: place + foot for name, place in check_marks(site, points).items()}
    sensor = AidingSensor(
        "mark", "mark", settings.mark_sigma, position_body=foot, marks_world=marks
    )
    return replace(site, aiding=(*site.aiding, sensor)), marks


def check_rows(
    site: Site, marks_world: Mapping[str, Array], mark_sigma: float, tape: float
) -> list[CheckRow]:
    """Return the distances to check, with tolerances of two sigmas of survey and tape."""
    from magfusion.results.plots.sheet import TOLERANCE, CheckRow

    points = {name: (place, np.full(3, mark_sigma)) for name, place in marks_world.items()}
    points |= {b.name: (b.position_world, b.sigma.position_world) for b in site.beacons}
    rows = []
    for begin, end in check_pairs(site, marks_world):
        (first, first_sigma), (second, second_sigma) = points[begin], points[end]
        way = second - first
        length = float(np.linalg.norm(way))
        variance = np.sum((way / length) ** 2 * (first_sigma**2 + second_sigma**2))
        sigma = float(np.sqrt(tape**2 + variance))
        rows.append(CheckRow(begin, end, length, TOLERANCE * sigma))
    return rows


COMMAND = Command(
    SheetSettings,
    run_sheet,
    output="sheet",
    example="magfusion sheet design/site.yaml --hall hall.yaml -o sheet",
)
