"""The bound of the position as a picture: horizontal slices with the beacons in them."""

from pathlib import Path

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap

from magfusion.model.site import Beacon, Site
from magfusion.results.coverage import Coverage
from magfusion.results.coverage_colours import COLOURS, bounds, length
from magfusion.results.plots.plan import MARGIN, add_legend, draw_beacons, slices

SLICES = 3  # heights that are drawn where there are more


def write_plot(path: Path, site: Site, coverage: Coverage, extra: Beacon | None) -> None:
    """Write a PNG of the position sigma at the lowest, middle and highest heights.

    `coverage`: on a regular grid. `extra`: best position of one more beacon; it is marked.
    """
    places = coverage.position_world
    heights = np.unique(places[:, 2])
    drawn = heights[np.unique(np.linspace(0, len(heights) - 1, SLICES).astype(int))]
    beacons = [*site.beacons, *([] if extra is None else [extra])]
    every = np.vstack([places, *(b.position_world for b in beacons)])
    box = np.stack([every.min(axis=0), every.max(axis=0)])
    size = np.maximum(np.ptp(box[:, :2], axis=0), 1e-3)
    figure, (panels,) = slices(size, 1, len(drawn))
    levels = bounds(coverage)
    colours = ListedColormap([tuple(c / 255 for c in colour) for colour in COLOURS.values()])
    norm = BoundaryNorm(levels, len(COLOURS), extend="both")
    margin = MARGIN * float(np.max(size))
    for axes, height in zip(panels, drawn, strict=True):
        here = places[:, 2] == height
        x, y = (np.unique(places[here, i]) for i in (0, 1))
        sigma = coverage.position_sigma[here].reshape(len(x), len(y)).T
        shown = np.ma.masked_invalid(sigma)
        grey = np.where(np.isinf(sigma), 1.0, np.nan)
        axes.pcolormesh(x, y, grey, cmap=ListedColormap(["0.75"]), shading="nearest")
        mesh = axes.pcolormesh(x, y, shown, norm=norm, cmap=colours, shading="nearest")
        axes.set_title(f"height {height:.3g} m", fontsize=10, loc="left")
        axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
        axes.set(xlim=box[:, 0] + [-margin, margin], ylim=box[:, 1] + [-margin, margin])
    bar = figure.colorbar(mesh, ax=list(panels), ticks=levels, shrink=0.85)
    bar.ax.set_yticklabels([length(level) for level in levels])
    bar.set_label("position sigma, three axes together")
    for axes in panels:
        draw_beacons(axes, beacons, float(np.max(size)), marked=extra)
    add_legend(figure, panels, unknown="position not determined")
    figure.suptitle("Cramér-Rao bound of the position from one window", fontsize=11)
    figure.savefig(path, dpi=110, metadata={"Software": None})
