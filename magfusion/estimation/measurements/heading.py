"""Heading of the body, as of a gyrocompass."""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.graph.state import States
from magfusion.estimation.measurements.aiding import AidingMeasurement, Prediction
from magfusion.model.aiding import AidingSensor
from magfusion.model.parameters import AIDING_OFFSET
from magfusion.model.perturbation import skew
from magfusion.units import Array

FORWARD_BODY = np.array([1.0, 0.0, 0.0])
STEEPEST = 1e-6  # of one; an axis that is vertical has no heading


@dataclass(frozen=True, eq=False)
class Heading(AidingMeasurement):
    """Headings of the body's x axis, clockwise from the world's y axis (rad)."""

    def predicted(self, states: States, rate_body: Array, sensor: AidingSensor) -> Prediction:
        """Return the heading, and its offset."""
        forward = states.world_from_body[..., 0]
        east, north = forward[:, 0], forward[:, 1]
        square = np.maximum(east**2 + north**2, STEEPEST)
        by_forward = np.stack([north, -east, np.zeros(len(states))], axis=1) / square[:, None]
        by_pose = np.zeros((len(states), 1, 6))
        by_pose[..., :3] = -by_forward[:, None] @ states.world_from_body @ skew(FORWARD_BODY)
        heading = np.arctan2(east, north)[:, None] + sensor.offset
        return Prediction(
            heading, by_pose, by_parameter={AIDING_OFFSET: np.ones((len(states), 1, 1))}
        )

    def _residual(self, predicted: Array) -> Array:
        """Return the difference within half a turn."""
        away = super()._residual(predicted)
        return np.asarray((away + np.pi) % (2.0 * np.pi) - np.pi)
