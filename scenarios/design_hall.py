"""What is a designed layout worth?  Four beacons in an L-shaped hall, against random layouts.

The hall is 24 m by 20 m with a corner of 14 m by 10 m missing; beacons of the demo's kind may be on
all walls from 0.5 m to 4.5 m but for a gate, and it is navigated between 0.5 m and 2 m, 1 m from
the walls and more.  Random layouts are drawn from the same candidates under the same rules.

1. By how much does the design beat the median of random layouts, and the best of them, in the worst
   protection level?
2. Does that hold at points it was not designed for, four times as many in plan, and by `coverage`?
3. Do several searches find the same value?
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from harness import conclude, scenario_parser

from magfusion.model.hall import Hall, Mounts, Prism, mounting_places, points_of_use
from magfusion.model.site import Site
from magfusion.model.trust import Risk
from magfusion.results.coverage import coverage
from magfusion.results.design.pattern import Band
from magfusion.results.design.planning import Task, designed
from magfusion.simulation.demo_site import demo_site

PLAN = np.array([[0, 0], [24, 0], [24, 10], [10, 10], [10, 20], [0, 20]], dtype=float)  # m
GATE = np.array([[19.0, -0.1], [24.1, -0.1], [24.1, 4.0], [19.0, 4.0]])
HEIGHT, MOUNTING, USE = (0.0, 5.0), (0.5, 4.5), (0.5, 2.0)  # m


@dataclass(frozen=True)
class Config:
    """How finely, how often, and with what to compare."""

    beacons: int = 4
    spacing: float = 1.5  # m, of the points of use
    grid: float = 1.5  # m, of the mounting places
    starts: int = 8
    layouts: int = 200
    searches: int = 2
    seed: int = 0


@dataclass(frozen=True)
class Outcome:
    """Worst protection levels (m) and times (s)."""

    candidates: int
    points: int
    random_median: float
    random_best: float
    designed: tuple[float, ...]  # of each search
    seconds: tuple[float, ...]
    fine_designed: float  # at the finer points
    fine_random_median: float  # of the layout that is the median
    gain_over_median: float  # of the first search
    gain_over_best: float


def hall() -> Hall:
    """Return the L-shaped hall."""
    gate = Prism(GATE, np.array([0.0, 3.0]))
    mounts = Mounts(tuple(range(len(PLAN))), np.array(MOUNTING), forbidden=(gate,))
    return Hall(Prism(PLAN, np.array(HEIGHT)), mounts, Prism(PLAN, np.array(USE)), margin=1.0)


def task_of(config: Config) -> Task:
    """Return what is to be designed, with nothing that stays."""
    site = demo_site()
    return Task(
        site=replace(site, beacons=()),
        template=site.beacons[0],
        count=config.beacons,
        places=mounting_places(hall(), config.grid),
        points=points_of_use(hall(), config.spacing),
        band=Band(10.0, 100.0, 0.4, 50.0),
        risk=Risk(),
    )


def run(config: Config) -> Outcome:
    """Design, and compare."""
    task, seconds, found = task_of(config), [], []
    for search in range(config.searches):
        begin = time.monotonic()
        rng = np.random.default_rng([config.seed, search])
        layouts = config.layouts if search == 0 else 0
        found.append(designed(task, starts=config.starts, layouts=layouts, rng=rng))
        seconds.append(time.monotonic() - begin)
    first = found[0]
    levels = tuple(_worst(one.site, task) for one in found)
    fine = replace(task, points=points_of_use(hall(), 0.5 * config.spacing))
    assert first.median_random is not None
    median, best = (float(f(first.random_worst_m)) for f in (np.median, np.min))
    return Outcome(
        candidates=first.candidates,
        points=len(task.points),
        random_median=median,
        random_best=best,
        designed=levels,
        seconds=tuple(seconds),
        fine_designed=_worst(first.site, fine),
        fine_random_median=_worst(first.median_random, fine),
        gain_over_median=1.0 - levels[0] / median,
        gain_over_best=1.0 - levels[0] / best,
    )


def _worst(site: Site, task: Task) -> float:
    """Return the worst protection level as `coverage` has it (m)."""
    level = coverage(site, task.points, task.band.window, risk=task.risk).protection_level_m
    assert level is not None
    return float(np.max(level))


def report(found: Outcome) -> str:
    """Return the table that a reader sees."""
    searches = ", ".join(f"{level:.3f} m" for level in found.designed)
    took = ", ".join(f"{s:.0f} s" for s in found.seconds)
    return "\n".join(
        [
            f"worst protection level; {found.candidates} candidates, {found.points} points of use",
            f"  random layouts, median   {found.random_median:8.3f} m",
            f"  random layouts, best     {found.random_best:8.3f} m",
            f"  designed                 {found.designed[0]:8.3f} m:"
            f" {100 * found.gain_over_median:.0f} % below the median,"
            f" {100 * found.gain_over_best:.0f} % below the best",
            f"  searches                 {searches}, in {took} (the first with the random ones)",
            f"  at points half as far    {found.fine_designed:8.3f} m, random median"
            f" {found.fine_random_median:.3f} m",
        ]
    )


def main() -> None:
    """Print the table and one JSON line."""
    given = scenario_parser(
        __doc__, Config.seed, "coarse, one search of two starts, forty layouts", output=None
    ).parse_args()
    small = Config(spacing=2.5, grid=3.0, starts=2, layouts=40, searches=1)
    found = run(replace(small if given.quick else Config(), seed=given.seed))
    conclude(report(found), found)


if __name__ == "__main__":
    main()
