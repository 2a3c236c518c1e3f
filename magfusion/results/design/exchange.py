"""Selection of candidates: exchange of one beacon at a time, from several random layouts.

V. V. Fedorov, Theory of Optimal Experiments (1972); H. P. Wynn, J. R. Statist. Soc. B 34 (1972):
each beacon in turn is exchanged for the candidate that lowers the objective most, until no
exchange does.  That is a local optimum, so the search has several starts.

For the worst position sigma the exchange minimises a power mean of the sigmas, a smooth bound: at
most the worst, and at least that over the root of the number of points.  The worst alone is
determined by one or two points: few exchanges lower it, and layouts that it cannot distinguish
differ everywhere else.  Of the layouts of all starts that with the smallest product of worst and
median is kept, a compound of equal weights (A. C. Atkinson, A. N. Donev, R. D. Tobias, Optimum
Experimental Designs (2007), ch. 21).

A candidate is rejected as soon as the points so far exceed the best value: candidates are compared
at the worst points first.  For what is worst the initial points are few; where a layout is worse
elsewhere, the points there are added, until there are none.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np

from magfusion.model.progress import Report, quiet
from magfusion.model.site import Beacon
from magfusion.results.design.layout_information import LayoutInformation, added, pose_covariance
from magfusion.units import Array, BoolArray, IntArray

Objective = Literal["worst", "sigma", "D", "A"]
LESS = 1e-4  # of the objective; an exchange that gains less is none
FIRST_POINTS = 24  # compared from the start
MORE_POINTS = 6  # added in a round, apart from each other
MAX_COMPARED = 64  # points, for the memory that all candidates take there
ROUNDS = 8
SWEEPS = 20
POWER = 8  # of the mean of sigmas that stands for the worst one
DRAWN = 30  # random layouts, of which the best is a start
STAGES = (3, 8)  # points at which candidates are compared, before all
AT_ONCE = 3000  # informations in memory at once
MAX_KEPT_NUMBERS = 10_000_000  # numbers of all candidates at all points that are kept in memory
TRIES = 2000  # random layouts in a row that do not keep their distance


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate beacons."""

    beacons: tuple[Beacon, ...]
    min_distance: float  # minimum distance of two beacons (m)

    @property
    def places(self) -> Array:
        """Their positions, shape (candidates, 3) (m)."""
        return np.array([beacon.position_world for beacon in self.beacons])

    def far_from(self, selected: Sequence[int]) -> BoolArray:
        """Return which candidates keep the distance from the selected ones."""
        places = self.places
        allowed = np.ones(len(places), dtype=bool)
        for other in selected:
            allowed &= np.linalg.norm(places - places[other], axis=1) >= self.min_distance
        return allowed


@dataclass(frozen=True)
class ExchangeResult:
    """A layout that no exchange improves."""

    chosen: tuple[int, ...]  # indices of the candidates
    value: float  # of `layout_value`, at all points
    complete: bool  # whether the search ended before its time limit


@dataclass(eq=False)
class LayoutSearch:
    """Candidates and the points at which they are compared, to which points can be added."""

    information: LayoutInformation  # at all points
    candidates: Candidates
    # worst protection level (m); worst position sigma (m); mean of the logarithm of the determinant
    # of the position's covariance; mean of its trace (m^2)
    objective: Objective
    in_time: Callable[[], bool] = lambda: True  # whether the time limit is not reached
    active: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    roots: Array = field(default_factory=lambda: np.zeros((0, 0, 0, 0)))
    standing: Array = field(default_factory=lambda: np.zeros((0, 0, 0, 0)))

    def __post_init__(self) -> None:
        """Select the first points: distributed evenly over all, or enough for a mean."""
        maximum = FIRST_POINTS if _is_worst(self.objective) else 2 * FIRST_POINTS
        count = len(self.information.points)
        self.add(np.unique(np.linspace(0, count - 1, min(maximum, count)).astype(int)))

    def add(self, points: IntArray) -> None:
        """Add points at which candidates are compared."""
        part = self.information.at(self.information.points[points])
        if self._everywhere is None:
            roots = np.stack([part.root(beacon) for beacon in self.candidates.beacons])
        else:
            roots = self._everywhere[:, points]
        first = not len(self.active)
        self.roots = roots if first else np.concatenate([self.roots, roots], axis=1)
        standing = part.standing
        self.standing = standing if first else np.concatenate([self.standing, standing], axis=1)
        self.active = np.concatenate([self.active, points])

    @cached_property
    def _everywhere(self) -> Array | None:
        """Roots of all candidates at all points; None where they are too many."""
        beacons, information = self.candidates.beacons, self.information
        size = information.root(beacons[0]).size
        if len(beacons) * size > MAX_KEPT_NUMBERS:
            return None
        return np.stack([information.root(beacon) for beacon in beacons])

    def value(self, chosen: Sequence[int]) -> float:
        """Return the search value of a layout at the compared points."""
        return float(search_value(self._each(chosen), self.objective))

    def _each(self, chosen: Sequence[int]) -> Array:
        new = added(self.roots[list(chosen)])
        return at_each_point(self.information, new, self.standing, self.objective)

    def value_everywhere(self, chosen: Sequence[int]) -> tuple[float, Array]:
        """Return the `layout_value` of a layout, and the objective per point, of all points."""
        beacons = [self.candidates.beacons[c] for c in chosen]
        each = value_of(self.information, beacons, self.objective)[1]
        return layout_value(each, self.objective), each

    def best_in_place_of(self, chosen: Sequence[int], slot: int, value: float) -> tuple[int, float]:
        """Return the best candidate in place of a beacon, and the search value with it."""
        others = [c for k, c in enumerate(chosen) if k != slot]
        rows = np.flatnonzero(self.candidates.far_from(others))
        new = added(self.roots[others])
        rest = self.standing[0] + np.sum(new, axis=0)
        parts = [rest - self.standing[0] + kept for kept in self.standing[1:]]
        parts += [
            self.standing[0] + np.sum(np.delete(new, k, axis=0), axis=0) for k in range(len(new))
        ]
        base = np.stack([rest, *parts], axis=1)  # (points, 1 + beacons, size, size)
        alone = pose_covariance(rest)  # without the one that is exchanged
        if self.objective != "worst":
            base = base[:, :1]
        now = self._each(chosen)
        count, order = len(now), np.argsort(-now, kind="stable")
        stages = STAGES if self.objective != "D" else ()  # its sum has no lower bound
        starts = [0, *(s for s in stages if s < count), count]
        each = np.zeros((len(rows), 0))
        for start, end in pairwise(starts):
            result = self._compared(rows, base, alone, order[start:end])
            each = np.concatenate([each, result], axis=1)
            bound = search_value(each, self.objective, count)
            kept = bound < _less(value)
            rows, each, bound = rows[kept], each[kept], bound[kept]
            if not len(rows):
                return chosen[slot], value
        best = int(np.argmin(bound))
        return int(rows[best]), float(bound[best])

    def _compared(self, rows: IntArray, base: Array, alone: Array, points: IntArray) -> Array:
        """Return the objective per point with each candidate, (rows, points)."""
        size, parts = base.shape[-1], base.shape[1]
        step = max(AT_ONCE // (len(points) * parts), 1)
        result = np.empty((len(rows), len(points)))
        for start in range(0, len(rows), step):
            some = rows[start : start + step]
            new = added(self.roots[some][:, points])
            whole = base[points][None] + new[:, :, None]
            cov = pose_covariance(whole.reshape(-1, parts, size, size))
            if self.objective != "worst":
                each = _of_covariance(cov[:, 0], self.objective)
            else:
                own = np.tile(alone[points], (len(some), 1, 1))
                subset = np.concatenate([cov[:, 1:], own[:, None]], axis=1)
                each = self.information.levels_of(cov[:, 0], subset)
            result[start : start + len(some)] = each.reshape(len(some), len(points))
        return result


def value_of(
    information: LayoutInformation, beacons: Sequence[Beacon], objective: Objective
) -> tuple[float, Array]:
    """Return the objective of beacons with those that stay, and its value per point."""
    new = np.stack([added(information.root(beacon)) for beacon in beacons])
    each = at_each_point(information, new, information.standing, objective)
    return of_points(each, objective), each


def at_each_point(
    information: LayoutInformation, new: Array, standing: Array, objective: Objective
) -> Array:
    """Return the objective per point, shape (n,).

    `new` (beacons, n, size, size): information of each new beacon. `standing` (1 + stay, n, size,
    size).
    """
    whole = standing[0] + np.sum(new, axis=0)
    cov = pose_covariance(whole)
    if objective != "worst":
        return _of_covariance(cov, objective)
    parts = [whole - standing[0] + kept for kept in standing[1:]]
    parts += [standing[0] + np.sum(np.delete(new, k, axis=0), axis=0) for k in range(len(new))]
    return information.levels_of(cov, pose_covariance(np.stack(parts, axis=1)))


def _of_covariance(cov: Array, objective: Objective) -> Array:
    position = cov[..., 3:, 3:]
    if objective != "D":
        trace = np.trace(position, axis1=-2, axis2=-1)
        return np.asarray(trace if objective == "A" else np.sqrt(trace))
    return np.asarray(np.linalg.slogdet(position)[1])


def of_points(each: Array, objective: Objective) -> float:
    """Return the objective from its values per point."""
    return float(np.max(each) if _is_worst(objective) else np.mean(each))


def search_value(each: Array, objective: Objective, count: int | None = None) -> Array:
    """Return what an exchange minimises, from the objective per point, shape (..., n).

    `count`: number of points, of which the first n are given: a lower bound, but for D.
    """
    number = each.shape[-1] if count is None else count
    if objective == "worst":
        return np.asarray(np.max(each, axis=-1))
    if objective != "sigma":
        return np.asarray(np.sum(each, axis=-1) / number)
    return np.asarray((np.sum(each**POWER, axis=-1) / number) ** (1.0 / POWER))


def layout_value(each: Array, objective: Objective) -> float:
    """Return by what layouts of several starts are compared, from the objective per point (n,)."""
    value = of_points(each, objective)
    return value * float(np.median(each)) if objective == "sigma" else value


def _less(value: float) -> float:
    """Return what an exchange must go below."""
    return value - LESS * abs(value) if np.isfinite(value) else value


def _is_worst(objective: Objective) -> bool:
    """Return whether the worst points count most, not the mean of all."""
    return objective in ("worst", "sigma")


def random_layout(
    candidates: Candidates, count: int, rng: np.random.Generator
) -> tuple[int, ...] | None:
    """Return random candidates that keep their distance; None where none are found."""
    for _ in range(TRIES):
        drawn: list[int] = rng.choice(len(candidates.beacons), count, replace=False).tolist()
        if all(candidates.far_from(drawn[:k])[c] for k, c in enumerate(drawn)):
            return tuple(drawn)
    return None


def exchanged(search: LayoutSearch, chosen: tuple[int, ...]) -> tuple[int, ...]:
    """Exchange one beacon after another, until there is no gain at the compared points."""
    value, unchanged, layout = search.value(chosen), 0, list(chosen)
    for turn in range(SWEEPS * len(layout)):
        if unchanged == len(layout) or not search.in_time():
            break
        slot = turn % len(layout)
        selected, reached = search.best_in_place_of(layout, slot, value)
        better = reached < _less(value) and selected != layout[slot]
        if better:
            layout[slot], value = selected, reached
        unchanged = 0 if better else unchanged + 1
    return tuple(layout)


def best_layout(
    search: LayoutSearch,
    count: int,
    starts: int,
    rng: np.random.Generator,
    *,
    first: tuple[int, ...] | None = None,
    report: Report = quiet,
) -> ExchangeResult | None:
    """Return the best layout of several starts; None where beacons cannot keep their distance.

    `first`: an initial layout, before random ones.
    """
    best: ExchangeResult | None = None
    for start in range(starts):
        report("starts of the search", start, starts)
        if best is not None and not search.in_time():
            break
        layout = first if start == 0 and first is not None else _start(search, count, rng)
        if layout is None:
            return best
        result = _exchange_until_converged(search, layout)
        if best is None or result.value < best.value:
            best = result
    report("starts of the search", starts, starts)
    if best is None:
        return None
    return ExchangeResult(best.chosen, best.value, search.in_time())


def _start(search: LayoutSearch, count: int, rng: np.random.Generator) -> tuple[int, ...] | None:
    best: tuple[float, tuple[int, ...]] | None = None
    for _ in range(DRAWN):
        drawn = random_layout(search.candidates, count, rng)
        if drawn is None:
            return None
        value = search.value(drawn)
        if best is None or value < best[0]:
            best = value, drawn
    return None if best is None else best[1]


def _exchange_until_converged(search: LayoutSearch, layout: tuple[int, ...]) -> ExchangeResult:
    """Exchange, and add the points where the layout is worse than at the compared points."""
    best: ExchangeResult | None = None
    for _ in range(ROUNDS):
        layout = exchanged(search, layout)
        value, each = search.value_everywhere(layout)
        if best is None or value < best.value:
            best = ExchangeResult(layout, value, complete=True)
        reached = float(search_value(each, search.objective))
        enough = not _is_worst(search.objective) or reached <= search.value(layout) * (1.0 + LESS)
        full = len(search.active) + MORE_POINTS > MAX_COMPARED
        if enough or full or not search.in_time():
            break
        search.add(_worst_apart(search, each))
    assert best is not None
    return best


def _worst_apart(search: LayoutSearch, each: Array) -> IntArray:
    """Return the worst points that are not compared yet, none close to another."""
    points = search.information.points
    near = 0.1 * float(np.linalg.norm(np.ptp(points, axis=0)))
    selected: list[int] = []
    for point in np.argsort(-each, kind="stable").tolist():
        if point in search.active or each[point] < 0.9 * np.max(each):
            continue
        if all(np.linalg.norm(points[point] - points[other]) > near for other in selected):
            selected.append(point)
        if len(selected) == MORE_POINTS:
            break
    return np.array(selected, dtype=np.int64)
