"""Allan deviations of the instruments as a picture, with their noise components."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from magfusion.calibration.allan import AllanVariance
from magfusion.calibration.allan_fit import AllanFit

COLOURS = ("tab:red", "tab:green", "tab:blue")
Plotted = tuple[str, str, AllanVariance, tuple[AllanFit | None, ...]]


def write_allan_plot(path: Path, instruments: Sequence[Plotted]) -> None:
    """Write a PNG of the Allan deviation of each axis with its fit, one panel per instrument."""
    figure = Figure(figsize=(5.5 * len(instruments), 5.5))
    panels = figure.subplots(1, len(instruments), squeeze=False)[0]
    margin = 0.8 / (5.5 * len(instruments))
    figure.subplots_adjust(left=margin, right=1.0 - 0.2 * margin, top=0.93, bottom=0.1, wspace=0.22)
    for panel, (name, unit, result, fits) in zip(panels, instruments, strict=True):
        for axis, (colour, fit) in enumerate(zip(COLOURS, fits, strict=True)):
            deviation = np.sqrt(result.variance[:, axis])
            seen = deviation > 0.0
            spread = np.minimum(deviation / np.sqrt(2.0 * result.clusters), 0.9 * deviation)
            panel.errorbar(
                result.tau[seen],
                deviation[seen],
                spread[seen],
                fmt=".",
                ms=3,
                lw=0.6,
                color=colour,
                label="xyz"[axis],
            )
            if fit is not None:
                tau = np.geomspace(fit.first_tau, result.tau[-1], 200)
                panel.plot(tau, fit.deviation(tau), lw=1.0, color=colour)
        panel.set(title=name, xlabel="cluster time (s)")
        if np.any(result.variance > 0.0):
            panel.set(xscale="log", yscale="log")
        panel.set_ylabel(f"Allan deviation ({unit})")
        panel.minorticks_off()
        panel.grid(visible=True, lw=0.3, alpha=0.6)
        panel.legend(loc="upper right")
    figure.savefig(path, dpi=110, metadata={"Software": None})
