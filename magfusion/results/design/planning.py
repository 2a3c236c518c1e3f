"""A whole design: the candidates of a hall, the search, moments and frequencies."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magfusion.errors import InputError
from magfusion.model.ground import conductivity_of
from magfusion.model.progress import Report, quiet
from magfusion.model.site import Beacon, Site
from magfusion.model.trust import Risk
from magfusion.results.design.exchange import (
    Candidates,
    LayoutSearch,
    Objective,
    at_each_point,
    best_layout,
    of_points,
    random_layout,
)
from magfusion.results.design.layout_information import LayoutInformation, added
from magfusion.results.design.pattern import (
    ToneBand,
    axes_offered,
    frequencies_for,
    pattern_axis,
    peak_moment,
    rotated_to,
    stronger,
    tuned,
)
from magfusion.results.design.tuning import assigned, divided
from magfusion.results.design.turns import all_in_turn, in_turn, is_in_turn
from magfusion.results.pose_information import NEAREST
from magfusion.units import Array

MAX_CANDIDATES = 6000


@dataclass(frozen=True, eq=False)
class Task:
    """A design task."""

    site: Site  # with the beacons that stay
    template: Beacon  # beacon of which copies are placed, with the moment of each
    count: int  # of the copies
    places: Array  # (m, 3), possible mounting places (m)
    points: Array  # (n, 3), points of use (m)
    band: ToneBand
    risk: Risk
    objective: Objective = "worst"
    axes: int = 7  # number of candidate directions of each
    # min_distance, clearance: minimum distance of two beacons, and of a beacon from points of use
    # (m)
    min_distance: float = 1.0
    clearance: float = 0.5
    budgeted: bool = False  # whether the moments may be distributed unevenly


@dataclass(frozen=True, eq=False)
class Design:
    """A finished design."""

    site: Site  # with the beacons that stayed and the new ones
    new: tuple[Beacon, ...]
    candidates: int  # number of candidates
    complete: bool  # whether the search ended before its time limit
    # (layouts,), worst protection level of random layouts of the same candidates (m)
    random_worst_m: Array
    median_random: Site | None  # the random layout whose worst level is the median
    best_random: Site | None  # the random layout that is best by the task's objective


def designed(
    task: Task,
    *,
    starts: int,
    layouts: int,
    rng: np.random.Generator,
    first: Site | None = None,
    in_time: Callable[[], bool] = lambda: True,
    report: Report = quiet,
) -> Design:
    """Select places, axes, moments and frequencies.

    Raises InputError where there are no mounting places, or too few at this distance. `starts`: of
    the search. `layouts`: number of random ones to compare with. `first`: site whose beacons, of
    the same number, are the first start.
    """
    tones, allowed = np.zeros((0, 0)), np.zeros(0)
    if is_in_turn(task.template):
        plain = in_turn(task.template, task.count - 1, task.count)
    else:
        tones, allowed = frequencies_for(task.template, task.count, task.band, task.site.beacons)
        plain = tuned(task.template, tones[len(tones) // 2])
    candidates = candidates_of(task, plain)
    information = LayoutInformation(task.site, plain, task.points, task.band.window, task.risk)
    draw, search_rng = rng.spawn(2)
    drawn = [random_layout(candidates, task.count, draw) for _ in range(layouts)]
    search = LayoutSearch(information, candidates, task.objective, in_time)
    given = None if first is None else _nearest(candidates, first, task)
    result = best_layout(search, task.count, starts, search_rng, first=given, report=report)
    if result is None or any(layout is None for layout in drawn):
        raise InputError(
            f"{task.count} beacons at a distance of at least --apart {task.min_distance:g} m do"
            f" not fit on {len(np.unique(candidates.places, axis=0))} mounting places; lower"
            " --apart or --grid"
        )
    new = _finished(
        task, information, [candidates.beacons[c] for c in result.chosen], tones, allowed, in_time
    )
    worst: list[float] = []
    value: list[float] = []  # of the task's objective
    of: list[tuple[Objective, list[float]]] = [("worst", worst), (task.objective, value)]
    for k, layout in enumerate(drawn):
        report("random layouts", k, len(drawn))
        beacons = [candidates.beacons[c] for c in layout or ()]
        new_information = np.stack([added(information.root(beacon)) for beacon in beacons])
        for objective, values in of:
            each = at_each_point(information, new_information, information.standing, objective)
            values.append(of_points(each, objective))

    def site_of(number: int) -> Site:
        beacons = [candidates.beacons[c] for c in drawn[number] or ()]
        own = _with_own_channels(task, beacons, tones)
        return with_beacons(task.site, _named(list(own), task.site))

    middle = (len(worst) - 1) // 2
    return Design(
        with_beacons(task.site, new),
        new,
        len(candidates.beacons),
        result.complete,
        np.array(worst),
        site_of(int(np.argsort(worst, kind="stable")[middle])) if worst else None,
        site_of(int(np.argmin(value))) if value else None,
    )


def candidates_of(task: Task, beacon: Beacon) -> Candidates:
    """Return copies of a beacon at every allowed place, in every direction.

    Raises InputError where there are none, or too many.
    """
    places = task.places
    if len(places):
        gap = np.array([np.min(np.linalg.norm(task.points - p, axis=1)) for p in places])
        places = places[gap >= max(task.clearance, NEAREST)]
    for kept in task.site.beacons:
        places = places[np.linalg.norm(places - kept.position_world, axis=1) >= task.min_distance]
    axes = axes_offered(beacon, task.axes)
    if len(places) < task.count:
        raise InputError(
            f"{len(places)} mounting places remain, and {task.count} are needed: all others are"
            f" forbidden, closer than --clearance {task.clearance:g} m to the points of use, or"
            f" closer than --apart {task.min_distance:g} m to a beacon that stays"
        )
    if len(places) * len(axes) > MAX_CANDIDATES:
        raise InputError(
            f"{len(places)} mounting places in {len(axes)} directions are more than"
            f" {MAX_CANDIDATES} candidates; choose a larger --grid, or fewer --axes"
        )
    return Candidates(
        tuple(replace(rotated_to(beacon, axis), position_world=p) for p in places for axis in axes),
        task.min_distance,
    )


def with_beacons(site: Site, new: tuple[Beacon, ...]) -> Site:
    """Return the site with new beacons after the existing ones."""
    return replace(site, beacons=(*site.beacons, *new))


def with_moment(beacon: Beacon, moment: float) -> Beacon:
    """Return a beacon whose strongest coil has a moment (A m^2)."""
    return stronger(beacon, moment / peak_moment(beacon))


def _with_own_channels(task: Task, chosen: list[Beacon], tones: Array) -> tuple[Beacon, ...]:
    """Return beacons with separate tones or time slots."""
    if is_in_turn(task.template):
        return all_in_turn(task.template, chosen)
    return tuple(tuned(b, t) for b, t in zip(chosen, tones, strict=True))


def _finished(
    task: Task,
    information: LayoutInformation,
    chosen: list[Beacon],
    tones: Array,
    allowed: Array,
    in_time: Callable[[], bool],
) -> tuple[Beacon, ...]:
    """Return the selected beacons with their own frequencies, moments and names."""
    beacons = _with_own_channels(task, chosen, tones)
    response = task.site.platform.magnetometer.response
    if is_in_turn(task.template):
        pass  # all have the template's carrier
    elif response is not None or task.template.conductivity or conductivity_of(task.site):
        beacons = assigned(information, beacons, allowed, task.objective, in_time)
    if task.budgeted and len(beacons) > 1:
        beacons, _ = divided(information, beacons, task.objective, in_time)
    return _named(list(beacons), task.site)


def _named(beacons: list[Beacon], site: Site) -> tuple[Beacon, ...]:
    selected = {beacon.name for beacon in site.beacons}
    allowed = (name for name in (f"B{i}" for i in range(1, 1000)) if name not in selected)
    return tuple(replace(beacon, name=next(allowed)) for beacon in beacons)


def _nearest(candidates: Candidates, first: Site, task: Task) -> tuple[int, ...]:
    """Return the candidates closest to the beacons of an earlier design."""
    kept = {beacon.name for beacon in task.site.beacons}
    new = [beacon for beacon in first.beacons if beacon.name not in kept]
    if len(new) != task.count:
        raise InputError(
            f"--continue: the earlier design has {len(new)} beacons apart from those that stay, but"
            f" --beacons is {task.count}"
        )
    chosen: list[int] = []
    for beacon in new:
        gap = np.linalg.norm(candidates.places - beacon.position_world, axis=1)
        gap = np.where(candidates.far_from(chosen), gap, np.inf)
        near = np.flatnonzero(gap <= np.min(gap) + 1e-6)
        axis = pattern_axis(beacon)
        shared = [
            0.0
            if axis is None
            else abs(
                float(
                    (beacon.world_from_beacon @ axis)
                    @ (candidates.beacons[k].world_from_beacon @ axis)
                )
            )
            for k in near
        ]
        chosen.append(int(near[int(np.argmax(shared))]))
    return tuple(chosen)
