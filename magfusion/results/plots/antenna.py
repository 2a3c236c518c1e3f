"""Pose errors of a tracker at surveyed poses, before and after its antennas' calibration."""

from pathlib import Path

from matplotlib.figure import Figure

from magfusion.calibration.antenna_tracking import PoseErrors
from magfusion.units import DEGREE

_BEFORE, _AFTER = "tab:orange", "tab:blue"


def write_antenna_plot(path: Path, before: PoseErrors, after: PoseErrors) -> None:
    """Write a PNG of the errors of every pose, in the survey's order."""
    figure = Figure(figsize=(10.0, 6.5), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    for axes, kind, unit, axis in (
        (panels[0], 0, DEGREE, "attitude (deg)"),
        (panels[1], 1, 1e-3, "position (mm)"),
    ):
        for errors, colour, name in ((before, _BEFORE, "before"), (after, _AFTER, "after")):
            own, survey = errors.rms[kind] / unit, errors.survey[kind] / unit
            label = f"{name}: {own:.3g} RMS excl. the survey's own {survey:.3g}"
            axes.plot(errors.difference[:, kind] / unit, "o", ms=4, c=colour, label=label)
            axes.axhline(own, c=colour, lw=0.8)
        axes.set(yscale="log", ylabel=axis)
        axes.legend()
    panels[1].set_xlabel("pose of the survey")
    figure.suptitle(
        "Difference of tracked and surveyed poses; after: antenna fitted without the pose"
    )
    figure.savefig(path, dpi=110, metadata={"Software": None})
