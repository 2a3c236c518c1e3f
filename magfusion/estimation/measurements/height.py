"""Height of a point of the body, by a level or by the pressure of air or water."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.graph.state import States
from magfusion.estimation.measurements.aiding import AidingMeasurement, Prediction
from magfusion.estimation.measurements.point_position import point_world
from magfusion.model.aiding import AidingSensor
from magfusion.model.parameters import AIDING_OFFSET, AIDING_POSITION, AIDING_PRESSURE
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Height(AidingMeasurement):
    """Heights of a point of the body above the world's zero (m), or pressures there (Pa)."""

    def predicted(self, states: States, rate_body: Array, sensor: AidingSensor) -> Prediction:
        """Return the scaled height, and its offset."""
        point, by_pose = point_world(states, sensor.position_body)
        return Prediction(
            sensor.scale * point[:, 2:] + sensor.offset,
            sensor.scale * by_pose[:, 2:],
            by_parameter={
                **dict.fromkeys((AIDING_OFFSET, AIDING_PRESSURE), np.ones((len(states), 1, 1))),
                AIDING_POSITION: sensor.scale * states.world_from_body[:, 2:],
            },
        )
