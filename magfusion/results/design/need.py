"""Number and moment of beacons for an accuracy that is needed."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magfusion.errors import InputError
from magfusion.results.design.exchange import Objective, value_of
from magfusion.results.design.layout_information import LayoutInformation
from magfusion.results.design.pattern import peak_moment, stronger
from magfusion.results.design.planning import Design, Task, with_beacons
from magfusion.results.design.turns import is_in_turn

FIRST = 2  # beacons; one leaves positions open
GROWTH = 1.5  # of the number, until it suffices
MAX_FACTOR, MIN_FACTOR = 30.0, 0.01  # factor on the template's moment
DIGITS = 2  # of a moment


@dataclass(frozen=True, eq=False)
class NeededDesign:
    """The smallest design that reaches an accuracy, or the best that was found.

    `task`: with its number and moment of beacons.
    """

    task: Task
    design: Design
    reached: bool


def worst_of(task: Task, result: Design, factor: float = 1.0) -> float:
    """Return the worst protection level or position sigma (m), by the task's objective.

    `factor`: on the moments of the new beacons.
    """
    information = LayoutInformation(
        task.site, result.new[0], task.points, task.band.window, task.risk
    )
    objective: Objective = "worst" if task.objective == "worst" else "sigma"
    return value_of(information, [stronger(b, factor) for b in result.new], objective)[0]


def most_beacons(task: Task, limit: int) -> int:
    """Return the largest number of new beacons that have separate tones, at most a limit."""
    if is_in_turn(task.template):
        return limit
    kept = np.concatenate([np.zeros(0), *(b.tone_frequencies_hz for b in task.site.beacons)])
    return min(limit, len(task.band.allowed(kept)) // len(task.template.tones))


def min_beacons(
    task: Task, need: float, max_count: int, design: Callable[[Task], Design]
) -> NeededDesign:
    """Find the fewest beacons that reach an accuracy, by bisection.

    `need`: largest protection level or position sigma (m). `max_count`: largest number. `design`:
    `designed` of a task.
    """
    low, high = FIRST - 1, FIRST
    best = _tried(task, need, high, design)
    while not best.reached and high < max_count and best.design.complete:
        low, high = high, min(max(high + 1, round(GROWTH * high)), max_count)
        try:
            best = _tried(task, need, high, design)
        except InputError:  # no more have places
            break
    while best.reached and high - low > 1:
        middle = (low + high) // 2
        trial = _tried(task, need, middle, design)
        if trial.reached:
            high, best = middle, trial
        else:
            low = middle
    return best


def _tried(task: Task, need: float, count: int, design: Callable[[Task], Design]) -> NeededDesign:
    own = replace(task, count=count)
    result = design(own)
    return NeededDesign(own, result, worst_of(own, result) <= need)


def least_moment(needed: NeededDesign, need: float) -> NeededDesign:
    """Return a design with the smallest moments that reach an accuracy at the same places.

    If no moment does, those of the design remain.
    """
    task, result = needed.task, needed.design
    if worst_of(task, result, MAX_FACTOR) > need:
        return replace(needed, reached=False)
    low, high = np.log(MIN_FACTOR), np.log(MAX_FACTOR)
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        if worst_of(task, result, float(np.exp(middle))) <= need:
            high = middle
        else:
            low = middle
    # The moment that is ordered: rounded up, so that it still suffices.
    old = max(peak_moment(beacon) for beacon in result.new)
    scale = 10.0 ** (np.floor(np.log10(old * np.exp(high))) - DIGITS + 1)
    factor = float(np.ceil(old * np.exp(high) / scale) * scale / old)
    new = tuple(stronger(beacon, factor) for beacon in result.new)
    site = with_beacons(task.site, new)
    template = stronger(task.template, factor)
    return NeededDesign(replace(task, template=template), replace(result, site=site, new=new), True)
