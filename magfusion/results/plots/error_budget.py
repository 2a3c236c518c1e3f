"""An error budget as a picture: the variance by source where the position is worst, and usually."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from magfusion.results.coverage_colours import length
from magfusion.results.error_budget import ErrorBudget


def write_budget_plot(path: Path, budget: ErrorBudget, titles: tuple[str, ...]) -> None:
    """Write a PNG with a panel for each point of the budget.

    `titles`: description of each point.
    """
    count = len(budget.sources)
    figure = Figure(figsize=(5.2 * len(titles) + 1.0, 1.9 + 0.5 * count), layout="constrained")
    rows = np.arange(count)[::-1]
    every = figure.subplots(1, len(titles), squeeze=False, sharey=True)[0]
    for k, (axes, title) in enumerate(zip(every, titles, strict=True)):
        share = 100.0 * budget.share[k]
        axes.barh(rows, share, color="tab:blue", label="share of the variance")
        for row, percent, without in zip(rows, share, budget.without[k], strict=True):
            text = f"{percent:.0f} %; without it {length(float(without))}"
            axes.text(percent + 1.5, row, text, va="center", fontsize=9)
        axes.set_yticks(rows, budget.sources)
        axes.set(xlim=(0.0, 165.0), xlabel="share of the position's variance (%)")
        axes.set_xticks(np.arange(0, 101, 25))
        x, y, z = budget.position_world[k]
        place = f"({x:.3g}, {y:.3g}, {z:.3g}) m"
        axes.set_title(
            f"{title}, at {place}:\nposition sigma {length(float(budget.sigma[k]))}", fontsize=10
        )
    figure.suptitle("Error budget of a fix; the shares add up to 100 %", fontsize=11)
    figure.savefig(path, dpi=100, metadata={"Software": None})
