"""Passes that swing about their fixed point, on maps whose fixed point is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.estimation.posterior.convergence import pose_steps
from magfusion.estimation.posterior.fixed_point_acceleration import MIN_COUNT, Step, part_of_the_way
from magfusion.model.parameters import Calibration, choose_blocks, difference, initial_calibration
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site

CALIBRATION = initial_calibration(demo_site(), 0.0)
N = 20


def path(position_world: np.ndarray, rotvec: np.ndarray) -> Trajectory:
    still = np.zeros((N, 3))
    turn = Rotation.from_rotvec(rotvec).as_matrix()
    return Trajectory(np.arange(N) * 0.2, turn, position_world, still, still, still)


def max_iterations(slope: float, rounds: int, *, relaxed: bool) -> list[float]:
    """Return the distance from the fixed point after each pass of an affine map (m)."""
    rng = np.random.default_rng(4)
    there, states, last = rng.normal(size=(N, 3)), path(np.zeros((N, 3)), np.zeros((N, 3))), None
    calibration, remaining = CALIBRATION, []
    for _ in range(rounds):
        after = replace(states, position_world=there + slope * (states.position_world - there))
        new = replace(calibration, time_offset=1e-3 + slope * (calibration.time_offset - 1e-3))
        last = Step.of(last, states, after, calibration, new)
        share = last.share if relaxed else 1.0
        moved = states, after, calibration, new
        states, calibration = part_of_the_way(*moved, offset_blocks(), share)
        remaining.append(float(np.max(np.abs(states.position_world - there))))
    return remaining


def offset_blocks():
    return choose_blocks(CALIBRATION.site, ("time-offset",))


@pytest.mark.parametrize("slope", [-0.9, -1.2, -3.0])
def test_passes_that_swing_are_led_to_the_fixed_point(slope: float) -> None:
    assert (
        max_iterations(slope, 4, relaxed=True)[-1] < 1e-9
    )  # m; two steps tell the slope of a line
    assert max_iterations(slope, 4, relaxed=False)[-1] > 0.5


@pytest.mark.parametrize("slope", [0.0, 0.3, 0.9])
def test_passes_that_approach_from_one_side_are_left_alone(slope: float) -> None:
    assert max_iterations(slope, 6, relaxed=True) == max_iterations(slope, 6, relaxed=False)


def test_a_part_of_the_way_is_on_the_way() -> None:
    rng = np.random.default_rng(5)
    before = path(rng.normal(size=(N, 3)), rng.normal(size=(N, 3)))
    after = path(rng.normal(size=(N, 3)), rng.normal(size=(N, 3)))
    new: Calibration = replace(CALIBRATION, time_offset=0.02)
    blocks = offset_blocks()
    there, between = part_of_the_way(before, after, CALIBRATION, new, blocks, 0.25)
    whole, part = pose_steps(before, after), pose_steps(before, there)
    np.testing.assert_allclose(part, 0.25 * whole, atol=1e-12)
    assert difference(CALIBRATION, between, blocks)[0] == pytest.approx(0.005)  # s
    assert part_of_the_way(before, after, CALIBRATION, new, blocks, 1.0) == (after, new)


def test_a_step_is_never_shortened_to_nothing() -> None:
    states = path(np.zeros((N, 3)), np.zeros((N, 3)))
    away = replace(states, position_world=np.ones((N, 3)))
    first = Step.of(None, states, away, CALIBRATION, CALIBRATION)
    back = replace(away, position_world=away.position_world - 1e3)
    second = Step.of(first, away, back, CALIBRATION, CALIBRATION)
    assert second.share == MIN_COUNT
