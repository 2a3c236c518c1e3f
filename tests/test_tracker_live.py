"""A tracker of wound coils in time slots, raw samples at 20 kHz through the pipe."""

import pytest
import tracker_live as live


@pytest.mark.slow
def test_a_wound_tracker_is_followed_through_the_pipe() -> None:
    found = live.run(live.Config(duration=live.TURNING + 2.0, seed=1))
    assert found.states_per_s > 118.0
    assert found.rest_mm < 1.0
    assert found.rest_deg < 0.15
    assert found.turned_deg_s > 80.0
    assert found.turning_mm < 1.5
    assert found.turning_deg < 0.25
    assert found.ahead_mm < 2.0
    assert found.ahead_deg < 0.3
