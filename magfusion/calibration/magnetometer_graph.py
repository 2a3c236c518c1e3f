"""Calibration as a factor graph: an attitude for each epoch, and the magnetometer's twelve numbers.

The residual is the full vector, not magnitude and angle as in the ellipsoid fit, so that the noise
has its correct weight.  The attitudes are constrained by the available sensors: the vertical from
the accelerometer, the rotation between epochs from the gyro, and the turntable's settings.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.spatial.transform import Rotation

from magfusion.calibration.graph import CalibrationEstimate, CalibrationGraph, solve
from magfusion.calibration.magnetometer import MagnetometerFit
from magfusion.errors import EstimationError
from magfusion.model.field import by_matrix, skew
from magfusion.model.strapdown import triad
from magfusion.units import Array

GYRO_BIAS_KEY = gtsam.symbol("g", 0)
COLUMNS = 17  # matrix, offset, dip, accelerometer bias, logarithm of the field's size
MAX_STEPS = 40
MIN_COST_DECREASE = 1e-9  # relative decrease of the cost that ends the loop
ATTITUDE_STEP, GYRO_BIAS_STEP = np.full(3, 0.3), np.full(3, 0.01)  # rad, rad/s


@dataclass(frozen=True, eq=False)
class MagnetometerEpochs:
    """Readings of the instruments at each attitude, and the priors of the attitudes."""

    measured_sensor: Array  # (n, 3) (T)
    field_sigma: float  # of each component (T)
    accel_body: Array | None = None  # (n, 3), specific force (m/s^2)
    accel_sigma: Array | None = None  # (n,), of each component, motion included (m/s^2)
    # one for each interval: the gyro's preintegrated rotation, or None without gyro data
    turns: tuple[gtsam.PreintegratedAhrsMeasurements | None, ...] = ()
    world_from_body: Array | None = None  # (n, 3, 3), as a turntable was set
    table_sigma: float | None = None  # of each axis of that setting (rad)

    def __len__(self) -> int:
        return len(self.measured_sensor)


@dataclass(frozen=True, eq=False)
class MagnetometerPrior:
    """Priors of the calibration; a sigma of zero fixes a value."""

    body_from_sensor: Array  # (3, 3), mounting; always fixed
    matrix: Array  # (3, 3)
    offset: Array  # (3,)
    cov: Array  # (12, 12), of the matrix, row by row, and the offset (1, T)
    # (3,), Earth field (T); where its magnitude is fixed it sets the scale of the matrix
    field_world: Array
    dip_sigma: float = 0.0  # of the angle between field and vertical (rad)
    gravity: float = 9.80665  # (m/s^2)
    accel_bias_sigma: float = 0.0  # (m/s^2)
    gyro_bias_sigma: float = 0.0  # (rad/s)
    size_sigma: float = 0.0  # of the natural logarithm of the field's magnitude


@dataclass(frozen=True, eq=False)
class GraphFit:
    """A calibrated magnetometer with the other estimates."""

    fit: MagnetometerFit
    # (n, 3, 3), where only the field gives the heading, the world frame is rotated by the
    # declination
    world_from_body: Array
    dip_change: float  # of the field's angle below the horizon (rad)
    accel_bias_body: Array  # (3,) (m/s^2)
    gyro_bias_body: Array  # (3,) (rad/s)
    field_residual: Array  # (n, 3), predicted less measured, over sigma
    chi_square: float  # of all factors
    iterations: int
    size_ratio: float = 1.0  # estimated magnitude of the field over that of the prior


class Readings:
    """Readings of all epochs, in units of the field and of gravity (numbers near one).

    The calibration is the estimated subset of the seventeen columns.
    """

    def __init__(self, epochs: MagnetometerEpochs, prior: MagnetometerPrior) -> None:
        self.size = float(np.linalg.norm(prior.field_world))
        self.prior, self.n = prior, len(epochs)
        self.field_world = prior.field_world / self.size
        self.measured = epochs.measured_sensor / self.size
        self.field_weight = self.size / epochs.field_sigma
        self.force: Array | None = None
        if epochs.accel_body is not None and epochs.accel_sigma is not None:
            self.force = epochs.accel_body / prior.gravity
            self.force_weight = prior.gravity / epochs.accel_sigma[:, None]
        self.unit = np.concatenate([np.ones(9), np.full(3, 1.0 / self.size), np.ones(5)])
        self.active = np.ones(COLUMNS, dtype=bool)
        self.active[12] = prior.dip_sigma > 0.0
        self.active[13:16] = self.force is not None and prior.accel_bias_sigma > 0.0
        self.active[16] = prior.size_sigma > 0.0
        self.declared = np.zeros(COLUMNS)
        self.declared[:12] = np.concatenate([prior.matrix.ravel(), prior.offset / self.size])

    def prior_cov(self) -> Array:
        """Return the prior covariance of the estimated columns."""
        cov = np.zeros((COLUMNS, COLUMNS))
        cov[:12, :12] = self.prior.cov * np.outer(self.unit[:12], self.unit[:12])
        cov[12, 12] = self.prior.dip_sigma**2
        cov[13:16, 13:16] = (self.prior.accel_bias_sigma / self.prior.gravity) ** 2 * np.eye(3)
        cov[16, 16] = self.prior.size_sigma**2
        return cov[np.ix_(self.active, self.active)]

    def all_columns(self, estimate: CalibrationEstimate) -> Array:
        """Return all seventeen columns, estimated and fixed."""
        out = self.declared.copy()
        out[self.active] = estimate.calibration
        return out

    def field_at(self, dip: float) -> tuple[Array, Array]:
        """Return the Earth field in the world (unit) and its derivative by the dip."""
        east = np.cross(self.field_world, [0.0, 0.0, 1.0])
        across = east / np.linalg.norm(east) if np.linalg.norm(east) > 1e-6 else np.eye(3)[0]
        down = Rotation.from_rotvec(-dip * across)
        field = down.apply(self.field_world)
        return field, -np.cross(across, field)

    def rows(self, estimate: CalibrationEstimate) -> tuple[Array, Array, Array]:
        """Return whitened residuals (n, m) with derivatives by attitude and calibration."""
        c, mounting = self.all_columns(estimate), self.prior.body_from_sensor
        body_from_world = np.swapaxes(_attitudes(estimate.values, self.n), -1, -2)
        field_world, by_dip = (np.exp(c[16]) * of_size_one for of_size_one in self.field_at(c[12]))
        field_body = body_from_world @ field_world
        matrix, field_sensor = c[:9].reshape(3, 3), field_body @ mounting
        sensor_from_body = matrix @ mounting.T
        error = field_sensor @ matrix.T + c[9:12] - self.measured
        by_attitude = sensor_from_body @ skew(field_body)
        by_calibration = np.zeros((self.n, 3, COLUMNS))
        by_calibration[:, :, :9] = by_matrix(field_sensor)
        by_calibration[:, :, 9:12] = np.eye(3)
        by_calibration[:, :, 12] = body_from_world @ by_dip @ sensor_from_body.T
        by_calibration[:, :, 16] = field_sensor @ matrix.T
        weight = self.field_weight
        if self.force is None:
            return weight * error, weight * by_attitude, weight * by_calibration[..., self.active]
        up_body = body_from_world[:, :, 2]
        by_bias = np.zeros((self.n, 3, COLUMNS))
        by_bias[:, :, 13:16] = np.eye(3)
        own = self.force_weight
        return (
            np.concatenate([weight * error, own * (up_body + c[13:16] - self.force)], axis=1),
            np.concatenate([weight * by_attitude, own[..., None] * skew(up_body)], axis=1),
            np.concatenate([weight * by_calibration, own[..., None] * by_bias], axis=1)[
                ..., self.active
            ],
        )


def fit_graph(
    epochs: MagnetometerEpochs, prior: MagnetometerPrior, start: MagnetometerFit | None = None
) -> GraphFit:
    """Estimate matrix, offset, attitudes and inertial biases from all readings.

    `start`: initial estimate; by default the prior's values. Raises EstimationError where the graph
    leaves attitudes undetermined, or the search does not converge.
    """
    readings = Readings(epochs, prior)
    first = _start(readings, epochs, start)
    steps = {X(i): ATTITUDE_STEP for i in range(readings.n)}
    if first.values.exists(GYRO_BIAS_KEY):
        steps[GYRO_BIAS_KEY] = GYRO_BIAS_STEP
    graph = CalibrationGraph(
        rows=readings.rows,
        native=_native(epochs, prior),
        declared=readings.declared[readings.active],
        cov=readings.prior_cov(),
        steps=steps,
    )
    result, own_cov = solve(graph, first, "magnetometer", MAX_STEPS, MIN_COST_DECREASE)
    cov = np.zeros((COLUMNS, COLUMNS))
    cov[np.ix_(readings.active, readings.active)] = own_cov
    cov /= np.outer(readings.unit, readings.unit)
    c, values = readings.all_columns(result.estimate) / readings.unit, result.estimate.values
    rotated = values.exists(GYRO_BIAS_KEY)
    return GraphFit(
        fit=MagnetometerFit(c[:9].reshape(3, 3), c[9:12], cov[:12, :12]),
        world_from_body=_attitudes(values, readings.n),
        dip_change=float(c[12]),
        accel_bias_body=prior.gravity * c[13:16],
        gyro_bias_body=values.atVector(GYRO_BIAS_KEY) if rotated else np.zeros(3),
        field_residual=readings.rows(result.estimate)[0][:, :3],
        chi_square=2.0 * result.cost,
        iterations=result.iterations,
        size_ratio=float(np.exp(c[16])),
    )


def _native(epochs: MagnetometerEpochs, prior: MagnetometerPrior) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    if epochs.world_from_body is not None and epochs.table_sigma is not None:
        noise = gtsam.noiseModel.Isotropic.Sigma(3, epochs.table_sigma)
        for i, attitude in enumerate(epochs.world_from_body):
            graph.add(gtsam.PriorFactorRot3(X(i), gtsam.Rot3(attitude), noise))
    turns = [(i, turn) for i, turn in enumerate(epochs.turns) if turn is not None]
    for i, turn in turns:
        graph.add(gtsam.AHRSFactor(X(i), X(i + 1), GYRO_BIAS_KEY, turn))
    if turns:
        noise = gtsam.noiseModel.Isotropic.Sigma(3, max(prior.gyro_bias_sigma, 1e-9))
        graph.addPriorVector(GYRO_BIAS_KEY, np.zeros(3), noise)
    return graph


def _attitudes(values: gtsam.Values, n: int) -> Array:
    return np.array([values.atRot3(X(i)).matrix() for i in range(n)])


def _start(
    readings: Readings, epochs: MagnetometerEpochs, start: MagnetometerFit | None
) -> CalibrationEstimate:
    calibration = readings.declared.copy()
    if start is not None:
        calibration[:12] = np.concatenate([start.matrix.ravel(), start.offset / readings.size])
    if epochs.world_from_body is not None:
        attitudes = epochs.world_from_body
    elif readings.force is not None:
        inverse = np.linalg.inv(calibration[:9].reshape(3, 3))
        field_sensor = (readings.measured - calibration[9:12]) @ inverse.T
        field_body = field_sensor @ readings.prior.body_from_sensor.T
        attitudes = triad(readings.field_world, readings.force, field_body)
    else:
        raise EstimationError("neither an accelerometer nor a turntable gives the attitudes")
    values = gtsam.Values()
    for i, attitude in enumerate(attitudes):
        values.insert(X(i), gtsam.Rot3(attitude))
    if any(turn is not None for turn in epochs.turns):
        values.insert(GYRO_BIAS_KEY, np.zeros(3))
    return CalibrationEstimate(values, calibration[readings.active])
