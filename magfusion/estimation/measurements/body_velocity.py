"""Velocity in axes of the body: wheel odometry, or the twist of visual or laser odometry."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.graph.state import States
from magfusion.estimation.measurements.aiding import AidingMeasurement, Prediction
from magfusion.model.aiding import AidingSensor
from magfusion.model.parameters import AIDING_POSITION, AIDING_ROTATION, AIDING_SCALE
from magfusion.model.perturbation import skew
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class BodyVelocity(AidingMeasurement):
    """Velocities of a point of the body in the axes of its sensor (m/s)."""

    def predicted(self, states: States, rate_body: Array, sensor: AidingSensor) -> Prediction:
        """Return the sensor's velocity: that of the body, and of the lever arm as it turns."""
        body_from_world = np.swapaxes(states.world_from_body, 1, 2)
        sensor_from_body = sensor.body_from_sensor.T
        body = (body_from_world @ states.velocity_world[..., None])[..., 0]
        point = (sensor_from_body @ (body + np.cross(rate_body, sensor.position_body))[..., None])[
            ..., 0
        ]
        scale = float(sensor.scale)
        scaled = scale * sensor_from_body
        by_pose = np.zeros((len(states), 3, 6))
        by_pose[..., :3] = scaled @ skew(body)
        by_bias = np.zeros((len(states), 3, 6))
        by_bias[..., 3:] = scaled @ skew(sensor.position_body)
        return Prediction(
            scale * point,
            by_pose,
            scaled @ body_from_world,
            by_bias,
            {
                AIDING_SCALE: point[..., None],
                AIDING_ROTATION: scale * skew(point),
                AIDING_POSITION: scaled @ skew(rate_body),
            },
        )
