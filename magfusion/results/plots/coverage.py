"""The bound of the position as a picture: horizontal slices with the beacons in them."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from magfusion.model.site import Beacon, Site
from magfusion.results.coverage import Coverage
from magfusion.results.coverage_colours import COLOURS, bounds, length

SLICES = 3  # heights that are drawn where there are more


def write_plot(path: Path, site: Site, coverage: Coverage, extra: Beacon | None) -> None:
    """Write a PNG of the position sigma at the lowest, middle and highest heights.

    Parameters
    ----------
    coverage : Coverage
        On a regular grid.
    extra : Beacon, optional
        Best position of one more beacon; it is marked.
    """
    heights = np.unique(coverage.position_world[:, 2])
    drawn = heights[np.unique(np.linspace(0, len(heights) - 1, SLICES).astype(int))]
    figure = Figure(figsize=(1.0 + 5.0 * len(drawn), 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    levels = bounds(coverage)
    colours = ListedColormap([tuple(c / 255 for c in colour) for colour in COLOURS.values()])
    norm = BoundaryNorm(levels, len(COLOURS), extend="both")
    panels = figure.subplots(1, len(drawn), squeeze=False)[0]
    for axes, height in zip(panels, drawn, strict=True):
        here = coverage.position_world[:, 2] == height
        x, y = (np.unique(coverage.position_world[here, i]) for i in (0, 1))
        sigma = coverage.position_sigma[here].reshape(len(x), len(y)).T
        shown = np.ma.masked_invalid(sigma)
        axes.set_facecolor("0.8")
        mesh = axes.pcolormesh(x, y, shown, norm=norm, cmap=colours, shading="nearest")
        if np.all(np.isfinite(sigma)) and min(sigma.shape) > 1:
            axes.contour(x, y, sigma, levels=levels, colors="white", linewidths=0.6)
        _mark(axes, site, extra)
        axes.set(title=f"height {height:.3g} m", xlabel="x (m)", ylabel="y (m)", aspect="equal")
    bar = figure.colorbar(mesh, ax=list(panels), ticks=levels, shrink=0.85)
    bar.ax.set_yticklabels([length(level) for level in levels])
    bar.set_label("position sigma, three axes together")
    figure.suptitle(
        "Cramér-Rao bound of the position from one window; grey: not determined;\n"
        "beacons with their heights"
        + ("; star: best position of one more" if extra is not None else "")
    )
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _mark(axes: Axes, site: Site, extra: Beacon | None) -> None:
    for beacon in site.beacons:
        _place(axes, beacon, "^", 70)
    if extra is not None:
        _place(axes, extra, "*", 160)


def _place(axes: Axes, beacon: Beacon, marker: str, size: float) -> None:
    x, y, z = beacon.position_world
    axes.scatter(x, y, s=size, marker=marker, c="red", edgecolors="white", zorder=3, clip_on=False)
    axes.annotate(
        f"{beacon.name} ({z:.3g} m)",
        (x, y),
        xytext=(0, 8),
        textcoords="offset points",
        ha="center",
        fontsize=8,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.7, "linewidth": 0},
    )
