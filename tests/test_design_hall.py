"""Four beacons in an L-shaped hall beat random layouts by what is asked of a design."""

import pytest
from design_hall import Config, report, run


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
