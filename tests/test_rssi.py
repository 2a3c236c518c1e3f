"""Lines, ranges and trilateration: exact where they must be, and the least misfit elsewhere."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from magfusion.errors import EstimationError
from magfusion.model.physics.dipole import dipole_field
from magfusion.papers.p004_fingerprints.equations import distances
from magfusion.papers.p004_fingerprints.rssi import (
    fit_block_lines,
    fit_lines,
    ranges_from_lines,
    ranges_from_minor_axis,
    trilaterate,
    trilaterate_from_both_sides,
)
from magfusion.receiver.ellipse import rms_amplitude, semi_axes

FLAT = np.array([[0.0, 0.0, 0.0], [6.2, 0.54, 0.0], [3.2, 4.28, 0.0]])  # m
SOLID = np.vstack([FLAT, [[1.0, 4.0, 2.5]]])  # m
MIDDLE = np.array([3.0, 1.5, 0.5])  # m


def test_every_epoch_of_a_batch_is_located_exactly_on_the_side_of_its_start() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([0.6, 0.6, -1.5], [5.1, 3.9, 1.5], (500, 3))
    start = points + rng.uniform(-1.0, 1.0, points.shape) * [1.0, 1.0, 0.0]
    result = trilaterate(distances(points, FLAT).reshape(50, 10, 3), FLAT, start.reshape(50, 10, 3))
    np.testing.assert_allclose(result.reshape(-1, 3), points, rtol=0, atol=1e-6)  # m


def test_a_beacon_out_of_the_plane_decides_between_the_sides_wherever_the_start_is() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform([0.6, 0.6, 0.2], [5.1, 3.9, 1.5], (200, 3))
    ranges = distances(points, SOLID)
    result = trilaterate_from_both_sides(ranges, SOLID, MIDDLE * [1.0, 1.0, -4.0])
    np.testing.assert_allclose(result, points, rtol=0, atol=1e-7)  # m


def test_one_plane_leaves_the_side_to_the_start() -> None:
    ranges = distances(MIDDLE, FLAT)
    for side in (1.0, -1.0):
        start = np.array([2.0, 2.0, side])
        result = trilaterate_from_both_sides(ranges, FLAT, start)
        np.testing.assert_allclose(result, MIDDLE * [1.0, 1.0, side], rtol=0, atol=1e-9)  # m


def test_ranges_that_do_not_meet_are_fitted_as_well_as_a_general_solver_does() -> None:
    rng = np.random.default_rng(3)
    ranges = distances(MIDDLE, FLAT) * np.exp(rng.normal(0.0, 0.4, (100, 3)))
    result = trilaterate(ranges, FLAT, MIDDLE)
    in_plane = np.abs(result[:, 2]) < 1e-6  # where the ranges are too short to leave it
    assert 10 < np.sum(in_plane) < 90
    misfit = np.sum((distances(result, FLAT) - ranges) ** 2, axis=1)
    for r, ours in zip(ranges, misfit, strict=True):
        other = least_squares(lambda p, r=r: distances(p, FLAT) - r, MIDDLE, xtol=1e-12, ftol=1e-12)
        assert ours <= 2.0 * other.cost + 1e-9  # m^2


def test_a_range_that_is_missing_is_refused() -> None:
    with pytest.raises(EstimationError, match="every beacon"):
        trilaterate(np.array([1.0, np.nan, 2.0]), FLAT, MIDDLE)


def test_the_minor_axis_gives_the_range_in_every_direction_and_the_rms_does_not() -> None:
    rng = np.random.default_rng(4)
    direction = rng.standard_normal((300, 3))
    reach = rng.uniform(1.0, 6.0, 300)  # m
    offset = reach[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    x, y = (dipole_field(offset, 65.0 * np.eye(3)[axis]) for axis in (0, 1))
    minor = semi_axes(x - 1j * y)[:, :1]
    result = ranges_from_minor_axis(minor, np.array([65.0]))[:, 0]
    np.testing.assert_allclose(result, reach, rtol=1e-9)
    constant = rms_amplitude(x - 1j * y) * reach**3
    # From pole to equator: paper 004, Eq 14, takes it for a constant.
    assert np.ptp(np.cbrt(constant)) / np.min(np.cbrt(constant)) == pytest.approx(0.165, abs=0.01)


def _survey(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return points, and amplitudes by a line of their own in each block of 2 m."""
    points = rng.uniform([0.0, 0.0, 0.5], [6.0, 4.0, 0.6], (200, 3))
    block = np.floor(points[:, :2] / 2.0)
    slope = -3.0 + 0.1 * block[:, :1]
    intercept = -12.0 + 0.2 * block[:, 1:]
    return points, np.exp(slope * np.log(distances(points, FLAT)) + intercept)


def test_each_block_has_the_line_of_its_own_points() -> None:
    points, amplitude = _survey(np.random.default_rng(5))
    lines = fit_block_lines(points, FLAT, amplitude, size=2.0)
    here = lines.at(np.array([[1.0, 3.0, 0.5], [5.0, 1.0, 0.5], [2.0, 2.0, 0.5]]))
    np.testing.assert_allclose(here.slope, [[-3.0] * 3, [-2.8] * 3, [-2.9] * 3], rtol=1e-9)
    np.testing.assert_allclose(here.intercept, [[-11.8] * 3, [-12.0] * 3, [-11.8] * 3], rtol=1e-9)
    result = ranges_from_lines(lines.at(points), amplitude)
    np.testing.assert_allclose(result, distances(points, FLAT), rtol=1e-9)


def test_a_block_with_too_few_points_keeps_the_overall_line() -> None:
    points, amplitude = _survey(np.random.default_rng(6))
    amplitude[(points[:, 0] > 4.0) & (points[:, 1] > 2.0), 1] = np.nan  # of one beacon
    lines = fit_block_lines(points, FLAT, amplitude, size=2.0)
    overall = fit_lines(distances(points, FLAT), amplitude)
    here = lines.at(np.array([5.0, 3.0, 0.5]))
    assert here.slope[1] == overall.slope[1]
    assert here.slope[0] == pytest.approx(-2.8, rel=1e-9)
    outside = lines.at(np.array([-9.0, 3.0, 0.5]))
    np.testing.assert_array_equal(outside.slope, overall.slope)
