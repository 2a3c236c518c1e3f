"""Interpolation follows the motion, and says where it cannot."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.model.trajectory import Trajectory, interpolate, interpolated

RATE = np.array([0.4, -0.3, 1.2])  # rad/s
VELOCITY = np.array([1.0, -2.0, 0.5])  # m/s


def _screw(time: np.ndarray) -> Trajectory:
    """Return steady turning and steady travel, which slerp and lines follow exactly."""
    turns = Rotation.from_rotvec(time[:, None] * RATE).as_matrix()
    return Trajectory(time, turns, time[:, None] * VELOCITY)


def test_columns_are_on_straight_lines_and_held_at_the_ends() -> None:
    rng = np.random.default_rng(2)
    time, values = np.cumsum(rng.uniform(0.1, 1.0, 9)), rng.normal(size=(9, 4))
    wanted = np.sort(np.append(rng.uniform(-1.0, time[-1] + 1.0, 50), time[[0, -1]]))
    result = interpolated(wanted, time, values)
    for column, known in zip(result.T, values.T, strict=True):
        np.testing.assert_allclose(column, np.interp(wanted, time, known), rtol=0.0, atol=1e-12)


def test_steady_motion_is_interpolated_exactly() -> None:
    wanted = np.sort(np.random.default_rng(1).uniform(0.0, 10.0, 500))
    result, exists = interpolate(_screw(np.linspace(0.0, 10.0, 41)), wanted, 0.5)
    assert exists.all()
    expected = _screw(wanted)
    np.testing.assert_allclose(result.position_world, expected.position_world, atol=1e-13)  # m
    np.testing.assert_allclose(result.world_from_body, expected.world_from_body, atol=1e-14)


def test_a_gap_is_not_filled_but_its_edges_are_given() -> None:
    known = np.array([0.0, 0.1, 0.2, 1.2, 1.3])
    wanted = np.array([-0.1, 0.0, 0.15, 0.2, 0.21, 0.7, 1.19, 1.2, 1.25, 1.3, 1.31])
    result, exists = interpolate(_screw(known), wanted, 0.11)
    np.testing.assert_array_equal(exists, [0, 1, 1, 1, 0, 0, 0, 1, 1, 1, 0])
    np.testing.assert_array_equal(result.time, wanted[exists])
    np.testing.assert_allclose(result.position_world, wanted[exists, None] * VELOCITY, atol=1e-15)


@pytest.mark.parametrize("known", [0, 1])
def test_a_trajectory_without_steps_gives_only_what_it_has(known: int) -> None:
    wanted = np.array([-1.0, 0.0, 1.0])
    result, exists = interpolate(_screw(np.zeros(known)), wanted, 10.0)
    np.testing.assert_array_equal(exists, [False, known == 1, False])
    assert len(result) == known


def test_nothing_wanted_or_nothing_there_gives_nothing() -> None:
    known = _screw(np.array([0.0, 0.1]))
    for wanted in (np.empty(0), np.array([5.0])):
        result, exists = interpolate(known, wanted, 1.0)
        assert len(result) == 0
        assert exists.shape == wanted.shape
        assert not exists.any()
