"""Errors over days as a picture: with their sigmas, their Allan deviation, memory and time."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from magfusion.calibration.allan import AllanStream
from magfusion.results.drift import QUANTITIES, EstimatorPlot, Quantity, in_windows, worlds_text
from magfusion.units import HOUR

_AXES = ("tab:red", "tab:green", "tab:blue")


def write_plot(path: Path, courses: list[EstimatorPlot], figures: Mapping[str, object]) -> None:
    """Write a PNG, a column for each estimator."""
    rows = len(QUANTITIES) + 3
    figure = Figure(figsize=(0.8 + 5.2 * len(courses), 2.4 * rows), layout="constrained")
    grid = figure.subplots(rows, len(courses), squeeze=False)
    for column, course in enumerate(courses):
        for row, quantity in enumerate(QUANTITIES):
            _draw_error(grid[row, column], course, quantity, figures)
        title = f"estimator {course.name}, first world\n{grid[0, column].get_title()}"
        grid[0, column].set_title(title, fontsize=9)
        _draw_consistency(grid[-3, column], course)
        _draw_allan(grid[-2, column], course)
        _draw_pace(grid[-1, column], course)
    for row in range(len(QUANTITIES)):  # one scale for both
        limits = np.array([axes.get_ylim() for axes in grid[row]])
        for axes in grid[row]:
            axes.set_ylim(limits[:, 0].min(), limits[:, 1].max())
    figure.suptitle(
        f"{figures['hours']:g} h, {worlds_text(figures['worlds'])}, {figures['drive']} drive, phase"
        f" {figures['phase']}, clock {figures['clock_ppm']:g} ppm: {figures['verdict']}"
    )
    figure.savefig(path, dpi=100, metadata={"Software": None})


def _draw_error(
    axes: Axes, course: EstimatorPlot, quantity: Quantity, figures: Mapping[str, object]
) -> None:
    """Draw the components of an error, and three of their sigmas."""
    hours = course.errors.time / HOUR
    error = quantity.scale * course.errors.error[:, quantity.part]
    sigma = 3.0 * quantity.scale * np.max(course.errors.sigma[:, quantity.part], axis=1)
    axes.fill_between(hours, -sigma, sigma, color="0.88", linewidth=0, label="3 sigma estimated")
    for name, colour, component in zip("xyz", _AXES, error.T, strict=True):
        axes.plot(hours, component, color=colour, linewidth=0.5, label=name)
    key = f"{course.name}_{quantity.name}"
    slope = figures[f"{key}_slope_{quantity.unit}_per_day"]
    axes.set_title(
        f"{quantity.name.replace('_', ' ')}: drift {slope:+.2g} ±"
        f" {figures[f'{key}_slope_standard_error']:.1g} {quantity.symbol} a day, bound"
        f" {quantity.limit:g}: {figures[f'{key}_drift_stability']}",
        fontsize=9,
    )
    bound = 1.05 * float(np.max(np.abs(np.column_stack([error, sigma]))))
    axes.set(ylabel=f"error ({quantity.symbol})", ylim=(-bound, 1.4 * bound), xlabel="time (h)")
    axes.axhline(0.0, color="0.5", linewidth=0.6)
    axes.legend(fontsize=7, ncols=4, loc="upper right")


def write_stability(path: Path, courses: list[EstimatorPlot]) -> None:
    """Write figures 9 and 10 of paper 004 as a PNG: lengths of the errors, and their hourly means.

    The paper shows a stationary place; here the platform walks once an hour.
    """
    figure = Figure(figsize=(0.8 + 4.6 * len(courses), 5.6), layout="constrained")
    grid = figure.subplots(2, len(courses), squeeze=False, sharex=True, sharey="row")
    for row, quantity in enumerate(QUANTITIES[:2]):
        for axes, course in zip(grid[row], courses, strict=True):
            _draw_length(axes, course, quantity)
            axes.set_title(f"{course.name}: {quantity.name}", fontsize=9)
        grid[row, 0].set_ylabel(f"error ({quantity.unit})")
    for axes in grid[-1]:
        axes.set_xlabel("time (h)")
    worlds = worlds_text(len(courses[0].worlds))
    figure.suptitle(f"Does the error grow?  Grey: each minute of {worlds}; blue: hourly mean")
    figure.savefig(path, dpi=100, metadata={"Software": None})


def _draw_length(axes: Axes, course: EstimatorPlot, quantity: Quantity) -> None:
    time = np.concatenate([w.time for w in course.worlds])
    length = quantity.scale * np.concatenate([w.size(quantity.part) for w in course.worlds])
    width = 0.3 if len(course.worlds) > 3 else 0.9  # few worlds leave room for their lines
    for world in course.worlds:
        own = quantity.scale * world.size(quantity.part)
        axes.plot(world.time / HOUR, own, linewidth=width, color="0.55")
    edges = HOUR * np.arange(np.ceil(time.max() / HOUR) + 1)
    middle = 0.5 * (edges[1:] + edges[:-1]) / HOUR
    axes.plot(middle, in_windows(time, length, edges), "o-", color="tab:blue", markersize=3)
    axes.set_ylim(0.0, 1.05 * float(np.max(length)))


def _draw_consistency(axes: Axes, course: EstimatorPlot) -> None:
    """Draw hourly means of squared errors and innovations relative to their expectation."""
    hours, levels = course.hourly()
    for name, level in levels.items():
        axes.plot(hours, level, ".-", markersize=3, linewidth=0.8, label=name)
    axes.axhline(1.0, color="0.5", linewidth=0.8)
    axes.set_title(
        "hourly squared errors over their expectation; 1: the sigmas are right", fontsize=9
    )
    own = np.concatenate([level[np.isfinite(level)] for level in levels.values()])
    limits = min(0.3, 0.8 * float(own.min())), max(3.0, 1.25 * float(own.max()))
    end = float(course.errors.time[-1]) / HOUR
    axes.set(xlabel="time (h)", ylabel="ratio", yscale="log", yticks=[0.1, 0.3, 1, 3, 10])
    axes.set(ylim=limits, xlim=(0.0, end))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.legend(fontsize=7, ncols=3)


def _draw_allan(axes: Axes, course: EstimatorPlot) -> None:
    """Draw the Allan deviation of each error."""
    for quantity in QUANTITIES:
        error = quantity.scale * course.errors.error[:, quantity.part]
        stream = AllanStream(error.shape[1])
        stream.add(error)
        result = stream.result(course.interval)
        if len(result.tau):
            label = f"{quantity.name.replace('_', ' ')} ({quantity.symbol})"
            deviation = np.sqrt(np.mean(result.variance, axis=1))
            axes.loglog(result.tau / HOUR, deviation, label=label)
    axes.set_title("Allan deviation of each error; a drift makes it rise to the right", fontsize=9)
    axes.set(xlabel="averaged over (h)", ylabel="see the legend")
    axes.set_ylim(top=300.0 * axes.get_ylim()[1])  # room for the legend
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, ncols=2, loc="upper right")


def _draw_pace(axes: Axes, course: EstimatorPlot) -> None:
    built = course.pace[course.pace[:, 2] > 0.0]
    axes.plot(built[:, 0] / HOUR, 1e3 * built[:, 1] / built[:, 2], ".", markersize=1, color="0.5")
    axes.set_title("cost: processor time of an update (dots), memory (line)", fontsize=9)
    axes.set(xlabel="time (h)", ylabel="an update (ms)", yscale="log")
    axes.yaxis.set_major_formatter("{x:g}")
    other = axes.twinx()
    other.plot(course.pace[:, 0] / HOUR, course.pace[:, 3], color="tab:purple")
    other.set_ylabel("memory (MiB)", color="tab:purple")
    other.set_ylim(0.0, 1.2 * float(np.max(course.pace[:, 3])))
