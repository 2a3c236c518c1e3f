"""Errors over days as a picture: with their sigmas, their Allan deviation, memory and time."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from magfusion.evaluation.drift import QUANTITIES, Course, Quantity, allan_deviation

HOUR = 3600.0  # s
_AXES = ("tab:red", "tab:green", "tab:blue")


def write_plot(path: Path, courses: list[Course], figures: Mapping[str, object]) -> None:
    """Write a PNG, a column for each estimator."""
    rows = len(QUANTITIES) + 2
    figure = Figure(figsize=(1.0 + 6.5 * len(courses), 2.6 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, len(courses), squeeze=False)
    for column, course in enumerate(courses):
        for row, quantity in enumerate(QUANTITIES):
            _draw_error(grid[row, column], course, quantity, figures)
        title = f"{course.name}\n{grid[0, column].get_title()}"
        grid[0, column].set_title(title, fontsize=9)
        _draw_allan(grid[-2, column], course)
        _draw_pace(grid[-1, column], course)
    for row in range(len(QUANTITIES)):  # one scale for both
        limits = np.array([axes.get_ylim() for axes in grid[row]])
        for axes in grid[row]:
            axes.set_ylim(limits[:, 0].min(), limits[:, 1].max())
    figure.suptitle(
        f"{figures['hours']:g} h, {figures['worlds']} world(s), {figures['drive']} drive, phase"
        f" {figures['phase']}, clock {figures['clock_ppm']:g} ppm: {figures['verdict']}"
    )
    figure.savefig(path, dpi=100, metadata={"Software": None})


def _draw_error(
    axes: Axes, course: Course, quantity: Quantity, figures: Mapping[str, object]
) -> None:
    """Draw the components of an error, and three of their sigmas."""
    hours = course.errors.time / HOUR
    error = quantity.scale * course.errors.error[:, quantity.part]
    sigma = 3.0 * quantity.scale * np.max(course.errors.sigma[:, quantity.part], axis=1)
    axes.fill_between(hours, -sigma, sigma, color="0.88", linewidth=0, label="3 sigma")
    for name, colour, component in zip("xyz", _AXES, error.T, strict=True):
        axes.plot(hours, component, color=colour, linewidth=0.5, label=name)
    key = f"{course.name}_{quantity.name}"
    slope = figures[f"{key}_slope_{quantity.unit}_per_day"]
    axes.set_title(
        f"{quantity.name.replace('_', ' ')}: {slope:+.2g} +-"
        f" {figures[f'{key}_slope_standard_error']:.1g} {quantity.unit} a day,"
        f" {figures[f'{key}_drift_verdict']}",
        fontsize=9,
    )
    settled = hours >= float(str(figures["settled_after_h"]))
    shown = np.concatenate([np.abs(error[settled]).ravel(), sigma[settled]])
    bound = 1.3 * float(np.quantile(shown, 0.999))
    axes.set(ylabel=f"({quantity.unit})", ylim=(-bound, bound), xlabel="time (h)")
    axes.legend(fontsize=7, ncols=4, loc="upper right")


def _draw_allan(axes: Axes, course: Course) -> None:
    """Draw the Allan deviation of each error."""
    for quantity in QUANTITIES:
        error = quantity.scale * course.errors.error[:, quantity.part]
        time, deviation = allan_deviation(error, course.interval)
        if len(time):
            label = f"{quantity.name.replace('_', ' ')} ({quantity.unit})"
            axes.loglog(time / HOUR, deviation, label=label)
    axes.set(xlabel="averaged over (h)", ylabel="Allan deviation")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)


def _draw_pace(axes: Axes, course: Course) -> None:
    made = course.pace[course.pace[:, 2] > 0.0]
    axes.plot(made[:, 0] / HOUR, 1e3 * made[:, 1] / made[:, 2], ".", markersize=1, color="0.5")
    axes.set(xlabel="time (h)", ylabel="an update (ms)", yscale="log")
    other = axes.twinx()
    other.plot(course.pace[:, 0] / HOUR, course.pace[:, 3], color="tab:purple")
    other.set_ylabel("memory (MiB)", color="tab:purple")
    other.set_ylim(0.0, 1.2 * float(np.max(course.pace[:, 3])))
