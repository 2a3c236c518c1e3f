"""Charts of pages, drawn by matplotlib for a program or a notebook."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from magfusion.results.plots.chart import Chart

# The colours of these names in the style sheet of pages.
COLOURS = {
    "estimate": "#1f5fbf",
    "truth": "#111111",
    "error": "#c0392b",
    "sigma": "#1f5fbf",
    "level": "#c98a00",
    "expected": "#1a7f37",
    "beacon": "#7b3fb0",
    "start": "#1a7f37",
}
BAND = "#c9d8ee"
DASHED = {"truth", "expected"}


def draw_charts(charts: list[Chart]) -> NDArray[np.object_]:
    """Return the axes of a new figure of `matplotlib.pyplot`, one for each chart, two a row."""
    rows = (len(charts) + 1) // 2
    figure = plt.figure(figsize=(11.0, 3.6 * rows), layout="constrained")
    axes = [figure.add_subplot(rows, 2, k + 1) for k in range(len(charts))]
    for one, chart in zip(axes, charts, strict=True):
        draw(one, chart)
    return np.array(axes, dtype=object)


def draw(axes: Axes, chart: Chart) -> None:
    """Draw one chart."""
    for band in chart.bands:
        axes.fill_between(band.x, band.low, band.high, color=BAND, label=band.label)
    for line in chart.lines:
        style = "." if line.dots else "--" if line.colour in DASHED else "-"
        axes.plot(line.x, line.y, style, color=COLOURS[line.colour], label=line.label, lw=1.2)
    for mark in chart.marks:
        axes.plot(mark.x, mark.y, "o", color=COLOURS[mark.colour])
        axes.annotate(mark.label, (mark.x, mark.y), (6, 5), textcoords="offset points")
    axes.set(title=chart.title, xlabel=chart.x_label, ylabel=chart.y_label)
    if chart.log:
        axes.set_yscale("log")
    if chart.equal:
        axes.set_aspect("equal", adjustable="datalim")
    if chart.y_limits is not None:
        axes.set_ylim(*chart.y_limits)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=8)
    axes.grid(visible=True, alpha=0.3)
