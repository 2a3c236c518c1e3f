"""A design as a picture: the protection level before and after, in slices of the hall."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap

from magfusion.model.hall import Hall
from magfusion.model.site import Site
from magfusion.results.coverage import Coverage
from magfusion.results.coverage_colours import COLOURS, bounds_of, length
from magfusion.results.plots.plan import add_legend, clip_to_hall, draw_beacons, draw_hall, slices
from magfusion.units import Array

SLICES = 2  # heights that are drawn where there are more


@dataclass(frozen=True, eq=False)
class Panel:
    """One layout with its map, which includes protection levels.

    `of_sigma`: whether position sigmas are shown, instead of protection levels.
    """

    words: str
    site: Site
    coverage: Coverage
    of_sigma: bool = False

    @property
    def level(self) -> Array:
        """What is shown of the position (m), infinite where there is none."""
        if self.of_sigma:
            return self.coverage.position_sigma
        level = self.coverage.protection_level_m
        return np.full(len(self.coverage), np.inf) if level is None else level


def write_plot(path: Path, hall: Hall, panels: list[Panel]) -> None:
    """Write a PNG of the protection levels of layouts, in the same colours.

    Slices are in a row for each layout, or below each other where the hall is long in x. `panels`:
    of the same points.
    """
    points = panels[0].coverage.position_world
    heights = np.unique(points[:, 2])
    drawn = heights[np.unique(np.linspace(0, len(heights) - 1, SLICES).astype(int))]
    size = np.ptp(hall.room.polygon, axis=0)
    figure, axes_of = slices(size, len(panels), len(drawn))
    both = np.concatenate([panel.level for panel in panels])
    levels = bounds_of(both[np.isfinite(both)])
    colours = ListedColormap([tuple(c / 255 for c in colour) for colour in COLOURS.values()])
    norm = BoundaryNorm(levels, len(COLOURS), extend="both")
    for row, panel in enumerate(panels):
        for column, height in enumerate(drawn):
            axes = axes_of[row][column]
            x, y, level = _grid(points, panel.level, float(height))
            draw_hall(axes, hall)
            grey = np.where(np.isinf(level), 1.0, np.nan)
            axes.pcolormesh(x, y, grey, cmap=ListedColormap(["0.75"]), shading="nearest")
            shown = np.ma.masked_invalid(level)
            mesh = axes.pcolormesh(x, y, shown, norm=norm, cmap=colours, shading="nearest")
            clip_to_hall(axes, hall)
            _mark_worst(axes, points, panel.level, float(height))
            axes.set_title(f"{panel.words}\nat height {height:.3g} m; {_worst(panel)}", fontsize=10)
    every = [axes for row in axes_of for axes in row]
    bar = figure.colorbar(mesh, ax=every, ticks=levels, shrink=0.7)
    bar.ax.set_yticklabels([length(level) for level in levels])
    what = "position sigma" if panels[0].of_sigma else "protection level of the position"
    bar.set_label(what)
    for row, panel in enumerate(panels):
        for axes in axes_of[row]:
            draw_beacons(axes, panel.site.beacons, float(np.max(size)))
    add_legend(figure, every, unknown=f"no {what}", blank="hall: no point of use")
    figure.suptitle(
        "Position sigma of a fix, three axes together"
        if panels[0].of_sigma
        else "Bound of a fix's error with one undetected beacon fault",
        fontsize=11,
    )
    figure.savefig(path, dpi=100, metadata={"Software": None})


def _worst(panel: Panel) -> str:
    worst = float(np.max(panel.level))
    return f"worst anywhere {length(worst)}" if np.isfinite(worst) else "somewhere none"


def _grid(points: Array, level: Array, height: float) -> tuple[Array, Array, Array]:
    """Return x, y and the level on their grid, NaN where there is no point."""
    here = points[:, 2] == height
    x, y = np.unique(points[here, 0]), np.unique(points[here, 1])
    out = np.full((len(y), len(x)), np.nan)
    columns, rows = np.searchsorted(x, points[here, 0]), np.searchsorted(y, points[here, 1])
    out[rows, columns] = level[here]
    return x, y, out


def _mark_worst(axes: Axes, points: Array, level: Array, height: float) -> None:
    here = np.flatnonzero(points[:, 2] == height)
    x, y, _ = points[here[int(np.argmax(level[here]))]]
    axes.plot(x, y, "x", color="black", markersize=9, markeredgewidth=2.5)
    axes.plot(
        x, y, "x", color="white", markersize=8, markeredgewidth=1.2, label="worst at this height"
    )
