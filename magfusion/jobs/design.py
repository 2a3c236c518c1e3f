"""The job that designs an installation: a hall in, a site with its beacons out."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from magfusion.errors import InputError
from magfusion.jobs.coverage import finite, level_figures, write_points
from magfusion.jobs.settings import Command, RandomSettings, RiskSettings, argument, option
from magfusion.jobs.simulate import box_option
from magfusion.model.progress import Report, quiet
from magfusion.model.site import Site

if TYPE_CHECKING:
    from magfusion.model.hall import Hall
    from magfusion.model.site import Beacon
    from magfusion.results.coverage import Coverage
    from magfusion.results.design.pattern import Band
    from magfusion.results.design.planning import Design, Task
    from magfusion.results.figures import Figure, Figures
    from magfusion.results.plots.design import Panel
    from magfusion.units import Array

MOST_POINTS, MOST_PLACES = 10_000, 10_000
LEAST_DRAWN = 15  # random layouts, of which the median is drawn where nothing else is "before"
ALL = "all"


@dataclass(frozen=True, kw_only=True)
class DesignSettings(RiskSettings, RandomSettings):
    """Which hall, how many beacons of what kind, and how long to seek."""

    site: Path = argument("Site file: its platform, and a beacon of which copies are placed")
    beacons: int = option(4, "New beacons to place", least=1, most=30)
    hall: Path | None = option(
        None, "YAML file of the hall: walls, mounting, forbidden places, where to navigate"
    )
    box: str | None = option(
        None,
        "A hall without a file, m: xmin,xmax,ymin,ymax,zmin,zmax",
        note="default: about the site's beacons",
    )
    keep: str | None = option(
        None,
        f"Beacons of the site that stay: their names, or {ALL}",
        metavar="NAME,...",
        note="default: none; all are placed anew",
    )
    template: str | None = option(
        None, "Beacon of the site of which copies are placed", note="default: the first"
    )
    objective: Literal["worst", "D", "A"] = option(
        "worst",
        "What is made small: the worst protection level; the mean logarithm of the determinant (D)"
        " or the mean trace (A) of the position's covariance",
    )
    axes: Literal["3", "7", "13"] = option(
        "7", "Directions of a beacon's axis: the world's, and diagonals"
    )
    grid: float | None = option(
        None, "Of the mounting places", unit="m", above=0.0, note="default: as --spacing"
    )
    spacing: float | None = option(
        None,
        "Of the points of use",
        unit="m",
        above=0.0,
        note="default: a twentieth of the hall's longer side",
    )
    apart: float = option(1.0, "Least distance of two beacons", unit="m", least=0.2, most=1e4)
    clearance: float = option(
        0.5, "Least distance of a beacon from the points of use", unit="m", least=0.2, most=1e4
    )
    moment: float | None = option(
        None,
        "Of each new beacon's strongest coil",
        unit="A m^2",
        least=1e-6,
        most=1e6,
        note="default: as the template",
    )
    moment_budget: float | None = option(
        None,
        "Of all new beacons together, divided as serves best",
        unit="A m^2",
        least=1e-6,
        most=1e7,
    )
    band: str = option("10,100", "Where tones may be, Hz: low,high")
    window: float = option(
        0.4,
        "Over which tones are averaged and told apart",
        unit="s",
        least=0.02,
        most=4.0,
    )
    mains_hz: float = option(
        50.0, "Mains, whose harmonics are kept free", unit="Hz", least=0.0, most=1e3, note="0: none"
    )
    starts: int = option(8, "Random layouts from which the search starts", least=1, most=1000)
    random: int = option(0, "Random layouts to compare with", least=0, most=10_000)
    minutes: float = option(
        10.0, "After which the search ends with the best that it has", least=0.01, most=1e5
    )
    earlier: Path | None = option(
        None, "Start from the site.yaml of an earlier design of the same hall", name="continue"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.moment is not None and self.moment_budget is not None:
            raise InputError("give --moment, or --moment-budget to have it divided; not both")
        if self.hall is not None and self.box is not None:
            raise InputError("give --hall, or --box where there is no file; not both")


def run_design(settings: DesignSettings, output: Path, report: Report = quiet) -> Figures:
    """Place beacons: a site, maps before and after, table, recording and report.

    Raises
    ------
    InputError
        Where a file cannot be read, the settings do not fit, or ``output`` is in the way.
    """
    from magfusion.files.site import load_site, save_site
    from magfusion.jobs.inputs import claim
    from magfusion.results.coverage import coverage
    from magfusion.results.design.planning import designed
    from magfusion.results.plots.design import Panel, write_plot
    from magfusion.results.recording_design import write_design_recording
    from magfusion.results.report import write_report

    begin = time.monotonic()
    claimed = claim(output, "design")
    site = load_site(settings.site)
    first = None if settings.earlier is None else load_site(settings.earlier)
    hall, spacing = _hall(settings, site)
    task = _task(settings, site, hall, spacing)
    alone = len(site.beacons) < 2
    found = designed(
        task,
        starts=settings.starts,
        layouts=max(settings.random, LEAST_DRAWN if alone else 0),
        rng=np.random.default_rng(settings.seed),
        first=first,
        in_time=lambda: time.monotonic() - begin < 60.0 * settings.minutes,
        report=report,
    )
    before = found.median_random if alone else site
    assert before is not None
    words = "the site as it is" if before is site else "a random layout, the median one"
    with claimed as directory:
        save_site(found.site, directory / "site.yaml")
        new = load_site(directory / "site.yaml")
        maps = [
            coverage(one, task.points, settings.window, risk=settings.risks)
            for one in (before, new)
        ]
        panels = [
            Panel(f"before: {words}", before, maps[0]),
            Panel("after", new, maps[1]),
        ]
        figures = _figures(settings, task, found, panels, spacing)
        write_points(directory / "coverage.parquet", maps[1])
        write_plot(directory / "design.png", hall, panels)
        write_design_recording(directory / "run.rrd", hall, panels, spacing)
        write_report(directory, figures)
    return figures


def _hall(settings: DesignSettings, site: Site) -> tuple[Hall, float]:
    """Return the hall, and the spacing of its points of use (m)."""
    from magfusion.files.hall import load_hall
    from magfusion.model.hall import Hall, Mounts, prism_of
    from magfusion.results.coverage import usual_box

    if settings.hall is not None:
        hall = load_hall(settings.hall)
    else:
        given = box_option(settings.box)
        room = prism_of(usual_box(site) if given is None else given)
        mounts = Mounts(tuple(range(4)), room.heights, ceiling=True)
        hall = Hall(room, mounts, room, settings.clearance)
    size = hall.room.box_world[1, :2] - hall.room.box_world[0, :2]
    spacing = float(np.max(size)) / 20.0 if settings.spacing is None else settings.spacing
    for name, step, most in (
        ("spacing", spacing, MOST_POINTS),
        ("grid", settings.grid or spacing, MOST_PLACES),
    ):
        box = hall.use.box_world if name == "spacing" else hall.room.box_world
        if float(np.prod((box[1] - box[0])[:2] / step + 1.0)) > most:
            raise InputError(
                f"--{name} {step:g} gives more than {most} points; choose a larger one"
            )
    return hall, spacing


def _task(settings: DesignSettings, site: Site, hall: Hall, spacing: float) -> Task:
    from magfusion.model.hall import mounting_places, points_of_use
    from magfusion.results.design.pattern import template_of
    from magfusion.results.design.planning import Task, with_moment

    points = points_of_use(hall, spacing)
    if not 0 < len(points) <= MOST_POINTS:
        raise InputError(
            f"--spacing {spacing:g} gives {len(points)} points where it is to be navigated; 1 to"
            f" {MOST_POINTS} can be compared, so choose another spacing, or another margin_m in the"
            " hall's use"
        )
    template = template_of(site, settings.template)
    moment = settings.moment
    if settings.moment_budget is not None:
        moment = settings.moment_budget / settings.beacons
    return Task(
        site=_kept(site, settings.keep),
        template=template if moment is None else with_moment(template, moment),
        count=settings.beacons,
        places=mounting_places(hall, settings.grid or spacing),
        points=points,
        band=_band(settings, site),
        risk=settings.risks,
        objective=settings.objective,
        axes=int(settings.axes),
        apart=settings.apart,
        clearance=settings.clearance,
        budgeted=settings.moment_budget is not None,
    )


def _kept(site: Site, keep: str | None) -> Site:
    """Return the site with the beacons that stay alone."""
    names = [beacon.name for beacon in site.beacons]
    if keep == ALL and ALL not in names:
        return site
    wanted = [] if keep is None else [name.strip() for name in keep.split(",")]
    unknown = [name for name in wanted if name not in names]
    if unknown:
        raise InputError(
            f"--keep {keep}: the site has no beacon {unknown[0]!r}; it has {', '.join(names)}, and"
            f" {ALL} keeps them all"
        )
    gone = [name for name in names if name not in wanted]
    known = site.correlation
    groups = ("beacons", "moments", "phase")
    return replace(
        site,
        beacons=tuple(b for b in site.beacons if b.name in wanted),
        calibration=None if gone else site.calibration,
        correlation=known and known.without(groups, gone),
    )


def _band(settings: DesignSettings, site: Site) -> Band:
    from magfusion.results.design.pattern import Band

    try:
        low, high = (float(part) for part in settings.band.split(","))
    except ValueError:
        low = high = np.nan
    if not 0.0 < low <= high <= 1e6:
        raise InputError(
            f"--band {settings.band!r}: two frequencies in Hz are needed, the lower one first, as"
            " --band 10,100"
        )
    response = site.platform.magnetometer.response
    if response is not None:
        low = max(low, float(response.frequency_hz[0]))
        high = min(high, float(response.frequency_hz[-1]))
    return Band(low, high, settings.window, settings.mains_hz)


def _figures(
    settings: DesignSettings, task: Task, found: Design, panels: list[Panel], spacing: float
) -> Figures:
    from magfusion.model.trust import Trust
    from magfusion.results.figures import Figure, Figures, Section, heading
    from magfusion.results.verdict import trust_figures

    before, after = (panel.found for panel in panels)
    notes = [] if found.complete else [_OUT_OF_TIME]
    if before.protection_level_m is None or after.protection_level_m is None:
        raise AssertionError("both have a risk")
    worst = float(np.max(after.protection_level_m))
    if not np.isfinite(worst):
        notes.append(_OPEN)
    figures = [
        Figure("beacons_placed", len(found.new)),
        Figure("beacons_kept", len(task.site.beacons)),
        Figure("objective", settings.objective, section=Section.REPORT),
        Figure("candidates", found.candidates),
        Figure("points", len(task.points)),
        Figure("spacing_m", spacing, "m", section=Section.REPORT),
        Figure("window_s", settings.window, "s"),
        Figure("search_complete", found.complete),
        *level_figures(after),
        *_sigma_figures(after),
        *(
            replace(f, name=f"before_{f.name}", label=f"before: {f.title}")
            for f in [*level_figures(before), *_sigma_figures(before)]
        ),
        *_random_figures(found.random_worst_m[: settings.random], worst),
        *(figure for beacon in found.new for figure in _of_beacon(beacon)),
        Figure("notes", notes, section=Section.NOTES),
    ]
    return heading("design", settings.site.stem) | trust_figures(Trust()) | Figures(*figures)


_OUT_OF_TIME = (
    "The search ended because its time was over: this is the best layout up to then; give more"
    " --minutes, or go on from its site.yaml by --continue."
)
_OPEN = (
    "Somewhere there is no protection level: without one of the beacons nothing determines the pose"
    " there. Place more beacons, or stronger ones."
)


def _sigma_figures(found: Coverage) -> list[Figure]:
    from magfusion.results.figures import Figure

    return [
        Figure(
            f"position_sigma_m_{key}",
            finite(found.position_quantile(share)),
            "m",
            label=f"position sigma, {key}",
        )
        for key, share in (("median", 0.5), ("worst", 1.0))
    ]


def _random_figures(worst_m: Array, reached_m: float) -> list[Figure]:
    """Return what random layouts of the same candidates have, and what the design gains."""
    from magfusion.results.figures import Figure

    if not len(worst_m):
        return []
    median, best = float(np.median(worst_m)), float(np.min(worst_m))
    return [
        Figure("random_layouts", len(worst_m)),
        Figure("random_worst_level_m_median", finite(median), "m"),
        Figure("random_worst_level_m_best", finite(best), "m"),
        Figure("gain_over_random_median", finite(1.0 - reached_m / median)),
        Figure("gain_over_random_best", finite(1.0 - reached_m / best)),
    ]


def _of_beacon(beacon: Beacon) -> list[Figure]:
    from magfusion.results.design.pattern import pattern_axis, peak_moment
    from magfusion.results.figures import Figure

    name, axis = beacon.name, pattern_axis(beacon)
    rows: list[tuple[str, float, str]] = [
        (f"position_{letter}_m", float(value), "m")
        for letter, value in zip("xyz", beacon.position_world, strict=True)
    ]
    if axis is not None:
        along = beacon.world_from_beacon @ axis
        rows += [
            (f"axis_{letter}", round(float(value), 12) + 0.0, "")
            for letter, value in zip("xyz", along, strict=True)
        ]
    rows += [
        (f"frequency_{k}_hz" if k else "frequency_hz", float(f), "Hz")
        for k, f in enumerate(beacon.tone_frequencies_hz)
    ]
    rows.append(("moment_a_m2", peak_moment(beacon), "A m^2"))
    return [
        Figure(f"{{beacon}}.{key}", value, unit, name, label=_spoken(key))
        for key, value, unit in rows
    ]


def _spoken(key: str) -> str:
    return key.removesuffix("_m").removesuffix("_a_m2").removesuffix("_hz").replace("_", " ")


COMMAND = Command(
    DesignSettings,
    run_design,
    output="design",
    example="magfusion design site.yaml --beacons 4 --hall hall.yaml -o design",
)
