"""A fingerprint survey as a picture: the amplitude of each beacon at its points in the plan."""

from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from magfusion.files.survey import Survey
from magfusion.model.site import Site
from magfusion.units import NANOTESLA, Array

COLUMNS = 3  # of panels


def write_survey_plot(path: Path, site: Site, survey: Survey) -> None:
    """Write a PNG with one panel for each beacon that the survey detected.

    `site`: its beacons are marked. `survey`: with at least one point.
    """
    panels = [(b, _amplitude_nt(survey, b.name)) for b in site.beacons]
    panels = [(b, amplitude) for b, amplitude in panels if np.isfinite(amplitude).any()]
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(1.0 + 4.5 * columns, 0.5 + 4.0 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    for axes, (beacon, amplitude) in zip(grid, panels, strict=False):
        detected = np.isfinite(amplitude)
        low, high = np.min(amplitude[detected]), np.max(amplitude[detected])
        x, y, _ = survey.position_world.T
        axes.scatter(x[~detected], y[~detected], s=18, marker="x", c="0.6", linewidths=0.8)
        dots = axes.scatter(
            x[detected],
            y[detected],
            s=22,
            c=amplitude[detected],
            norm=LogNorm(low, max(high, 1.01 * low)),
        )
        axes.scatter(*beacon.position_world[:2], s=70, marker="^", c="red", edgecolors="white")
        axes.set(title=beacon.name, xlabel="x (m)", ylabel="y (m)", aspect="equal")
        axes.margins(0.1)
        figure.colorbar(dots, ax=axes, shrink=0.8, label="RMS amplitude (nT)")
    figure.suptitle(f"{len(survey)} points; triangle: the beacon; crosses: points without it")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _amplitude_nt(survey: Survey, beacon: str) -> Array:
    """Return the amplitude at each point, NaN where the beacon was not detected."""
    own = [c for c, (name, _) in enumerate(survey.channels) if name == beacon]
    if survey.phasor_sensor is not None:
        power = 0.5 * np.sum(np.abs(survey.phasor_sensor[:, own]) ** 2, axis=2)
    else:
        assert survey.amplitude is not None
        power = survey.amplitude[:, own] ** 2
    total = np.sum(np.nan_to_num(power), axis=1)
    return np.asarray(np.where(total > 0.0, np.sqrt(total), np.nan) / NANOTESLA)
