"""Calibrated beacons as a picture: estimated and surveyed centres, and residuals."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from magfusion.model.site import Beacon
from magfusion.units import Array

_VIEWS = ((0, 1), (0, 2))  # plan and elevation


@dataclass(frozen=True, eq=False)
class BeaconPanel:
    """One beacon of the picture."""

    declared: Beacon
    estimated: Beacon
    centre_cov: Array  # (3, 3), of the estimated centre, world axes (m^2)
    point: Array  # (n,), index of each point of the survey
    residual: Array  # (n,), whitened, root of the mean square at each point


def write_beacon_plot(path: Path, panels: list[BeaconPanel]) -> None:
    """Write a PNG with one row for each beacon: plan, elevation, and the points' residuals."""
    figure = Figure(figsize=(13.0, 0.6 + 4.0 * len(panels)), layout="constrained")
    rows = figure.subplots(len(panels), 3, squeeze=False)
    for row, panel in zip(rows, panels, strict=True):
        for axes, view in zip(row, _VIEWS, strict=False):
            _centre(axes, panel, view)
        _residuals(row[2], panel)
    figure.suptitle("Magnetic centres, relative to the surveyed; ellipses and boxes: 3 sigma")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _centre(axes: Axes, panel: BeaconPanel, view: tuple[int, int]) -> None:
    plane = list(view)
    moved_mm = 1e3 * (panel.estimated.position_world - panel.declared.position_world)[plane]
    spread, turn = np.linalg.eigh(panel.centre_cov[np.ix_(plane, plane)])
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    ellipse_mm = moved_mm[:, None] + 3e3 * turn @ (np.sqrt(spread)[:, None] * circle)
    width, height = 3e3 * panel.declared.sigma.position_world[plane]
    axes.plot(
        [-width, width, width, -width, -width], [-height, -height, height, height, -height], "0.6"
    )
    axes.plot(0.0, 0.0, "s", color="0.4", label="surveyed")
    axes.plot(*ellipse_mm, "tab:red")
    axes.plot(*moved_mm, "^", color="tab:red", label="found")
    first, second = ("xyz"[i] for i in view)
    title = f"{panel.declared.name}, from {'above' if view == _VIEWS[0] else 'the side'}"
    axes.set(title=title, xlabel=f"{first} (mm)", ylabel=f"{second} (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="upper right", fontsize=8)


def _residuals(axes: Axes, panel: BeaconPanel) -> None:
    axes.bar([str(point) for point in panel.point], panel.residual, color="tab:blue")
    axes.axhline(1.0, color="0.4", linewidth=0.8)
    axes.set(title="residual over its sigma, rms", xlabel="point")
    if len(panel.point) > 20:
        axes.set_xticks([])
