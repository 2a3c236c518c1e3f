"""Shares of an error budget add up, and what vanishes reduces the sigma by its share."""

import numpy as np
import pytest

from magfusion.results.coverage import coverage
from magfusion.results.error_budget import SOURCES, error_budget, limiting
from magfusion.simulation.demo_site import demo_site

POINTS = np.array([[3.0, 2.5, 1.0], [1.2, 3.8, 1.6]])  # m
WINDOW = 0.4  # s


def test_the_variances_of_all_sources_add_up_to_that_of_the_position() -> None:
    site = demo_site()
    budget = error_budget(site, POINTS, WINDOW)
    assert budget.sigma == pytest.approx(coverage(site, POINTS, WINDOW).position_sigma, abs=1e-12)
    assert np.sum(budget.share, axis=1) == pytest.approx([1.0, 1.0], abs=1e-4)
    assert np.all(budget.variance >= 0.0)
    # The estimate without a source is at least as good as with its contribution removed.
    assert np.all(budget.without**2 <= budget.sigma[:, None] ** 2 - budget.variance + 1e-12)


def test_a_source_without_sigma_is_not_in_the_budget() -> None:
    site = SOURCES["lever arm"](demo_site(), 0.0)
    budget = error_budget(site, POINTS, WINDOW)
    assert "lever arm" not in budget.sources
    assert "ground" not in budget.sources


def test_the_largest_source_is_named_as_the_limit() -> None:
    noisy = SOURCES["noise"](demo_site(), 20.0)
    budget = error_budget(noisy, POINTS, WINDOW)
    assert "limited by noise" in limiting(budget, 0, np.array([4, 4]))
    assert "geometry limits" in limiting(budget, 0, np.array([2, 4]))
