"""Zero velocity: which velocities are consistent with rest."""

from typing import Any

import numpy as np
import pytest

from magfusion.estimation.batch.outer_iteration import _stationary_epochs
from magfusion.estimation.measurements.zero_velocity import (
    REST_GATE,
    may_stand,
    slow_enough_to_stand,
)
from magfusion.model.site import MotionModel
from magfusion.model.trajectory import Trajectory

MOTION = MotionModel()
# Of one direction, with as large a variance on each axis as a known velocity has.
WIDEST = 0.999 * MOTION.rest_known_speed**2 * np.ones((3, 3))


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_the_widest_known_velocity_bounds_the_speed_of_a_rest(share: float) -> None:
    variance = 3.0 * MOTION.rest_known_speed**2 + MOTION.rest_speed_sigma**2
    velocity = share * np.sqrt(REST_GATE * variance / 3.0) * np.ones((1, 3))
    assert may_stand(velocity, WIDEST[None], MOTION)[0] == (share < 1.0)
    assert slow_enough_to_stand(velocity, MOTION)[0] == (share < 1.0)


def test_no_covariance_makes_a_faster_velocity_a_rest() -> None:
    rng = np.random.default_rng(0)
    velocity = rng.normal(0.0, 0.2, (10_000, 3))
    root = rng.normal(0.0, 0.06, (10_000, 3, 3))
    stands = may_stand(velocity, root @ np.swapaxes(root, 1, 2), MOTION)
    assert np.sum(stands) > 100
    assert np.all(slow_enough_to_stand(velocity, MOTION)[stands])


def test_a_vehicle_under_way_costs_no_covariance() -> None:
    """No graph is linearised to see that 2 m/s is no rest."""
    count = 4
    states = Trajectory(
        np.arange(float(count)),
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 3)),
        np.tile([2.0, 0.0, 0.0], (count, 1)),
    )
    unused: Any = None
    assert not np.any(
        _stationary_epochs(unused, unused, states, np.ones(count, dtype=bool), MOTION)
    )
