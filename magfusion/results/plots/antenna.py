"""Pose errors of a tracker at surveyed poses, before and after its antennas' calibration."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from magfusion.units import DEGREE, Array

_BEFORE, _AFTER = "tab:orange", "tab:blue"


def write_antenna_plot(path: Path, before: tuple[Array, Array], after: tuple[Array, Array]) -> None:
    """Write a PNG of the errors of every pose, sorted by none but the survey's order.

    Parameters
    ----------
    before, after : tuple of ndarray, each of shape (n,)
        Attitude (rad) and position (m).
    """
    figure = Figure(figsize=(10.0, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 1, sharex=True)
    for axes, kind, unit, label in (
        (panels[0], 0, DEGREE, "attitude (deg)"),
        (panels[1], 1, 1e-3, "position (mm)"),
    ):
        for errors, colour, name in ((before, _BEFORE, "before"), (after, _AFTER, "after")):
            value = errors[kind] / unit
            mean = float(np.sqrt(np.mean(value**2)))
            axes.plot(value, "o", ms=4, c=colour, label=f"{name}: {mean:.3g} RMS")
            axes.axhline(mean, c=colour, lw=0.8)
        axes.set(yscale="log", ylabel=label)
        axes.legend()
    panels[1].set_xlabel("pose of the survey")
    figure.suptitle(
        "Difference of tracked and surveyed poses; after: by an antenna fitted without the pose"
    )
    figure.savefig(path, dpi=110, metadata={"Software": None})
