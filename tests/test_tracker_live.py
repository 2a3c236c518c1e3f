"""A tracker of wound coils in time slots, raw samples at 20 kHz through the pipe."""

import pytest
import tracker_live as live
from tracker_head import RESTING, TURNING, Config


@pytest.mark.slow
def test_a_wound_tracker_is_followed_through_the_pipe() -> None:
    result = live.run(Config(duration=TURNING + 2.0, seed=1))
    assert result.states_per_s > 118.0
    assert result.rest_mm < 1.0
    assert result.rest_deg < 0.15
    assert result.turned_deg_s > 80.0
    assert result.turning_mm < 1.5
    assert result.turning_deg < 0.25
    assert result.ahead_mm < 2.0
    assert result.ahead_deg < 0.3


@pytest.mark.slow
def test_a_plate_that_is_moved_beside_the_head_is_said_and_the_sigmas_hold() -> None:
    result = live.run_near_plate(Config(duration=live.PLATE_RUN, plate=True, seed=2))
    assert result.largest_share > 0.03
    assert result.false_detections == 0
    assert result.detected_after_s < 1.0
    assert result.poses == 1.0
    assert result.nees < 12.0
    assert result.after_nees < 12.0
    assert result.after_mm < 1.0


@pytest.mark.slow
def test_the_side_of_the_source_is_found_by_motion_or_said_to_be_ambiguous() -> None:
    result = live.run_without_hemisphere(Config(duration=RESTING + 2.5, seed=1))
    assert result.first_s < 4.0
    assert result.wrong == 0.0
    assert result.ambiguous < 1.0
    assert result.mm < 1.5


@pytest.mark.slow
def test_a_tracker_without_an_imu_is_followed_through_the_pipe() -> None:
    config = Config(duration=TURNING + 2.0, seed=1, inertial=False, rate_hz=60.0)
    result = live.run(config)
    assert result.states_per_s > 59.0
    assert result.rest_mm < 1.0
    assert result.rest_deg < 0.15
    assert result.turning_mm < 1.5
    assert result.turning_deg < 0.25
