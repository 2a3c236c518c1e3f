"""Position of a point of the body: a total station's prism, GNSS, or a known mark under it."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.graph.state import States
from magfusion.estimation.measurements.aiding import AidingMeasurement, Prediction
from magfusion.model.aiding import AidingSensor
from magfusion.model.parameters import AIDING_POSITION
from magfusion.model.perturbation import skew
from magfusion.units import Array


def point_world(states: States, position_body: Array) -> tuple[Array, Array]:
    """Return a point of the body in the world, shape (n, 3) (m), and its derivative by the pose."""
    rotation = states.world_from_body
    by_pose = np.concatenate([-rotation @ skew(position_body), rotation], axis=2)
    return states.position_world + rotation @ position_body, by_pose


@dataclass(frozen=True, eq=False)
class PointPosition(AidingMeasurement):
    """Positions of a point of the body (m)."""

    def predicted(self, states: States, rate_body: Array, sensor: AidingSensor) -> Prediction:
        """Return the point's position."""
        point, by_pose = point_world(states, sensor.position_body)
        return Prediction(point, by_pose, by_parameter={AIDING_POSITION: states.world_from_body})
