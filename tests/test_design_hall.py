"""Four beacons in an L-shaped hall beat random layouts by what is asked of a design."""

from dataclasses import replace

import numpy as np
import pytest
from design_hall import Config, report, run, task_of

from magfusion.results.coverage import coverage
from magfusion.results.design.exchange import Objective
from magfusion.results.design.planning import designed


@pytest.mark.slow
def test_a_design_beats_the_median_of_random_layouts_and_the_best_of_them() -> None:
    result = run(Config(spacing=2.0, grid=2.0, starts=3, searches=1))
    assert result.gain_over_median > 0.3
    assert result.gain_over_best > 0.05
    # At points it was not designed for, too.
    assert result.fine_designed < 0.7 * result.fine_random_median
    low, middle, high = result.fix_over_predicted
    assert 0.9 < low < middle < high < 1.1
    assert 0.98 < middle < 1.02
    assert result.worst_sigma[2] < result.worst_sigma[0]  # for accuracy alone A is better
    assert "below the median" in report(result)


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["sigma", "A"])
def test_sigmas_of_a_design_are_at_most_those_of_the_best_random_layout(
    objective: Objective,
) -> None:
    """Worst and median sigma of four beacons, against the best of 200 by what is asked."""
    task = replace(task_of(Config(spacing=2.0, grid=2.0)), objective=objective)
    result = designed(task, starts=3, layouts=200, rng=np.random.default_rng(0))
    assert result.best_random is not None
    sites = (result.site, result.best_random)
    own, random = (coverage(s, task.points, task.band.window).position_sigma for s in sites)
    assert np.max(own) <= np.max(random)
    assert np.median(own) <= np.median(random)
