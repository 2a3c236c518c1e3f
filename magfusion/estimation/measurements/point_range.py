"""Distance between a point of the body and a known point."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.graph.state import States
from magfusion.estimation.measurements.aiding import AidingMeasurement, Prediction
from magfusion.estimation.measurements.point_position import point_world
from magfusion.model.aiding import AidingSensor
from magfusion.model.parameters import AIDING_OFFSET, AIDING_POINT, AIDING_POSITION
from magfusion.units import Array

NEAREST = 1e-6  # m; a range has no direction at its origin


@dataclass(frozen=True, eq=False)
class PointRange(AidingMeasurement):
    """Distances (m) of a point of the body from the sensor's ``point_world``."""

    def predicted(self, states: States, rate_body: Array, sensor: AidingSensor) -> Prediction:
        """Return the distance, and its offset."""
        assert sensor.point_world is not None
        point, by_pose = point_world(states, sensor.position_body)
        away = point - sensor.point_world
        distance = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), NEAREST)
        along = (away / distance)[:, None]
        return Prediction(
            distance + sensor.offset,
            along @ by_pose,
            by_parameter={
                AIDING_OFFSET: np.ones((len(states), 1, 1)),
                AIDING_POSITION: along @ states.world_from_body,
                AIDING_POINT: -along,
            },
        )
