"""What aiding sensors have in common as measurements: rows, parameters, robust loss."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from magfusion.estimation.graph.measurement import Loss, Measurement, Rows, calibration_rows
from magfusion.estimation.graph.state import States
from magfusion.model.aiding import AidingSensor, sensor_named
from magfusion.model.parameters import AIDING_CLOCK, AidingParameter, Block, Calibration
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a sensor measures at an estimate, with derivatives."""

    value: Array  # (n, k)
    # by_pose, by_velocity, by_bias: (n, k, 6 or 3), as of `Rows`
    by_pose: Array
    by_velocity: Array | None = None
    by_bias: Array | None = None
    # by a parameter of the sensor, in SI units, shape (n, k, columns)
    by_parameter: Mapping[AidingParameter, Array] = field(default_factory=dict)
    # (n, k), by the time of the sample, where it is not that of the state's motion alone
    by_time: Array | None = None


@dataclass(frozen=True, eq=False)
class AidingMeasurement(Measurement):
    """Samples of an aiding sensor."""

    sensor: str  # name
    robust: str | None  # 'huber', 'cauchy' or 'geman-mcclure'
    # value, sigma: (n, k), measured; sigma is infinite for what is not
    value: Array
    sigma: Array
    time_offset: Array  # (n,), by which the sensor's stamps are corrected already (s)
    # (n, 6), measured rate and specific force, with their biases (rad/s, m/s^2)
    inertial_body: Array

    @abstractmethod
    def predicted(self, states: States, rate_body: Array, sensor: AidingSensor) -> Prediction:
        """Return what the sensor measures at some states and rates (rad/s)."""

    @property
    def loss(self) -> Loss | None:
        """Robust loss of each sample: wheels slip, ranges are reflected."""
        return None if self.robust is None else Loss(self.robust)

    def with_inertial(self, inertial_body: Array) -> Self:
        """Return the measurement with the inertial samples of its epochs (n, 6)."""
        return replace(self, inertial_body=inertial_body)

    def near_solution(self) -> Self:
        """Return the measurement with a redescending loss instead of Cauchy's.

        It rejects a slip, whose weighted residuals else add up; from afar it rejects a sensor.
        """
        return replace(self, robust="geman-mcclure") if self.robust == "cauchy" else self

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate, one group of each sample."""
        sensor = sensor_named(calibration.site.aiding, self.sensor)
        bias = states.read_bias()
        rate_body = self.inertial_body[:, :3] - bias[:, 3:]
        force_body = self.inertial_body[:, 3:] - bias[:, :3]
        at = self.predicted(states, rate_body, sensor)
        by_time = at.by_time
        if by_time is None:
            by_time = _by_time(at, states, rate_body, force_body, calibration.site.gravity)
        late = sensor.time_offset - self.time_offset
        by_parameter = {**at.by_parameter, AIDING_CLOCK: by_time[..., None]}
        by_calibration = calibration_rows((len(states), self.value.shape[1]), blocks)
        for block in blocks:
            own = block.parameter
            if isinstance(own, AidingParameter) and block.owner == self.sensor:
                by_calibration[..., block.columns] = own.si * by_parameter[own]
        weight = 1.0 / self.sigma[..., None]
        residual = self._residual(at.value + late[:, None] * by_time)
        return Rows(
            error=(weight[..., 0] * residual)[:, None],
            by_pose=(weight * at.by_pose)[:, None],
            by_velocity=None if at.by_velocity is None else (weight * at.by_velocity)[:, None],
            by_bias=None if at.by_bias is None else (weight * at.by_bias)[:, None],
            by_calibration=(weight * by_calibration)[:, None] if blocks else None,
        )

    def _residual(self, predicted: Array) -> Array:
        """Return predicted minus measured, zero where nothing is measured."""
        return np.where(np.isfinite(self.sigma), predicted - self.value, 0.0)


def _by_time(
    at: Prediction, states: States, rate_body: Array, force_body: Array, gravity: float
) -> Array:
    """Return the derivative of a prediction by time, shape (n, k).

    The angular acceleration, which moves a lever arm, is not measured and left out.
    """
    rotation = states.world_from_body
    velocity_body = (np.swapaxes(rotation, 1, 2) @ states.velocity_world[..., None])[..., 0]
    twist = np.concatenate([rate_body, velocity_body], axis=1)
    out = (at.by_pose @ twist[..., None])[..., 0]
    if at.by_velocity is not None:
        accel_world = (rotation @ force_body[..., None])[..., 0] - [0.0, 0.0, gravity]
        out = out + (at.by_velocity @ accel_world[..., None])[..., 0]
    return np.asarray(out)
