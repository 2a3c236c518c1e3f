"""Batch smoother: one factor graph over the log, in a loop of our own over GTSAM's linear layer."""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.errors import EstimationError
from magfusion.fusion.factors import (
    CALIBRATION_KEY,
    ROBUST_WIDTH,
    FieldFactors,
    read_poses,
)
from magfusion.fusion.ordering import nested_dissection
from magfusion.parameters import Block, Calibration, difference, prior_sigma, retract
from magfusion.prior import prior_root, prior_spread
from magfusion.site import ImuModel
from magfusion.trajectory import Trajectory
from magfusion.units import Array

HELD_KEY = gtsam.symbol("h", 0)
VELOCITY_SIGMA = 10.0  # m/s; prior of the first velocity
DAMPING_START, DAMPING_STOP = 1e-2, 1e10
# The step that a damping of one holds back: metres, radians, m/s, m/s^2, rad/s.
POSE_STEP = np.repeat([0.1, 0.3], 3)
VELOCITY_STEP = np.full(3, 1.0)
BIAS_STEP = np.repeat([0.1, 0.01], 3)
STALLED = 1e-9  # relative rise of the cost that is rounding


@dataclass(frozen=True, eq=False)
class Estimate:
    """What the smoother moves.

    Parameters
    ----------
    values : gtsam.Values
        Pose X(i), velocity V(i) and bias B(i) of each epoch.
    calibration : Calibration
    """

    values: gtsam.Values
    calibration: Calibration


@dataclass(frozen=True, eq=False)
class Problem:
    """A graph that is ready to be optimised.

    Parameters
    ----------
    native : gtsam.NonlinearFactorGraph
        Inertial factors and priors, linearised by GTSAM.
    fields : FieldFactors, optional
        None where the fields enter as pose fixes in ``native``.
    declared : Calibration
        Mean of the calibration's prior.
    epochs : int
    """

    native: gtsam.NonlinearFactorGraph
    fields: FieldFactors | None
    declared: Calibration
    epochs: int

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Calibration parameters that are estimated."""
        return () if self.fields is None else self.fields.blocks


@dataclass(frozen=True, eq=False)
class Optimised:
    """Where the loop ended.

    Parameters
    ----------
    estimate : Estimate
    cost : float
        Half the sum of squares.
    iterations : int
    converged : bool
    """

    estimate: Estimate
    cost: float
    iterations: int
    converged: bool


def initial_estimate(states: Trajectory, calibration: Calibration) -> Estimate:
    """Return an estimate with the given states; absent biases are zero."""
    values = gtsam.Values()
    zero = np.zeros((len(states), 3))
    accel = zero if states.accel_bias_body is None else states.accel_bias_body
    gyro = zero if states.gyro_bias_body is None else states.gyro_bias_body
    velocity = zero if states.velocity_world is None else states.velocity_world
    for i in range(len(states)):
        pose = gtsam.Pose3(gtsam.Rot3(states.world_from_body[i]), states.position_world[i])
        values.insert(X(i), pose)
        values.insert(V(i), velocity[i])
        values.insert(B(i), gtsam.imuBias.ConstantBias(accel[i], gyro[i]))
    return Estimate(values, calibration)


def read_states(values: gtsam.Values, time: Array) -> Trajectory:
    """Return the states in ``values`` as a trajectory, without covariance."""
    poses = read_poses(values)
    biases = np.array([values.atConstantBias(B(i)).vector() for i in range(len(time))])
    return Trajectory(
        time=time,
        world_from_body=poses.world_from_body,
        position_world=poses.position_world,
        velocity_world=poses.velocity_world,
        accel_bias_body=biases[:, :3],
        gyro_bias_body=biases[:, 3:],
    )


def inertial_graph(
    preintegrated: list[gtsam.PreintegratedCombinedMeasurementsG], imu: ImuModel
) -> gtsam.NonlinearFactorGraph:
    """Return the inertial factors between epochs, with priors of the first velocity and bias."""
    graph = gtsam.NonlinearFactorGraph()
    sigmas = np.repeat([imu.accel_bias_sigma, imu.gyro_bias_sigma], 3)
    bias_noise = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, 1e-9))
    zero_bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.zeros(3))
    graph.addPriorConstantBias(B(0), zero_bias, bias_noise)
    graph.addPriorVector(V(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, VELOCITY_SIGMA))
    for i, measurement in enumerate(preintegrated):
        j = i + 1
        graph.add(gtsam.GalileanCombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), measurement))
    return graph


def add_pose_fixes(graph: gtsam.NonlinearFactorGraph, fixes: Trajectory, loss: str | None) -> None:
    """Add a fix as a measurement of the pose at each epoch (loose coupling)."""
    assert fixes.pose_cov is not None
    for i in range(len(fixes)):
        noise = _robust(gtsam.noiseModel.Gaussian.Covariance(fixes.pose_cov[i]), loss)
        pose = gtsam.Pose3(gtsam.Rot3(fixes.world_from_body[i]), fixes.position_world[i])
        graph.add(gtsam.PriorFactorPose3(X(i), pose, noise))


def _robust(noise: gtsam.noiseModel.Gaussian, loss: str | None) -> gtsam.noiseModel.Base:
    if loss is None:
        return noise
    width = ROBUST_WIDTH[loss] * np.sqrt(6.0)
    estimators = gtsam.noiseModel.mEstimator
    if loss == "huber":
        return gtsam.noiseModel.Robust.Create(estimators.Huber.Create(width), noise)
    return gtsam.noiseModel.Robust.Create(estimators.Cauchy.Create(width), noise)


def _prior_factor(problem: Problem, calibration: Calibration) -> gtsam.JacobianFactor:
    root = prior_root(problem.declared.site, problem.blocks)
    error = -root @ difference(problem.declared, calibration, problem.blocks)
    unit = gtsam.noiseModel.Unit.Create(len(root))
    return gtsam.JacobianFactor(CALIBRATION_KEY, root, error, unit)


def cost_of(problem: Problem, estimate: Estimate) -> float:
    """Return half the sum of squared whitened residuals, priors included."""
    total = float(problem.native.error(estimate.values))
    if problem.fields is not None:
        total += problem.fields.cost(read_poses(estimate.values), estimate.calibration)
    if problem.blocks:
        step = difference(problem.declared, estimate.calibration, problem.blocks)
        root = prior_root(problem.declared.site, problem.blocks)
        total += 0.5 * float(np.sum((root @ step) ** 2))
    return total


def linearized(problem: Problem, estimate: Estimate) -> gtsam.GaussianFactorGraph:
    """Return the linear graph at an estimate."""
    graph = problem.native.linearize(estimate.values)
    if problem.fields is not None:
        problem.fields.linearize(estimate.values, estimate.calibration)
        graph.push_back(problem.fields.graph)
    if problem.blocks:
        graph.push_back(_prior_factor(problem, estimate.calibration))
    return graph


def _eliminate(
    graph: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> gtsam.GaussianBayesTree:
    try:
        return graph.eliminateMultifrontal(ordering)
    except RuntimeError:  # an ill-conditioned stretch: QR needs half the digits
        return graph.eliminateMultifrontal(ordering, gtsam.EliminateQR)


def _damped(
    problem: Problem, graph: gtsam.GaussianFactorGraph, damping: float
) -> gtsam.GaussianFactorGraph:
    out = gtsam.GaussianFactorGraph()
    out.push_back(graph)
    scales = {X: POSE_STEP, V: VELOCITY_STEP, B: BIAS_STEP}
    terms = [(symbol(i), step) for symbol, step in scales.items() for i in range(problem.epochs)]
    if problem.blocks:
        terms.append((CALIBRATION_KEY, prior_sigma(problem.blocks)))
    for key, step in terms:
        unit = gtsam.noiseModel.Unit.Create(len(step))
        weight = np.diag(np.sqrt(damping) / step)
        out.push_back(gtsam.JacobianFactor(key, weight, np.zeros(len(step)), unit))
    return out


def _moved(problem: Problem, estimate: Estimate, step: gtsam.VectorValues) -> Estimate:
    calibration = estimate.calibration
    if problem.blocks:
        calibration = retract(calibration, problem.blocks, step.at(CALIBRATION_KEY))
    return Estimate(estimate.values.retract(step), calibration)


def optimise(
    problem: Problem,
    estimate: Estimate,
    *,
    iterations: int = 30,
    tolerance: float = 1e-6,
    report: Callable[[int, float], None] | None = None,
) -> Optimised:
    """Minimise the cost by Gauss-Newton steps, damped (Levenberg-Marquardt) where they fail.

    Parameters
    ----------
    problem : Problem
    estimate : Estimate
        The start.
    iterations : int
    tolerance : float
        Relative decrease of the cost that ends the loop.
    report : callable, optional
        Told the iteration and its cost.

    Returns
    -------
    Optimised

    Raises
    ------
    EstimationError
        Where the start itself has no finite cost or the graph cannot be solved.
    """
    ordering = nested_dissection(problem.epochs, CALIBRATION_KEY if problem.blocks else None)
    cost = cost_of(problem, estimate)
    if not np.isfinite(cost):
        raise EstimationError("the start of the smoother has no finite cost")
    damping, done = 0.0, 0
    while done < iterations:
        graph = linearized(problem, estimate)
        while True:
            system = graph if damping == 0.0 else _damped(problem, graph, damping)
            try:
                trial = _moved(problem, estimate, _eliminate(system, ordering).optimize())
                new_cost = cost_of(problem, trial)
            except RuntimeError:
                new_cost = np.inf
            if new_cost <= cost:
                break
            if new_cost <= cost * (1 + STALLED) or damping > DAMPING_STOP:
                return Optimised(estimate, cost, done, converged=damping <= DAMPING_STOP)
            damping = max(DAMPING_START, 10.0 * damping)
        decrease = cost - new_cost
        estimate, cost, done = trial, new_cost, done + 1
        damping = 0.0 if damping <= DAMPING_START else damping / 10.0
        if report is not None:
            report(done, cost)
        if decrease <= tolerance * (1.0 + cost) and damping == 0.0:
            return Optimised(estimate, cost, done, converged=True)
    return Optimised(estimate, cost, done, converged=False)


def marginals(
    problem: Problem, estimate: Estimate, held: tuple[Block, ...] = ()
) -> tuple[Array, Array]:
    """Return the posterior covariance of every pose and of the calibration.

    Parameters
    ----------
    problem : Problem
    estimate : Estimate
    held : tuple of Block
        Uncertain parameters that were not estimated: what their errors do to the estimate is added
        (a consider covariance).

    Returns
    -------
    pose_cov : ndarray, shape (n, 6, 6)
        Calibration marginalised, its gauge included.
    calibration_cov : ndarray, shape (dimension, dimension)
    """
    calibrated = bool(problem.blocks)
    ordering = nested_dissection(problem.epochs, CALIBRATION_KEY if calibrated else None)
    graph = linearized(problem, estimate)
    tree = _eliminate(graph, ordering)
    poses = np.array([tree.marginalCovariance(X(i)) for i in range(problem.epochs)])
    calibration = np.zeros((0, 0))
    if calibrated:
        try:
            calibration = np.array(tree.marginalCovariance(CALIBRATION_KEY))
        except RuntimeError:  # as in _eliminate, which a tree does not offer
            states = nested_dissection(problem.epochs, None)
            _, rest = graph.eliminatePartialSequential(states, gtsam.EliminateQR)
            keys = gtsam.Ordering()
            keys.push_back(CALIBRATION_KEY)
            calibration = np.array(np.linalg.inv(rest.hessian(keys)[0]))
    if held and problem.fields is not None:
        by_pose, by_calibration = _responses(problem, estimate, held)
        poses += np.einsum("hni,hnj->nij", by_pose, by_pose)
        calibration += by_calibration.T @ by_calibration
    return poses, calibration


def _responses(
    problem: Problem, estimate: Estimate, held: tuple[Block, ...]
) -> tuple[Array, Array]:
    """Return the steps that the held parameters cause, one for each column of their spread.

    Of the poses, shape (held, n, 6), and of the calibration, shape (held, dimension).
    """
    keys = [X(i) for i in range(problem.epochs)]
    by_pose, by_calibration = [], []
    for step in held_steps(problem, estimate, held):
        by_pose.append(step.vector(keys).reshape(-1, 6))
        by_calibration.append(step.at(CALIBRATION_KEY) if problem.blocks else np.zeros(0))
    return np.array(by_pose), np.array(by_calibration)


def held_steps(
    problem: Problem, estimate: Estimate, held: tuple[Block, ...]
) -> list[gtsam.VectorValues]:
    """Return the step of every variable that each column of the held parameters' spread causes.

    One sigma of each where they are independent.  The held parameters are left over when all else
    is eliminated, so that one elimination serves them all.
    """
    assert problem.fields is not None
    graph = problem.native.linearize(estimate.values)
    for i in range(graph.size()):
        factor = graph.at(i)
        assert isinstance(factor, gtsam.JacobianFactor)
        factor.getb()[...] = 0.0
    calibrated = bool(problem.blocks)
    if calibrated:
        graph.push_back(_prior_factor(problem, problem.declared))
    poses = read_poses(estimate.values)
    spread = prior_spread(problem.declared.site, held)
    columns = problem.fields.sensitivity(poses, estimate.calibration, held) @ spread
    graph.push_back(problem.fields.with_others(HELD_KEY, columns))
    ordering = nested_dissection(problem.epochs, CALIBRATION_KEY if calibrated else None)
    try:
        conditional, _ = graph.eliminatePartialSequential(ordering)
    except RuntimeError:  # as in _eliminate
        conditional, _ = graph.eliminatePartialSequential(ordering, gtsam.EliminateQR)
    steps = []
    for one in np.eye(columns.shape[-1]):
        given = gtsam.VectorValues()
        given.insert(HELD_KEY, one)
        steps.append(conditional.optimize(given))
    return steps
