"""Figures of an error budget, where the position is worst and at the median point."""

import numpy as np

from magfusion.results.coverage import Coverage
from magfusion.results.coverage_colours import length
from magfusion.results.error_budget import ErrorBudget, limiting
from magfusion.results.figures import Figure, Figures, Section
from magfusion.units import IntArray

PLACES = ("worst", "median")


def worst_and_median(coverage: Coverage) -> IntArray:
    """Return the points of the worst and of the median sigma; none where all are undetermined."""
    known = np.flatnonzero(coverage.determined)
    if not len(known):
        return known
    order = known[np.argsort(coverage.position_sigma[known], kind="stable")]
    return np.array([order[-1], order[len(order) // 2]])


def budget_figures(budget: ErrorBudget, beacons: IntArray) -> Figures:
    """Return the table of an error budget at both points, and what limits at the worst.

    `beacons` (n,): number of beacons detected at each point.
    """
    figures = [
        Figure(
            f"error_budget_{place}",
            [f"{s} {100.0 * budget.share[k, i]:.0f} %" for i, s in enumerate(budget.sources)],
            label=f"error budget, {place}: {length(float(budget.sigma[k]))}",
        )
        for k, place in enumerate(PLACES)
    ]
    rows = [
        {
            "source": source,
            **{
                f"{place}_{key}": float(value)
                for k, place in enumerate(PLACES)
                for key, value in (
                    ("sigma_m", np.sqrt(budget.variance[k, i])),
                    ("share", budget.share[k, i]),
                    ("sigma_without_m", budget.without[k, i]),
                )
            },
        }
        for i, source in enumerate(budget.sources)
    ]
    return Figures(
        *figures,
        Figure("error_budget", rows, section=Section.REPORT),
        Figure("limit", [limiting(budget, 0, beacons)], section=Section.REMARKS),
    )
