"""Four beacons in an L-shaped hall beat random layouts by what is asked of a design."""

from dataclasses import replace

import numpy as np
import pytest
from design_hall import Config, report, run, task_of

from magfusion.model.hall import Hall, Mounts, mounting_places, points_of_use, prism_of
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
@pytest.mark.parametrize(
    ("objective", "size", "grid"),
    [
        ("sigma", (6.0, 5.0, 3.0), 1.5),
        ("sigma", (10.0, 8.0, 4.0), 2.0),
        ("A", (6.0, 5.0, 3.0), 1.5),
    ],
)
def test_a_design_is_no_worse_in_what_is_asked_than_the_best_random_layout(
    objective: Objective, size: tuple[float, float, float], grid: float
) -> None:
    """Worst and median sigma by `sigma`, mean variance by `A`: four beacons, the best of 200."""
    room = prism_of(np.array([[0.0, 0.0, 0.0], size]))
    hall = Hall(room, Mounts((0, 1, 2, 3), room.heights, ceiling=True), room, 0.5)
    task = replace(
        task_of(Config()),
        places=mounting_places(hall, grid),
        points=points_of_use(hall, grid),
        objective=objective,
        axes=3,
    )
    result = designed(task, starts=2, layouts=200, rng=np.random.default_rng(0))
    assert result.best_random is not None
    sites = (result.site, result.best_random)
    own, random = (coverage(s, task.points, task.band.window).position_sigma for s in sites)
    if objective == "sigma":
        assert np.max(own) <= np.max(random)
        assert np.median(own) <= np.median(random)
    else:
        assert np.mean(own**2) <= np.mean(random**2)
