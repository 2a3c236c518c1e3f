"""Report of a design."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from magfusion.jobs.coverage import finite, level_figures, need_figures
from magfusion.jobs.design_settings import DesignSettings
from magfusion.model.site import Beacon
from magfusion.results.coverage import Coverage
from magfusion.results.design.pattern import pattern_axis, peak_moment
from magfusion.results.design.planning import Design, Task
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.units import Array

if TYPE_CHECKING:
    from magfusion.results.plots.design import Panel


def design_figures(
    settings: DesignSettings, task: Task, result: Design, panels: list[Panel], spacing: float
) -> Figures:
    """Return the report of a design: its accuracy, before and after, and its beacons.

    `panels`: before and after. `spacing`: of the points (m).
    """
    before, after = (panel.coverage for panel in panels)
    notes = [] if result.complete else [_OUT_OF_TIME]
    if before.protection_level_m is None or after.protection_level_m is None:
        raise AssertionError("both have a risk")
    worst = float(np.max(after.protection_level_m))
    if not np.isfinite(worst):
        notes.append(_OPEN)
    figures = [
        Figure("beacons_placed", len(result.new)),
        Figure("beacons_kept", len(task.site.beacons)),
        Figure("objective", settings.objective, section=Section.REPORT),
        Figure("candidates", result.candidates),
        Figure("points", len(task.points)),
        Figure("spacing_m", spacing, "m", section=Section.REPORT),
        Figure("window_s", settings.window, "s"),
        Figure("search_complete", result.complete),
        *level_figures(after),
        *_sigma_figures(after),
        *(
            replace(f, name=f"before_{f.name}", label=f"before: {f.title}")
            for f in [*level_figures(before), *_sigma_figures(before)]
        ),
        *_random_figures(result.random_worst_m[: settings.random], worst),
        *(figure for beacon in result.new for figure in _of_beacon(beacon)),
        Figure("notes", notes, section=Section.NOTES),
    ]
    head = heading("design", settings.site.stem) | need_figures(
        after, settings.limits, of_sigma=settings.objective != "worst"
    )
    return head | Figures(*figures)


_OUT_OF_TIME = (
    "Search time limit reached: this is the best layout so far; increase --minutes, or continue"
    " from its site.yaml with --continue."
)
_OPEN = (
    "At some points there is no protection level: without one of the beacons the pose there is not"
    " determined. Place more beacons, or stronger ones."
)


def best_random_figures(result: Coverage) -> Figures:
    """Return the sigmas of the random layout that is best by the objective."""
    return Figures(
        *(
            replace(f, name=f"random_best_{f.name}", label=f"best random layout: {f.title}")
            for f in _sigma_figures(result)
        )
    )


def _sigma_figures(result: Coverage) -> list[Figure]:
    return [
        Figure(
            f"position_sigma_m_{key}",
            finite(result.position_quantile(share)),
            "m",
            label=f"position sigma, {key}",
        )
        for key, share in (("median", 0.5), ("worst", 1.0))
    ]


def _random_figures(worst_m: Array, reached_m: float) -> list[Figure]:
    """Return the figures of random layouts of the same candidates, and the design's gain."""
    if not len(worst_m):
        return []
    median, best = float(np.median(worst_m)), float(np.min(worst_m))
    return [
        Figure("random_layouts", len(worst_m)),
        Figure(
            "random_worst_level_m_median", finite(median), "m", label="their worst level, median"
        ),
        Figure("random_worst_level_m_best", finite(best), "m", label="their worst level, best"),
        Figure("gain_over_random_median", finite(1.0 - reached_m / median)),
        Figure("gain_over_random_best", finite(1.0 - reached_m / best)),
    ]


def _of_beacon(beacon: Beacon) -> list[Figure]:
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
        Figure(f"{{beacon}}.{key}", value, unit, name, label=_display_name(key))
        for key, value, unit in rows
    ]


def _display_name(key: str) -> str:
    return key.removesuffix("_m").removesuffix("_a_m2").removesuffix("_hz").replace("_", " ")
