"""Effect of a log on the survey's sigmas, as a picture: prior against posterior."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from magfusion.results.figures import DETERMINED_RATIO, ParameterEstimate
from magfusion.units import Array

_PRIOR, _POSTERIOR, _REST = "0.75", "tab:blue", "tab:orange"
HIGHEST = 60.0  # inches; what libpng and a reader bear


def write_log_calibration_plot(
    path: Path,
    estimates: list[ParameterEstimate],
    ratio_but_for_gauge: Array,
    direction_ratio: Array,
) -> None:
    """Write a PNG: the ratio of posterior to prior sigma of each parameter and each direction.

    `estimates`: every parameter. `ratio_but_for_gauge` (parameters,): the same without gauges; NaN
    where nothing remains. `direction_ratio` (parameters,): ascending.
    """
    height = min(1.5 + 0.22 * len(estimates), HIGHEST)
    figure = Figure(figsize=(12.0, height), layout="constrained")
    remaining, right = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
    rows = np.arange(len(estimates))
    ratio = np.array([e.sigma / e.prior_sigma for e in estimates])
    remaining.barh(rows, np.ones(len(estimates)), color=_PRIOR, label="survey")
    remaining.barh(rows, ratio, color=_POSTERIOR, height=0.55, label="after the log")
    remaining.plot(ratio_but_for_gauge, rows, "o", ms=4, c=_REST, label="without the common frame")
    labels = [f"{e.key}   {e.prior_sigma:.2g} → {e.sigma:.2g}" for e in estimates]
    remaining.set_yticks(rows, labels, fontsize=7)
    remaining.set(ylim=(len(estimates) - 0.5, -0.5))
    right.plot(direction_ratio, np.arange(len(direction_ratio)) + 1, ".-", c=_POSTERIOR)
    right.set(ylabel="direction in the space of all parameters, best first")
    for axes in (remaining, right):
        axes.set(xscale="log", xlabel="sigma after the log, of that of the survey")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{share:g}"))
        axes.xaxis.set_minor_formatter("")
        axes.axvline(DETERMINED_RATIO, c="0.2", ls="--", lw=1.0)
    remaining.plot([], [], c="0.2", ls="--", lw=1.0, label="below: determined by the log")
    figure.legend(loc="outside lower center", ncols=4, fontsize=9)
    figure.suptitle("Observability of the calibration from the log")
    figure.savefig(path, dpi=110, metadata={"Software": None})
