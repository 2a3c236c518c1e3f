"""Calibration as a factor graph: an attitude for each epoch, and the magnetometer's twelve numbers.

What the ellipsoid knows as a size and an angle is here the vector itself, so that the noise has the
weight it should.  The attitudes are held together by what there is: the vertical by the
accelerometer, the turn from one epoch to the next by the gyro, a turntable's setting.

GTSAM's own factors hold the attitudes; field and specific force of all epochs are linearised at
once and enter as Jacobian factors, because a Python factor is called with a copy of all values.
"""

from contextlib import suppress
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.spatial.transform import Rotation

from magfusion.calibration.magnetometer import MagnetometerFit
from magfusion.errors import EstimationError
from magfusion.observation import skew
from magfusion.units import Array, BoolArray

CALIBRATION_KEY = gtsam.symbol("c", 0)
GYRO_BIAS_KEY = gtsam.symbol("g", 0)
COLUMNS = 16  # matrix, offset, dip, accelerometer bias
MOST_STEPS = 40
SETTLED = 1e-9  # relative decrease of the cost that ends the loop
_HALVINGS = 10


@dataclass(frozen=True, eq=False)
class Epochs:
    """What the instruments read at each attitude, and what is known of the attitudes.

    Parameters
    ----------
    measured_sensor : ndarray, shape (n, 3)
        (T)
    field_sigma : float
        Of each component (T).
    accel_body : ndarray, shape (n, 3), optional
        Specific force (m/s^2).
    accel_sigma : ndarray, shape (n,), optional
        Of each component, motion included (m/s^2).
    turns : tuple, optional
        One for each interval: the gyro's preintegrated turn, or None where it has none.
    world_from_body : ndarray, shape (n, 3, 3), optional
        As a turntable was set.
    table_sigma : float, optional
        Of each axis of that setting (rad).
    """

    measured_sensor: Array
    field_sigma: float
    accel_body: Array | None = None
    accel_sigma: Array | None = None
    turns: tuple[gtsam.PreintegratedAhrsMeasurements | None, ...] = ()
    world_from_body: Array | None = None
    table_sigma: float | None = None

    def __len__(self) -> int:
        return len(self.measured_sensor)


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known before the data, and held where its sigma is zero.

    Parameters
    ----------
    body_from_sensor : ndarray, shape (3, 3)
        Mounting; always held.
    matrix, offset : ndarray, shape (3, 3) and (3,)
    cov : ndarray, shape (12, 12)
        Of the matrix, row by row, and the offset (1, T).
    field_world : ndarray, shape (3,)
        Earth field (T); its size is held, which sets the scale of the matrix.
    dip_sigma : float
        Of the angle between field and vertical (rad).
    gravity : float
        (m/s^2)
    accel_bias_sigma, gyro_bias_sigma : float
        (m/s^2, rad/s)
    """

    body_from_sensor: Array
    matrix: Array
    offset: Array
    cov: Array
    field_world: Array
    dip_sigma: float = 0.0
    gravity: float = 9.80665
    accel_bias_sigma: float = 0.0
    gyro_bias_sigma: float = 0.0


@dataclass(frozen=True, eq=False)
class GraphFit:
    """A calibrated magnetometer with everything found beside it.

    Parameters
    ----------
    fit : MagnetometerFit
    world_from_body : ndarray, shape (n, 3, 3)
        Where only the field gives the heading, the world turns with the field's declination.
    dip_change : float
        Of the field's angle below the horizon (rad).
    accel_bias_body, gyro_bias_body : ndarray, shape (3,)
        (m/s^2, rad/s)
    field_residual : ndarray, shape (n, 3)
        Predicted less measured, over sigma.
    chi_square : float
        Of all factors.
    iterations : int
    """

    fit: MagnetometerFit
    world_from_body: Array
    dip_change: float
    accel_bias_body: Array
    gyro_bias_body: Array
    field_residual: Array
    chi_square: float
    iterations: int


@dataclass(frozen=True, eq=False)
class _State:
    values: gtsam.Values
    calibration: Array  # (16,), offset in units of the field, bias in units of gravity


class _Problem:
    """The graph in units of the field and of gravity, which keep all numbers near one."""

    def __init__(self, epochs: Epochs, prior: Prior) -> None:
        self.size = float(np.linalg.norm(prior.field_world))
        self.prior, self.n = prior, len(epochs)
        self.field_world = prior.field_world / self.size
        self.measured = epochs.measured_sensor / self.size
        self.field_weight = self.size / epochs.field_sigma
        self.force: Array | None = None
        if epochs.accel_body is not None and epochs.accel_sigma is not None:
            self.force = epochs.accel_body / prior.gravity
            self.force_weight = prior.gravity / epochs.accel_sigma[:, None]
        self.unit = np.concatenate([np.ones(9), np.full(3, 1.0 / self.size), np.ones(4)])
        self.active = self._active()
        self.prior_root, self.declared = self._prior()
        self.native = _native(epochs, prior)
        self.turned = any(turn is not None for turn in epochs.turns)
        self.ordering = gtsam.Ordering()
        for key in [X(i) for i in range(self.n)] + [GYRO_BIAS_KEY] * self.turned:
            self.ordering.push_back(key)
        self.ordering.push_back(CALIBRATION_KEY)

    def _active(self) -> BoolArray:
        estimated = np.ones(COLUMNS, dtype=bool)
        estimated[12] = self.prior.dip_sigma > 0.0
        estimated[13:] = self.force is not None and self.prior.accel_bias_sigma > 0.0
        return estimated

    def _prior(self) -> tuple[Array, Array]:
        cov = np.zeros((COLUMNS, COLUMNS))
        cov[:12, :12] = self.prior.cov * np.outer(self.unit[:12], self.unit[:12])
        cov[12, 12] = self.prior.dip_sigma**2
        cov[13:, 13:] = (self.prior.accel_bias_sigma / self.prior.gravity) ** 2 * np.eye(3)
        held = cov[np.ix_(self.active, self.active)]
        declared = np.zeros(COLUMNS)
        declared[:12] = np.concatenate([self.prior.matrix.ravel(), self.prior.offset / self.size])
        return np.linalg.inv(np.linalg.cholesky(held)), declared

    def field_at(self, dip: float) -> tuple[Array, Array]:
        """Return the Earth field in the world (unit) and its derivative by the dip."""
        east = np.cross(self.field_world, [0.0, 0.0, 1.0])
        across = east / np.linalg.norm(east) if np.linalg.norm(east) > 1e-6 else np.eye(3)[0]
        down = Rotation.from_rotvec(-dip * across)
        field = np.asarray(down.apply(self.field_world))
        return field, -np.cross(across, field)

    def rows(self, state: _State) -> tuple[Array, Array, Array]:
        """Return whitened residuals (n, m) with derivatives by attitude and calibration."""
        c, mounting = state.calibration, self.prior.body_from_sensor
        body_from_world = np.swapaxes(_attitudes(state.values, self.n), -1, -2)
        field_world, by_dip = self.field_at(c[12])
        field_body = body_from_world @ field_world
        matrix, field_sensor = c[:9].reshape(3, 3), field_body @ mounting
        sensor_from_body = matrix @ mounting.T
        error = field_sensor @ matrix.T + c[9:12] - self.measured
        by_attitude = np.real(sensor_from_body @ skew(field_body))
        by_calibration = np.zeros((self.n, 3, COLUMNS))
        for row in range(3):
            by_calibration[:, row, 3 * row : 3 * row + 3] = field_sensor
        by_calibration[:, :, 9:12] = np.eye(3)
        by_calibration[:, :, 12] = body_from_world @ by_dip @ sensor_from_body.T
        weight = self.field_weight
        if self.force is None:
            return weight * error, weight * by_attitude, weight * by_calibration
        up_body = body_from_world[:, :, 2]
        by_bias = np.zeros((self.n, 3, COLUMNS))
        by_bias[:, :, 13:] = np.eye(3)
        own = self.force_weight
        return (
            np.concatenate([weight * error, own * (up_body + c[13:] - self.force)], axis=1),
            np.concatenate([weight * by_attitude, own[..., None] * np.real(skew(up_body))], axis=1),
            np.concatenate([weight * by_calibration, own[..., None] * by_bias], axis=1),
        )

    def cost(self, state: _State) -> float:
        """Return the sum of squared whitened residuals."""
        error, _, _ = self.rows(state)
        step = self.prior_root @ (state.calibration - self.declared)[self.active]
        return float(np.sum(error**2) + step @ step + 2.0 * self.native.error(state.values))

    def linear(self, state: _State) -> gtsam.GaussianBayesTree:
        """Eliminate the linearised graph, the calibration last."""
        error, by_attitude, by_calibration = self.rows(state)
        graph = self.native.linearize(state.values)
        unit = gtsam.noiseModel.Unit.Create(error.shape[1])
        by_active = by_calibration[:, :, self.active]
        for i in range(self.n):
            graph.push_back(
                gtsam.JacobianFactor(
                    X(i), by_attitude[i], CALIBRATION_KEY, by_active[i], -error[i], unit
                )
            )
        step = self.prior_root @ (self.declared - state.calibration)[self.active]
        unit = gtsam.noiseModel.Unit.Create(len(step))
        graph.push_back(gtsam.JacobianFactor(CALIBRATION_KEY, self.prior_root, step, unit))
        with suppress(RuntimeError):
            return graph.eliminateMultifrontal(self.ordering)
        try:  # sharp fields and shaken verticals: QR needs half the digits
            return graph.eliminateMultifrontal(self.ordering, gtsam.EliminateQR)
        except RuntimeError as failure:
            raise EstimationError(
                "the calibration's graph cannot be solved: the attitudes are not determined"
            ) from failure

    def moved(self, state: _State, step: gtsam.VectorValues, share: float) -> _State:
        """Return the state after a share of a step."""
        calibration = state.calibration.copy()
        calibration[self.active] += share * step.at(CALIBRATION_KEY)
        values = gtsam.Values()
        for i in range(self.n):
            values.insert(X(i), state.values.atRot3(X(i)).retract(share * step.at(X(i))))
        if self.turned:
            bias = state.values.atVector(GYRO_BIAS_KEY)
            values.insert(GYRO_BIAS_KEY, bias + share * step.at(GYRO_BIAS_KEY))
        return _State(values, calibration)


def fit_graph(epochs: Epochs, prior: Prior, start: MagnetometerFit | None = None) -> GraphFit:
    """Find matrix, offset, attitudes and the inertial biases that explain all readings best.

    Parameters
    ----------
    epochs : Epochs
    prior : Prior
    start : MagnetometerFit, optional
        Where to begin; the prior's values where it is not given.

    Returns
    -------
    GraphFit

    Raises
    ------
    EstimationError
        Where the graph leaves attitudes open, or the search does not settle.
    """
    problem = _Problem(epochs, prior)
    state = _start(problem, epochs, start)
    cost = problem.cost(state)
    for done in range(1, MOST_STEPS + 1):
        step = problem.linear(state).optimize()
        for halving in range(_HALVINGS):
            trial = problem.moved(state, step, 0.5**halving)
            new_cost = problem.cost(trial)
            if new_cost <= cost * (1.0 + SETTLED):
                break
        else:
            raise EstimationError("the calibration of the magnetometer found no way down")
        decrease, state, cost = cost - new_cost, trial, new_cost
        if decrease <= SETTLED * cost + 1e-12:
            return _result(problem, state, cost, done)
    raise EstimationError(
        f"the calibration of the magnetometer did not settle in {MOST_STEPS} steps"
    )


def _native(epochs: Epochs, prior: Prior) -> gtsam.NonlinearFactorGraph:
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


def _start(problem: _Problem, epochs: Epochs, start: MagnetometerFit | None) -> _State:
    calibration = problem.declared.copy()
    if start is not None:
        calibration[:12] = np.concatenate([start.matrix.ravel(), start.offset / problem.size])
    if epochs.world_from_body is not None:
        attitudes = epochs.world_from_body
    elif problem.force is not None:
        inverse = np.linalg.inv(calibration[:9].reshape(3, 3))
        field_sensor = (problem.measured - calibration[9:12]) @ inverse.T
        field_body = field_sensor @ problem.prior.body_from_sensor.T
        attitudes = _triad(problem.field_world, problem.force, field_body)
    else:
        raise EstimationError("neither an accelerometer nor a turntable tells the attitudes")
    values = gtsam.Values()
    for i, attitude in enumerate(attitudes):
        values.insert(X(i), gtsam.Rot3(attitude))
    if problem.turned:
        values.insert(GYRO_BIAS_KEY, np.zeros(3))
    return _State(values, calibration)


def _triad(field_world: Array, up_body: Array, field_body: Array) -> Array:
    """Return ``world_from_body`` with the vertical exact and the heading by the field."""

    def axes(up: Array, field: Array) -> Array:
        z = up / np.linalg.norm(up, axis=-1, keepdims=True)
        east = np.cross(field, z)
        x = east / np.linalg.norm(east, axis=-1, keepdims=True)
        return np.stack([x, np.cross(z, x), z], axis=-1)

    world = axes(np.array([0.0, 0.0, 1.0]), field_world)
    return np.asarray(world @ np.swapaxes(axes(up_body, field_body), -1, -2))


def _result(problem: _Problem, state: _State, cost: float, iterations: int) -> GraphFit:
    cov = np.zeros((COLUMNS, COLUMNS))
    tree = problem.linear(state)
    found = np.array(tree.marginalCovariance(CALIBRATION_KEY))
    cov[np.ix_(problem.active, problem.active)] = found
    cov /= np.outer(problem.unit, problem.unit)
    c = state.calibration / problem.unit
    turned = problem.turned
    return GraphFit(
        fit=MagnetometerFit(c[:9].reshape(3, 3), c[9:12], cov[:12, :12]),
        world_from_body=_attitudes(state.values, problem.n),
        dip_change=float(c[12]),
        accel_bias_body=problem.prior.gravity * c[13:],
        gyro_bias_body=state.values.atVector(GYRO_BIAS_KEY) if turned else np.zeros(3),
        field_residual=problem.rows(state)[0][:, :3],
        chi_square=cost,
        iterations=iterations,
    )
