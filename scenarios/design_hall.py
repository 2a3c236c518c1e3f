"""What is a designed layout worth?  Four beacons in an L-shaped hall, against random layouts.

The hall is 24 m by 20 m with a corner of 14 m by 10 m missing; beacons of the demo's kind may be on
all walls from 0.5 m to 4.5 m but for a gate, and it is navigated between 0.5 m and 2 m, 1 m from
the walls and more.  Random layouts are drawn from the same candidates under the same rules.

1. By how much does the design beat the median of random layouts, and the best of them, in the worst
   protection level?
2. Does that hold at points it was not designed for, four times as many in plan, and by `coverage`?
3. Do several searches find the same value?
4. Are the protection levels those that fixes of simulated fields have there?
5. What does it cost where no beacon is false?  The worst sigma of the position, compared with that
   of the median layout and of a design for the mean variance (A).
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from harness import conclude, scenario_parser

from magfusion.estimation.snapshot.fix_separation import separate_fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.hall import Hall, Mounts, Prism, mounting_places, points_of_use
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Beacon, Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Risk
from magfusion.results.coverage import Coverage, coverage, phasor_variance
from magfusion.results.design.pattern import ToneBand
from magfusion.results.design.planning import Task, designed
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import simulate_fields
from magfusion.units import Array

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
class DesignOutcome:
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
    fix_over_predicted: tuple[float, float, float]  # levels of fixes: 5, 50 and 95 % of the points
    worst_sigma: tuple[float, float, float]  # designed, random median, designed by A (m)
    level_by_a: float  # of the design by A


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
        band=ToneBand(10.0, 100.0, 0.4, 50.0),
        risk=Risk(),
    )


def run(config: Config) -> DesignOutcome:
    """Design, and compare."""
    task, seconds, result = task_of(config), [], []
    for search in range(config.searches):
        begin = time.monotonic()
        rng = np.random.default_rng([config.seed, search])
        layouts = config.layouts if search == 0 else 0
        result.append(designed(task, starts=config.starts, layouts=layouts, rng=rng))
        seconds.append(time.monotonic() - begin)
    first = result[0]
    levels = tuple(_worst(one.site, task) for one in result)
    fine = replace(task, points=points_of_use(hall(), 0.5 * config.spacing))
    assert first.median_random is not None
    by_a = designed(
        replace(task, objective="A"),
        starts=config.starts,
        layouts=0,
        rng=np.random.default_rng([config.seed, config.searches]),
    )
    sites = (first.site, first.median_random, by_a.site)
    sigma = tuple(float(np.max(_map(site, task).position_sigma)) for site in sites)
    low, middle, high = _fixes_over_predicted(first.site, task, config.seed)
    median, best = (float(f(first.random_worst_m)) for f in (np.median, np.min))
    return DesignOutcome(
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
        fix_over_predicted=(low, middle, high),
        worst_sigma=(sigma[0], sigma[1], sigma[2]),
        level_by_a=_worst(by_a.site, task),
    )


def _map(site: Site, task: Task) -> Coverage:
    return coverage(site, task.points, task.band.window, risk=task.risk)


def _levels(site: Site, task: Task) -> Array:
    level = _map(site, task).protection_level_m
    assert level is not None
    return level


def _worst(site: Site, task: Task) -> float:
    """Return the worst protection level as `coverage` has it (m)."""
    return float(np.max(_levels(site, task)))


def _fixes_over_predicted(site: Site, task: Task, seed: int) -> tuple[float, float, float]:
    """Return quantiles of the levels of fixes of simulated fields, over those predicted."""
    dipoles = replace(site, beacons=tuple(_as_dipoles(b) for b in site.beacons))
    noise = float(np.sqrt(phasor_variance(dipoles, task.band.window)[0]))
    count, calibration = len(task.points), initial_calibration(dipoles, 0.0)
    attitude = np.broadcast_to(np.eye(3), (count, 3, 3))
    still = Trajectory(task.band.window * np.arange(count), attitude, task.points)
    samples = simulate_fields(dipoles, still, noise, np.random.default_rng(seed))
    fixes = fix_epochs(samples, calibration)
    result = separate_fixes(samples, calibration, fixes, risk=task.risk).states
    ratio = result.protection_level_m / _levels(dipoles, task)
    low, middle, high = np.nanquantile(ratio, [0.05, 0.5, 0.95])
    return float(low), float(middle), float(high)


def _as_dipoles(beacon: Beacon) -> Beacon:
    return replace(beacon, coils=tuple(replace(c, radius=None) for c in beacon.coils))


def report(result: DesignOutcome) -> str:
    """Return the table that a reader sees."""
    searches = ", ".join(f"{level:.3f} m" for level in result.designed)
    took = ", ".join(f"{s:.0f} s" for s in result.seconds)
    return "\n".join(
        [
            f"worst protection level; {result.candidates} candidates, {result.points} points of"
            " use",
            f"  random layouts, median   {result.random_median:8.3f} m",
            f"  random layouts, best     {result.random_best:8.3f} m",
            f"  designed                 {result.designed[0]:8.3f} m:"
            f" {100 * result.gain_over_median:.0f} % below the median,"
            f" {100 * result.gain_over_best:.0f} % below the best",
            f"  searches                 {searches}, in {took} (the first with the random ones)",
            f"  at points half as far    {result.fine_designed:8.3f} m, random median"
            f" {result.fine_random_median:.3f} m",
            "  levels of fixes over predicted, 5, 50, 95 % of the points: "
            + ", ".join(f"{r:.3f}" for r in result.fix_over_predicted),
            "  worst position sigma     designed {:.3f} m, random median {:.3f} m, designed by A"
            " {:.3f} m".format(*result.worst_sigma),
            f"  worst level by A         {result.level_by_a:8.3f} m",
        ]
    )


def main() -> None:
    """Print the table and one JSON line."""
    given = scenario_parser(
        __doc__, Config.seed, "coarse, one search of two starts, forty layouts", output=None
    ).parse_args()
    small = Config(spacing=2.5, grid=3.0, starts=2, layouts=40, searches=1)
    result = run(replace(small if given.quick else Config(), seed=given.seed))
    conclude(report(result), result)


if __name__ == "__main__":
    main()
