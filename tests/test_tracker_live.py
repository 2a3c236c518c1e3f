"""A tracker of wound coils in time slots, raw samples at 20 kHz through the pipe."""

import pytest
import tracker_live as live
from tracker_head import RESTING, TURNING, Config


@pytest.mark.slow
def test_a_wound_tracker_is_followed_through_the_pipe() -> None:
    found = live.run(Config(duration=TURNING + 2.0, seed=1))
    assert found.states_per_s > 118.0
    assert found.rest_mm < 1.0
    assert found.rest_deg < 0.15
    assert found.turned_deg_s > 80.0
    assert found.turning_mm < 1.5
    assert found.turning_deg < 0.25
    assert found.ahead_mm < 2.0
    assert found.ahead_deg < 0.3


@pytest.mark.slow
def test_a_plate_that_is_moved_beside_the_head_is_said_and_the_sigmas_hold() -> None:
    found = live.run_beside_plate(Config(duration=live.PLATE_RUN, plate=True, seed=2))
    assert found.largest_share > 0.03
    assert found.wrongly_said == 0
    assert found.said_after_s < 1.0
    assert found.poses == 1.0
    assert found.nees < 12.0
    assert found.after_nees < 12.0
    assert found.after_mm < 1.0


@pytest.mark.slow
def test_the_side_of_the_source_is_found_by_motion_or_said_to_be_ambiguous() -> None:
    found = live.run_without_hemisphere(Config(duration=RESTING + 2.5, seed=1))
    assert found.first_s < 5.0
    assert found.wrong == 0.0
    assert found.ambiguous < 1.0
    assert found.mm < 1.5


@pytest.mark.slow
def test_a_tracker_without_an_imu_is_followed_through_the_pipe() -> None:
    config = Config(duration=TURNING + 2.0, seed=1, inertial=False, rate_hz=60.0)
    found = live.run(config)
    assert found.states_per_s > 59.0
    assert found.rest_mm < 1.0
    assert found.rest_deg < 0.15
    assert found.turning_mm < 1.5
    assert found.turning_deg < 0.25
