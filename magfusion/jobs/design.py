"""The job that designs an installation: a hall in, a site with its beacons out."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from magfusion.errors import InputError
from magfusion.files.hall import load_hall
from magfusion.files.site import load_site, save_site
from magfusion.jobs.budget_figures import PLACES, budget_figures, worst_and_median
from magfusion.jobs.coverage import write_points
from magfusion.jobs.design_figures import best_random_figures, design_figures
from magfusion.jobs.design_motion import run_motion
from magfusion.jobs.design_settings import ALL, MAX_BEACONS, DesignSettings
from magfusion.jobs.receiver_axes import three_axes
from magfusion.jobs.settings import Command
from magfusion.jobs.simulate import box_option
from magfusion.model.hall import Hall, Mounts, mounting_places, points_of_use, prism_of
from magfusion.model.progress import Report, quiet
from magfusion.model.site import Beacon, Site
from magfusion.results.coverage import coverage, usual_box
from magfusion.results.design.coil_drive import drive_figures
from magfusion.results.design.need import NeededDesign, least_moment, min_beacons, most_beacons
from magfusion.results.design.pattern import ToneBand, template_of
from magfusion.results.design.planning import Design, Task, designed, with_moment
from magfusion.results.design.turns import cycle_of, is_in_turn
from magfusion.results.error_budget import error_budget
from magfusion.results.figures import Figures
from magfusion.units import Array

MAX_POINTS, MAX_PLACES = 10_000, 10_000
MIN_DRAWN = 15  # random layouts, of which the median is drawn where nothing else is "before"


def run_design(settings: DesignSettings, output: Path, report: Report = quiet) -> Figures:
    """Place beacons: a site, maps before and after, table, recording and report."""
    from magfusion.jobs.result_directory import claim
    from magfusion.results.plots.design import Panel, write_plot
    from magfusion.results.plots.error_budget import write_budget_plot
    from magfusion.results.recording_design import write_design_recording
    from magfusion.results.report import write_report

    begin = time.monotonic()
    site = three_axes(load_site(settings.site), settings.site)
    hall, spacing = _hall(settings, site)
    if settings.motion is not None:
        return run_motion(settings, site, hall, _points(hall, spacing), output)
    claimed = claim(output, "design")
    settings.drives(())  # a wrong text is rejected before the search
    first = None if settings.earlier is None else load_site(settings.earlier)
    task = _task(settings, site, hall, spacing)
    alone = len(site.beacons) < 2

    def search(own: Task) -> Design:
        return designed(
            own,
            starts=settings.starts,
            layouts=max(settings.random, MIN_DRAWN if alone else 0),
            rng=np.random.default_rng(settings.seed),
            first=first,
            in_time=lambda: time.monotonic() - begin < 60.0 * settings.minutes,
            report=report,
        )

    task, result = _for_need(settings, task, search)
    before = result.median_random if alone else site
    assert before is not None
    words = "the given site" if before is site else "a random layout, the median one"
    with claimed as directory:
        save_site(result.site, directory / "site.yaml")
        new = load_site(directory / "site.yaml")
        maps = [
            coverage(one, task.points, settings.window, risk=settings.risks)
            for one in (before, new)
        ]
        of_sigma = settings.objective != "worst"
        panels = [
            Panel(f"before: {words}", before, maps[0], of_sigma),
            Panel("after: the design", new, maps[1], of_sigma),
        ]
        rows = worst_and_median(maps[1])
        budget = error_budget(new, task.points[rows], settings.window) if len(rows) else None
        figures = design_figures(settings, task, result, panels, spacing)
        if settings.random and result.best_random is not None:
            best = coverage(result.best_random, task.points, settings.window)
            figures |= best_random_figures(best)
        figures |= drive_figures(settings.drives(result.new))
        if budget is not None:
            figures |= budget_figures(budget, maps[1].beacons[rows])
            write_budget_plot(directory / "error_budget.png", budget, PLACES)
        write_points(directory / "coverage.parquet", maps[1])
        write_plot(directory / "design.png", hall, panels)
        write_design_recording(directory / "run.rrd", hall, panels, spacing)
        write_report(directory, figures)
    return figures


def _for_need(
    settings: DesignSettings, task: Task, search: Callable[[Task], Design]
) -> tuple[Task, Design]:
    """Return a design, of the number and moment of beacons that are needed where these are open."""
    if not settings.limits:
        return task, search(task)
    need = settings.limits[0]
    if settings.beacons is None:
        needed = min_beacons(task, need, most_beacons(task, MAX_BEACONS), search)
    else:
        needed = NeededDesign(task, search(task), reached=True)
    if settings.moment is None and settings.moment_budget is None:
        needed = least_moment(needed, need)
    return needed.task, needed.design


def _hall(settings: DesignSettings, site: Site) -> tuple[Hall, float]:
    """Return the hall, and the spacing of its points of use (m)."""
    if settings.hall is not None:
        hall = load_hall(settings.hall)
    else:
        given = box_option(settings.box)
        room = prism_of(usual_box(site) if given is None else given)
        mounts = Mounts(tuple(range(4)), room.heights, ceiling=True)
        hall = Hall(room, mounts, room, settings.clearance)
    size = hall.room.box_world[1, :2] - hall.room.box_world[0, :2]
    spacing = float(np.max(size)) / 20.0 if settings.spacing is None else settings.spacing
    grid = settings.grid or spacing
    used, room = (np.ptp(prism.box_world, axis=0) for prism in (hall.use, hall.room))
    along = float(np.sum(np.linalg.norm(np.diff(hall.room.edges, axis=1), axis=2)))
    walls = (along / grid + 1.0) * (float(room[2]) / grid + 1.0)
    for name, step, points, maximum in (
        ("spacing", spacing, float(np.prod(used / spacing + 1.0)), 4 * MAX_POINTS),
        ("grid", grid, max(walls, float(np.prod(room[:2] / grid + 1.0))), MAX_PLACES),
    ):
        if points > maximum:
            raise InputError(
                f"--{name} {step:g} gives more than {maximum} points; choose a larger value"
            )
    return hall, spacing


def _points(hall: Hall, spacing: float) -> Array:
    points = points_of_use(hall, spacing)
    if not 0 < len(points) <= MAX_POINTS:
        raise InputError(
            f"--spacing {spacing:g} gives {len(points)} points of use; 1 to {MAX_POINTS} are"
            " possible; choose another spacing, or in the hall's use another margin_m, or a"
            " polygon_m inside the hall"
        )
    return points


def _task(settings: DesignSettings, site: Site, hall: Hall, spacing: float) -> Task:
    points = _points(hall, spacing)
    template = template_of(site, settings.template)
    moment = settings.moment
    if settings.moment_budget is not None:
        moment = settings.moment_budget / settings.count
    kept = _kept(site, settings.keep)
    _check_turns(settings, kept, template)
    return Task(
        site=kept,
        template=template if moment is None else with_moment(template, moment),
        count=settings.count,
        places=mounting_places(hall, settings.grid or spacing),
        points=points,
        band=_band(settings, site),
        risk=settings.risks,
        objective=settings.objective,
        axes=int(settings.axes),
        min_distance=settings.apart,
        clearance=settings.clearance,
        budgeted=settings.moment_budget is not None,
    )


def _check_turns(settings: DesignSettings, kept: Site, template: Beacon) -> None:
    """Reject beacons in time slots with others, and a window shorter than a cycle."""
    in_turn = [beacon for beacon in (*kept.beacons, template) if is_in_turn(beacon)]
    if kept.beacons and in_turn:
        raise InputError(
            f"--keep: beacon {in_turn[0].name} is driven in time slots, and a cycle can only be"
            " designed as a whole; omit --keep, or plan with coverage --extra-beacon"
        )
    if not is_in_turn(template):
        return
    cycle = cycle_of(template, settings.count)
    if cycle is not None and settings.window < cycle * (1.0 - 1e-9):
        raise InputError(
            f"--window {settings.window:g} s is shorter than a cycle of {settings.count} beacons"
            f" in time slots; give --window {cycle:.3g} or more"
        )


def _kept(site: Site, keep: str | None) -> Site:
    """Return the site with only the beacons that stay."""
    names = [beacon.name for beacon in site.beacons]
    if keep == ALL and ALL not in names:
        return site
    wanted = list(map(str.strip, keep.split(","))) if keep is not None else []
    unknown = [name for name in wanted if name not in names]
    if unknown:
        raise InputError(
            f"--keep {keep}: the site has no beacon {unknown[0]!r}; it has {', '.join(names)};"
            f" {ALL} keeps them all"
        )
    elapsed = [name for name in names if name not in wanted]
    known = site.correlation
    groups = ("beacons", "moments", "phase")
    return replace(
        site,
        beacons=tuple(b for b in site.beacons if b.name in wanted),
        calibration=None if elapsed else site.calibration,
        correlation=known and known.without(groups, elapsed),
    )


def _band(settings: DesignSettings, site: Site) -> ToneBand:
    try:
        low, high = (float(part) for part in settings.band.split(","))
    except ValueError:
        low = high = np.nan
    if not 0.0 < low <= high <= 1e6:
        raise InputError(
            f"--band {settings.band!r}: give two frequencies in Hz, the lower one first, e.g."
            " --band 10,100"
        )
    response = site.platform.magnetometer.response
    for axis in () if response is None else response.axes:
        low = max(low, float(axis.frequency_hz[0]))
        high = min(high, float(axis.frequency_hz[-1]))
    return ToneBand(low, high, settings.window, settings.mains_hz)


COMMAND = Command(
    DesignSettings,
    run_design,
    output="design",
    example="magfusion design site.yaml --beacons 4 --hall hall.yaml -o design",
)
