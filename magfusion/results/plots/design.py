"""A design as a picture: the protection level before and after, in slices of the hall."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from magfusion.model.hall import Hall
from magfusion.model.site import Beacon, Site
from magfusion.results.coverage import Coverage
from magfusion.results.coverage_colours import COLOURS, bounds_of, length
from magfusion.results.design.pattern import pattern_axis
from magfusion.units import Array

SLICES = 2  # heights that are drawn where there are more


@dataclass(frozen=True, eq=False)
class Panel:
    """One layout with its map, which includes protection levels."""

    words: str
    site: Site
    coverage: Coverage

    @property
    def level(self) -> Array:
        """Protection levels of the position (m), infinite where there is none."""
        level = self.coverage.protection_level_m
        return np.full(len(self.coverage), np.inf) if level is None else level


def write_plot(path: Path, hall: Hall, panels: list[Panel]) -> None:
    """Write a PNG of the protection levels of layouts, one per row, in the same colours.

    Parameters
    ----------
    panels : list of Panel
        Of the same points.
    """
    points = panels[0].coverage.position_world
    heights = np.unique(points[:, 2])
    drawn = heights[np.unique(np.linspace(0, len(heights) - 1, SLICES).astype(int))]
    size = np.ptp(hall.room.polygon, axis=0)
    tall = float(np.clip(5.5 * size[1] / size[0], 2.5, 7.0))
    figure = Figure(
        figsize=(1.5 + 6.0 * len(drawn), 1.0 + (tall + 0.9) * len(panels)), layout="constrained"
    )
    FigureCanvasAgg(figure)
    both = np.concatenate([panel.level for panel in panels])
    levels = bounds_of(both[np.isfinite(both)])
    colours = ListedColormap([tuple(c / 255 for c in colour) for colour in COLOURS.values()])
    norm = BoundaryNorm(levels, len(COLOURS), extend="both")
    every = figure.subplots(len(panels), len(drawn), squeeze=False)
    for row, panel in zip(every, panels, strict=True):
        for axes, height in zip(row, drawn, strict=True):
            x, y, level = _grid(points, panel.level, float(height))
            axes.set_facecolor("white")
            grey = np.where(np.isinf(level), 1.0, np.nan)
            axes.pcolormesh(x, y, grey, cmap=ListedColormap(["0.75"]), shading="nearest")
            shown = np.ma.masked_invalid(level)
            mesh = axes.pcolormesh(x, y, shown, norm=norm, cmap=colours, shading="nearest")
            _mark_worst(axes, points, panel.level, float(height))
            _outline(axes, hall)
            reach = 0.05 * float(np.max(size))
            for beacon in panel.site.beacons:
                _place(axes, beacon, reach)
            _label(axes, panel.site, 0.5 * reach)
            axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
            low, high = hall.room.box_world[:, :2] + 1.5 * reach * np.array([[-1.0], [1.0]])
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            axes.set_title(f"{panel.words}\nat height {height:.3g} m; {_worst(panel)}", fontsize=10)
    bar = figure.colorbar(mesh, ax=every.tolist()[0] + every.tolist()[-1], ticks=levels, shrink=0.7)
    bar.ax.set_yticklabels([length(level) for level in levels])
    bar.set_label("protection level of the position")
    figure.suptitle(
        "Bound of a fix's error with one undetected beacon fault; grey: no protection level\n"
        "triangles: beacons with height, line: their axis (none: vertical); cross: worst here",
        fontsize=10,
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
    axes.plot(x, y, "x", color="white", markersize=8, markeredgewidth=1.2)


def _outline(axes: Axes, hall: Hall) -> None:
    axes.add_patch(Polygon(hall.room.polygon, fill=False, edgecolor="black", linewidth=1.5))
    for prism in hall.mounts.forbidden:
        axes.add_patch(
            Polygon(prism.polygon, fill=False, edgecolor="tab:red", hatch="//", linewidth=0.8)
        )


def _place(axes: Axes, beacon: Beacon, reach: float) -> None:
    x, y, _ = beacon.position_world
    axis = pattern_axis(beacon)
    if axis is not None:
        way = reach * (beacon.world_from_beacon @ axis)[:2]
        axes.plot([x - way[0], x + way[0]], [y - way[1], y + way[1]], color="red", clip_on=False)
    axes.scatter(x, y, s=60, marker="^", c="red", edgecolors="white", zorder=3, clip_on=False)


def _label(axes: Axes, site: Site, near: float) -> None:
    """Write names and heights; those of beacons close to each other are stacked."""
    groups: list[list[Beacon]] = []
    for beacon in site.beacons:
        place = beacon.position_world[:2]
        others = (g for g in groups if np.linalg.norm(g[0].position_world[:2] - place) < near)
        group = next(others, None)
        if group is None:
            groups.append([beacon])
        else:
            group.append(beacon)
    for number, group in enumerate(groups):
        x, y, _ = group[0].position_world.tolist()
        above = number % 2 == 0  # those of neighbours would lie on each other
        axes.annotate(
            "\n".join(f"{b.name} ({b.position_world[2]:.3g} m)" for b in group),
            (x, y),
            xytext=(0, 8 if above else -8),
            va="bottom" if above else "top",
            textcoords="offset points",
            ha="center",
            fontsize=8,
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.7, "linewidth": 0},
        )
