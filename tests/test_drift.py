"""Slopes and verdicts against what is known of synthetic errors."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import t as student

from magfusion.results.drift import (
    THREE_SIGMA,
    ErrorSeries,
    Slope,
    common_slope,
    evenly,
    in_windows,
    settled_after,
    slope_of_one,
    slope_over_worlds,
    within,
)
from magfusion.units import DAY

MINUTES = 60.0 * np.arange(2880.0)


def correlated(rng, time_constant):
    """Return a stationary Gauss-Markov series of unit variance, a value a minute."""
    kept = np.exp(-60.0 / time_constant)
    drive = np.sqrt(1.0 - kept**2) * rng.standard_normal(len(MINUTES))
    drive[0] = rng.standard_normal()
    return lfilter([1.0], [1.0, -kept], drive)


def test_a_straight_line_has_its_slope_and_no_error():
    slope = slope_of_one(MINUTES, 3.0 + 0.7 * MINUTES / DAY)
    assert slope.per_day == pytest.approx(0.7, rel=1e-9)
    assert slope.standard_error < 1e-9


def outside(draws, draw, confidence):
    """Return how often the interval of one world's slope leaves out the true one, none."""
    left_out = 0
    for _ in range(draws):
        slope = slope_of_one(MINUTES[:180], draw())
        reach = student.ppf(0.5 + 0.5 * confidence, slope.freedom) * slope.standard_error
        left_out += abs(slope.per_day) > reach
    return left_out / draws


@pytest.mark.parametrize("hours", [1 / 60, 0.2, 1.0, 5.0])
def test_the_interval_of_one_world_holds_however_long_its_errors_are_alike(hours):
    """Of three hours: some may be left out by chance, 5 % and three deviations of 40 draws."""
    rng = np.random.default_rng(4)
    assert outside(40, lambda: correlated(rng, 3600.0 * hours)[:180], 0.95) <= 0.154


@pytest.mark.slow
def test_a_line_through_a_walk_is_no_drift():
    """As a bias walks: with blocks taken for independent one in two such walks drifts."""
    rng = np.random.default_rng(5)

    def walk():
        return np.cumsum(rng.standard_normal(180)) + 3.0 * rng.standard_normal(180)

    assert outside(80, walk, 0.999) <= 0.03
    blocks = np.stack([np.mean(walk().reshape(12, 15), axis=1) for _ in range(60)], axis=1)
    line, remaining, *_ = np.polyfit(np.arange(12.0), blocks, 1, full=True)
    standard_error = np.sqrt(
        remaining / 10.0 / 143.0
    )  # the sum of the squared distances of 12 blocks
    assert np.mean(np.abs(line[0]) > 2.23 * standard_error) > 0.4


def test_a_line_through_errors_that_forget_soon_is_found_at_once():
    rng = np.random.default_rng(6)
    slope = slope_of_one(MINUTES[:180], 80.0 * MINUTES[:180] / DAY + correlated(rng, 60.0)[:180])
    assert slope.verdict(5.0) == "fail"
    assert abs(slope.per_day - 80.0) < slope.margin


def test_the_interval_of_eight_worlds_holds_the_slope_as_often_as_it_says():
    rng = np.random.default_rng(5)
    fixed = []
    for _ in range(400):
        values = [0.3 * MINUTES / DAY + correlated(rng, 4.0 * 3600.0) for _ in range(8)]
        slope = slope_over_worlds([MINUTES] * 8, values)
        fixed.append(abs(slope.per_day - 0.3) < slope.margin)
    assert abs(np.mean(fixed) - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / 400)


@pytest.mark.parametrize(
    ("per_day", "error", "verdict"),
    [(0.01, 0.001, "pass"), (0.2, 0.01, "fail"), (-0.2, 0.01, "fail"), (0.01, 1.0, "undecided")],
)
def test_a_run_too_short_to_tell_has_not_passed(per_day, error, verdict):
    assert Slope(per_day, error, 10).verdict(0.1) == verdict


def test_a_slope_that_is_there_is_found_and_one_that_is_not_is_not():
    rng = np.random.default_rng(6)
    for true, verdict in ((0.0, "pass"), (2.0, "fail")):
        values = [true * MINUTES / DAY + correlated(rng, 600.0) for _ in range(8)]
        assert slope_over_worlds([MINUTES] * 8, values).verdict(0.5) == verdict


HOURS = 3600.0 * np.arange(48.0)


@pytest.mark.slow
def test_chance_alone_goes_beyond_three_standard_errors_as_rarely_as_it_says():
    rng = np.random.default_rng(9)
    correlations = np.array([[1.0, 0.0, 0.0], [0.9, 0.3, 0.0], [0.0, 0.5, 2.0]])
    draws = 3000
    result = [
        common_slope([HOURS] * 8, list(rng.standard_normal((8, 48, 3)) @ correlations)).probability
        for _ in range(draws)
    ]
    for level in (0.05, THREE_SIGMA):
        spread = np.sqrt(level * (1.0 - level) / draws)
        assert abs(np.mean(np.array(result) < level) - level) < 3.5 * spread


def test_what_goes_one_way_is_found_although_no_error_becomes_longer():
    """Half of the worlds err along the drift, half against it."""
    rng = np.random.default_rng(10)
    drift = np.outer(HOURS / DAY, [0.0, 0.3, 0.0])
    worlds = [
        [0.0, 5.0 * (-1.0) ** k, 0.0] + drift + 0.1 * rng.standard_normal((48, 3)) for k in range(8)
    ]
    length = slope_over_worlds([HOURS] * 8, [np.linalg.norm(w, axis=1) for w in worlds])
    assert abs(length.per_day) < 3.0 * length.standard_error
    common = common_slope([HOURS] * 8, worlds)
    assert common.verdict == "fail"
    within = 5.0 * common.standard_error.max()
    assert np.allclose(common.per_day, [0.0, 0.3, 0.0], rtol=0.0, atol=within)


def test_few_worlds_have_no_slope_in_common():
    with pytest.raises(ValueError, match="at least 5 worlds"):
        common_slope([HOURS] * 4, [np.zeros((48, 3))] * 4)


def test_an_interval_on_both_sides_of_a_limit_tells_nothing():
    assert within(0.0, 1.0, 2.0) == "pass"
    assert within(1.0, 3.0, 2.0) == "undecided"
    assert within(2.5, 3.0, 2.0) == "fail"


def test_too_few_values_have_no_slope():
    with pytest.raises(ValueError, match="three blocks"):
        slope_of_one(MINUTES[:2], np.zeros(2))


def a_series(time, measured):
    n = len(time)
    error = np.tile(np.arange(15.0), (n, 1))
    ones = np.ones(n)
    return ErrorSeries(np.array(time), np.array(measured), error, error + 1.0, ones, 2.0 * ones)


def test_walks_do_not_count_more_than_rests():
    series = a_series([60.0, 61.0, 62.0, 120.0, 180.0], [True, True, True, True, False])
    assert evenly(series, 60.0).time.tolist() == [60.0, 120.0]


def test_the_size_of_an_error_is_that_of_its_own_columns():
    series = a_series([0.0], [True])
    assert series.size(slice(3, 6))[0] == pytest.approx(np.sqrt(9.0 + 16.0 + 25.0))


def test_windows_have_their_own_means():
    means = in_windows(np.array([0.5, 0.6, 2.5]), np.array([1.0, 3.0, 7.0]), np.arange(4.0))
    assert means[0] == 2.0
    assert np.isnan(means[1])
    assert means[2] == 7.0


def test_slopes_begin_after_twelve_hours_or_a_quarter():
    assert settled_after(48.0) == 12.0 * 3600.0
    assert settled_after(2.0) == 0.5 * 3600.0
