"""The smoother's own loop against GTSAM's native optimizer and against dense linear algebra."""

from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest
from derivatives import central_difference, relative_to_group
from gtsam.symbol_shorthand import B, V, X
from nees import average_nees_bounds
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from small_problem import SmallLog, small_log, small_problem

from magfusion.errors import EstimationError
from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.graph.factors import CALIBRATION_KEY
from magfusion.estimation.graph.graph import Graph, GraphEstimate, initial_estimate, read_states
from magfusion.estimation.graph.measurement import robust_weight
from magfusion.estimation.graph.state import states_in
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.posterior.marginals import marginals
from magfusion.estimation.solve.bordered import optimise
from magfusion.estimation.solve.ordering import nested_dissection
from magfusion.model.noise import measurement_cov
from magfusion.model.parameters import (
    Block,
    Calibration,
    choose_blocks,
    considered_blocks,
    difference,
    dimension,
    linearize_channels,
    predict_channels,
    prior_sigma,
    retract,
)
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors

SURVEY = ("beacons", "moments", "magnetometer", "extrinsics")


# --- GTSAM's own optimizer on the same problem, one variable for each calibration block ---


def block_key(index: int) -> int:
    return int(gtsam.symbol("k", index))


def turned_part(calibration: Calibration, block: Block) -> np.ndarray:
    site = calibration.site
    if block.owner == "sensor":
        return site.platform.magnetometer.body_from_sensor
    return next(b for b in site.beacons if b.name == block.owner).world_from_beacon


def insert_calibration(
    values: gtsam.Values, calibration: Calibration, declared: Calibration, blocks: tuple[Block, ...]
) -> None:
    step = difference(declared, calibration, blocks)
    for k, block in enumerate(blocks):
        if block.kind == "rotation":
            values.insert(block_key(k), gtsam.Rot3(turned_part(calibration, block)))
        else:
            values.insert(block_key(k), step[block.columns])


def read_calibration(
    values: gtsam.Values, declared: Calibration, blocks: tuple[Block, ...]
) -> Calibration:
    step = np.zeros(dimension(blocks))
    for k, block in enumerate(blocks):
        if block.kind == "rotation":
            turn = turned_part(declared, block).T @ values.atRot3(block_key(k)).matrix()
            step[block.columns] = Rotation.from_matrix(turn).as_rotvec()
        else:
            step[block.columns] = values.atVector(block_key(k))
    return retract(declared, blocks, step)


def field_error(
    i: int,
    small: SmallLog,
    declared: Calibration,
    blocks: tuple[Block, ...],
    _factor: gtsam.CustomFactor,
    values: gtsam.Values,
    jacobians: list[np.ndarray] | None,
) -> np.ndarray:
    pose = values.atPose3(X(i))
    predicted, by_pose, by_calibration = linearize_channels(
        read_calibration(values, declared, blocks),
        blocks,
        small.fields.time[[i]],
        pose.rotation().matrix()[None],
        pose.translation()[None],
    )
    phasor = small.fields.phasor_sensor[i]
    measured = np.concatenate([phasor.real, phasor.imag], axis=1)
    if jacobians is not None:
        jacobians[0] = by_pose[0].reshape(-1, 6)
        for k, block in enumerate(blocks):
            width = len(block.sigma)
            jacobians[k + 1] = by_calibration[0][..., block.columns].reshape(-1, width)
    return (predicted[0] - measured).ravel()


def native_graph(
    small: SmallLog, problem: Graph, blocks: tuple[Block, ...]
) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(problem.native)
    cov = measurement_cov(small.site, small.fields)
    for i in range(problem.epochs):
        of_parts = block_diag(*[block_diag(c, c) for c in cov[i]])
        noise = gtsam.noiseModel.Gaussian.Covariance(of_parts)
        keys = [X(i), *(block_key(k) for k in range(len(blocks)))]
        error = partial(field_error, i, small, problem.declared, blocks)
        graph.add(gtsam.CustomFactor(noise, keys, error))
    for k, block in enumerate(blocks):
        noise = gtsam.noiseModel.Diagonal.Sigmas(block.sigma)
        if block.kind == "rotation":
            turn = gtsam.Rot3(turned_part(problem.declared, block))
            graph.addPriorRot3(block_key(k), turn, noise)
        else:
            graph.addPriorVector(block_key(k), np.zeros(len(block.sigma)), noise)
    return graph


def native_values(problem: Graph, estimate: GraphEstimate) -> gtsam.Values:
    values = gtsam.Values(estimate.values)
    insert_calibration(values, estimate.calibration, problem.declared, problem.blocks)
    return values


@pytest.fixture(scope="module")
def solved() -> tuple[SmallLog, Graph, GraphEstimate, float]:
    """Solve a small problem with all of the survey estimated, by the own loop."""
    small = small_log(1)
    problem, start = small_problem(small, choose_blocks(small.site, SURVEY))
    result = optimise(problem, start, iterations=50, tolerance=1e-13)
    assert result.converged
    return small, problem, result.estimate, result.cost


def test_the_loop_ends_where_gtsams_own_optimizer_ends(
    solved: tuple[SmallLog, Graph, GraphEstimate, float],
) -> None:
    small, problem, estimate, cost = solved
    graph = native_graph(small, problem, problem.blocks)
    _, start = small_problem(small, problem.blocks)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-13)
    parameters.setAbsoluteErrorTol(1e-13)
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    native = gtsam.LevenbergMarquardtOptimizer(graph, native_values(problem, start), parameters)
    values = native.optimize()
    assert cost == pytest.approx(graph.error(values), rel=1e-6)
    own, other = states_in(estimate.values), states_in(values)
    assert np.allclose(own.position_world, other.position_world, rtol=0.0, atol=1e-6)  # m
    assert np.allclose(own.world_from_body, other.world_from_body, rtol=0.0, atol=1e-6)  # rad
    moved = difference(
        estimate.calibration,
        read_calibration(values, problem.declared, problem.blocks),
        problem.blocks,
    )
    assert np.all(np.abs(moved) < 1e-4 * prior_sigma(problem.blocks))
    assert np.max(np.abs(difference(problem.declared, estimate.calibration, problem.blocks))) > 1e-4


def test_the_cost_is_gtsams_anywhere(solved: tuple[SmallLog, Graph, GraphEstimate, float]) -> None:
    small, problem, estimate, _ = solved
    rng = np.random.default_rng(2)
    step = prior_sigma(problem.blocks) * rng.standard_normal(dimension(problem.blocks))
    elsewhere = GraphEstimate(estimate.values, retract(estimate.calibration, problem.blocks, step))
    native = native_graph(small, problem, problem.blocks).error(native_values(problem, elsewhere))
    assert problem.cost(elsewhere) == pytest.approx(native, rel=1e-9)


def same_covariance(result: np.ndarray, expected: np.ndarray, rtol: float) -> bool:
    """Compare after division by the expected sigmas: metres and radians alike."""
    sigma = np.sqrt(np.diagonal(expected))
    return bool(np.max(np.abs(result - expected) / np.outer(sigma, sigma)) < rtol)


def test_the_marginals_are_gtsams(solved: tuple[SmallLog, Graph, GraphEstimate, float]) -> None:
    small, problem, estimate, _ = solved
    graph = native_graph(small, problem, problem.blocks)
    native = gtsam.Marginals(graph, native_values(problem, estimate))
    poses, calibration, _ = marginals(problem, estimate)
    for i in range(problem.epochs):
        assert same_covariance(poses[i], native.marginalCovariance(X(i)), rtol=1e-6)
    for k, block in enumerate(problem.blocks):
        own = calibration[block.columns, block.columns]
        assert same_covariance(own, native.marginalCovariance(block_key(k)), rtol=1e-6)


# --- dense linear algebra ---


def dense(problem: Graph, estimate: GraphEstimate) -> tuple[np.ndarray, gtsam.Ordering]:
    ordering = gtsam.Ordering()
    for symbol in (X, V, B):
        for i in range(problem.epochs):
            ordering.push_back(symbol(i))
    if problem.blocks:
        ordering.push_back(CALIBRATION_KEY)
    jacobian, _ = problem.linearized(estimate).jacobian(ordering)
    return np.array(jacobian), ordering


def whitened_response(
    small: SmallLog, estimate: GraphEstimate, fixed: tuple[Block, ...]
) -> np.ndarray:
    """Field residuals' derivative by held parameters, in units of their sigma."""
    poses, time = states_in(estimate.values), small.fields.time
    cov = measurement_cov(small.site, small.fields)
    root = np.linalg.inv(np.linalg.cholesky(cov))

    def residual(step: np.ndarray) -> np.ndarray:
        moved = retract(estimate.calibration, fixed, step * prior_sigma(fixed))
        phasor = predict_channels(moved, time, poses.world_from_body, poses.position_world)
        parts = [(root @ part[..., None])[..., 0] for part in (phasor.real, phasor.imag)]
        return np.concatenate(parts, axis=-1).ravel()

    return central_difference(residual, dimension(fixed), 1e-2)


def phasors_of(problem: Graph) -> FieldPhasors:
    fields = problem.measurements[0]
    assert isinstance(fields, FieldPhasors)
    return fields


def weight_roots(problem: Graph, estimate: GraphEstimate) -> np.ndarray:
    """Square root of each field residual's robust weight, as a column."""
    fields = phasors_of(problem)
    error = fields.error(states_in(estimate.values), estimate.calibration)
    weight, _ = robust_weight(np.sum(error**2, axis=2), fields.robust)
    return np.repeat(np.sqrt(weight).ravel(), 6)[:, None]


@pytest.mark.parametrize("loss", [None, "cauchy"])
@pytest.mark.parametrize("groups", [(), ("magnetometer", "extrinsics")], ids=["none", "some"])
def test_what_is_held_is_considered_as_dense_algebra_has_it(
    groups: tuple[str, ...], loss: str | None
) -> None:
    small = small_log(3, epochs=8)
    if loss is not None:
        small = with_outliers(small, 3, 0.2)
    problem, start = small_problem(small, choose_blocks(small.site, groups), loss=loss)
    estimate = optimise(problem, start, iterations=50, tolerance=1e-12).estimate
    wanted = considered_blocks(small.site, problem.blocks)
    fixed = tuple(b for b in wanted if b.group != "time-offset")
    poses, calibration, _ = marginals(problem, estimate, fixed)
    alone, _, _ = marginals(problem, estimate)

    jacobian, _ = dense(problem, estimate)
    inverse = np.linalg.pinv(jacobian, rcond=1e-15)
    fields = slice(problem.native.size(), None)
    rows = sum(problem.native.at(i).dim() for i in range(fields.start))
    response = np.zeros((len(jacobian), dimension(fixed)))
    by_held = weight_roots(problem, estimate) * whitened_response(small, estimate, fixed)
    response[rows : rows + len(by_held)] = by_held
    moved = inverse @ response
    noise = inverse @ inverse.T
    expected = noise + moved @ moved.T
    for i in range(problem.epochs):
        own = slice(6 * i, 6 * i + 6)
        assert same_covariance(poses[i], expected[own, own], rtol=1e-4)
        assert same_covariance(alone[i], noise[own, own], rtol=1e-4)
    if problem.blocks:
        width = dimension(problem.blocks)
        assert same_covariance(calibration, expected[-width:, -width:], rtol=1e-4)
    # The survey has a share in these sigmas that the comparison could not miss.
    assert np.trace(poses[0][3:, 3:]) > 1.2 * np.trace(alone[0][3:, 3:])


@pytest.mark.slow
def test_a_considered_survey_covers_errors_of_the_survey() -> None:
    rng = np.random.default_rng(4)
    small = small_log(4, epochs=6, perturb=False)
    problem, start = small_problem(small, ())
    fixed = tuple(b for b in considered_blocks(small.site, ()) if b.group != "time-offset")
    estimate = optimise(problem, start, tolerance=1e-12).estimate
    with_survey, _, _ = marginals(problem, estimate, fixed)
    alone, _, _ = marginals(problem, estimate)
    steps = []
    for _ in range(300):
        moved = retract(
            problem.declared, fixed, prior_sigma(fixed) * rng.standard_normal(dimension(fixed))
        )
        result = optimise(replace(problem, declared=moved), GraphEstimate(estimate.values, moved))
        pose = result.estimate.values.atPose3(X(3))
        steps.append(estimate.values.atPose3(X(3)).localCoordinates(pose))
    # The data stay as they are: what scatters is the survey's part of the covariance.
    ratio = np.var(steps, axis=0) / np.diagonal(with_survey[3] - alone[3])
    # A variance of 300 draws is good to 8 %, one sigma.
    assert np.all(np.abs(ratio - 1.0) < 0.33), ratio


# --- the pieces ---


@pytest.mark.parametrize("epochs", [1, 2, 3, 17, 64, 100])
def test_the_ordering_holds_each_key_once_and_the_calibration_last(epochs: int) -> None:
    ordering = nested_dissection(epochs, CALIBRATION_KEY)
    keys = [ordering.at(i) for i in range(ordering.size())]
    states = {symbol(i) for symbol in (X, V, B) for i in range(epochs)}
    assert len(keys) == len(set(keys)) == 3 * epochs + 1
    assert set(keys[:-1]) == states
    assert keys[-1] == CALIBRATION_KEY
    assert nested_dissection(epochs, None).size() == 3 * epochs


def test_the_ordering_ends_with_the_epoch_that_parts_the_halves() -> None:
    ordering = nested_dissection(7, None)
    order = [gtsam.Symbol(ordering.at(3 * i)).index() for i in range(7)]
    assert order == [0, 2, 1, 4, 6, 5, 3]


@pytest.mark.parametrize("loss", [None, "huber", "cauchy"])
def test_a_robust_weight_is_the_derivative_of_its_loss(loss: str | None) -> None:
    square = np.geomspace(1e-3, 1e5, 200)
    step = 1e-6 * square
    slope = (robust_weight(square + step, loss)[1] - robust_weight(square - step, loss)[1]) / (
        2.0 * step
    )
    weight, rho = robust_weight(square, loss)
    assert np.allclose(weight, slope, rtol=1e-4, atol=0.0)
    assert np.all(rho <= square * (1.0 + 1e-12))
    assert np.allclose(rho[:20], square[:20], rtol=1e-2, atol=0.0)  # small ones count in full
    if loss is not None:
        assert weight[-1] < 0.02


def test_field_jacobians_are_difference_quotients_at_the_applied_time_offset() -> None:
    small = small_log(5, epochs=6)
    blocks = choose_blocks(small.site, (*SURVEY, "time-offset"))
    problem, estimate = small_problem(small, blocks)
    rng = np.random.default_rng(5)
    data = phasors_of(problem)
    own = 1e-6 * rng.standard_normal(data.by_time_offset.shape)  # T/s; some lock-in's
    fields = replace(data, by_time_offset=own)
    poses = states_in(estimate.values)
    by_calibration = fields.linearize(poses, estimate.calibration, blocks).by_calibration
    assert by_calibration is not None

    def moved(step: np.ndarray) -> np.ndarray:
        changed = retract(estimate.calibration, blocks, step * prior_sigma(blocks))
        return fields.error(poses, changed)

    quotient = central_difference(moved, dimension(blocks), 1e-2)
    analytic = by_calibration * prior_sigma(blocks)
    for block in blocks:
        columns = block.columns
        assert relative_to_group(quotient[..., columns], analytic[..., columns]) < 1e-4, block.name


# --- hard starts and bad data ---


def disturbed(truth: Trajectory, seed: int, metre: float, rad: float) -> Trajectory:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(0.0, rad, (len(truth), 3))).as_matrix()
    return replace(
        truth,
        world_from_body=truth.world_from_body @ turn,
        position_world=truth.position_world + rng.normal(0.0, metre, (len(truth), 3)),
        velocity_world=np.zeros((len(truth), 3)),
    )


def plain_gauss_newton(problem: Graph, estimate: GraphEstimate, steps: int) -> float:
    """Return the cost after undamped steps; infinite where they lead to a singular system."""
    ordering = nested_dissection(problem.epochs, CALIBRATION_KEY)
    try:
        for _ in range(steps):
            step = problem.linearized(estimate).optimize(ordering)
            rotated = retract(estimate.calibration, problem.blocks, step.at(CALIBRATION_KEY))
            estimate = GraphEstimate(estimate.values.retract(step), rotated)
        return problem.cost(estimate)
    except RuntimeError:
        return np.inf


def test_the_loop_recovers_by_damping_where_plain_steps_are_lost() -> None:
    small = small_log(11)
    problem, good = small_problem(small, choose_blocks(small.site, SURVEY))
    reached = optimise(problem, good, iterations=50)
    bad = initial_estimate(disturbed(small.truth, 11, metre=1.0, rad=1.2), problem.declared)
    costs = [problem.cost(bad)]
    result = optimise(problem, bad, iterations=200, report=lambda _, cost: costs.append(cost))
    assert result.converged
    assert result.cost == pytest.approx(reached.cost, rel=1e-4)
    assert np.all(np.diff(costs) <= 0.0)
    assert plain_gauss_newton(problem, bad, 60) > 1e3 * reached.cost


def test_a_start_without_finite_cost_is_refused() -> None:
    small = small_log(6, epochs=4)
    lost_epochs = replace(small.truth, position_world=np.full((4, 3), np.nan))
    problem, start = small_problem(small, (), start=lost_epochs)
    with pytest.raises(EstimationError, match="no finite cost"):
        optimise(problem, start)


def with_outliers(small: SmallLog, seed: int, share: float) -> SmallLog:
    """Turn a share of the phasors into nonsense of their own size."""
    rng = np.random.default_rng(seed)
    phasor = small.fields.phasor_sensor.copy()
    bad = rng.random(phasor.shape[:2]) < share
    size = np.linalg.norm(phasor[bad], axis=1, keepdims=True)
    phasor[bad] += 0.3 * size * rng.standard_normal((np.sum(bad), 3))
    return replace(small, fields=replace(small.fields, phasor_sensor=phasor))


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_a_robust_loss_survives_twenty_per_cent_of_outliers(loss: str) -> None:
    small = small_log(7, perturb=False)
    corrupted = with_outliers(small, 7, 0.2)
    ate = {}
    for name in (None, loss):
        problem, start = small_problem(corrupted, (), loss=name)
        result = optimise(problem, start, iterations=100)
        states = read_states(result.estimate.values, small.truth.time)
        ate[name] = trajectory_errors(states, small.truth, max_gap=1.0).ate
    assert ate[loss] < 0.01  # m
    assert ate[None] > 0.03  # m
    assert ate[None] > 5.0 * ate[loss]


@pytest.mark.slow
def test_a_robust_loss_survives_outliers_from_its_own_start() -> None:
    corrupted = with_outliers(small_log(8, epochs=40, perturb=False), 8, 0.2)
    result = {
        loss: smooth(corrupted.log, corrupted.site, SmootherSettings(loss=loss, estimate=()))
        for loss in (None, "cauchy")
    }
    ate = {
        loss: trajectory_errors(result.states, corrupted.truth, max_gap=1.0).ate
        for loss, result in result.items()
    }
    assert ate["cauchy"] < 0.01  # m
    assert ate[None] > 3.0 * ate["cauchy"]


def test_a_missing_channel_has_no_say() -> None:
    small = small_log(9, epochs=10)
    phasor = small.fields.phasor_sensor.copy()
    phasor[4, 1] = phasor[7] = np.nan
    cov = small.fields.phasor_cov.copy()
    cov[4, 1] = cov[7] = np.nan
    holed = replace(small, fields=replace(small.fields, phasor_sensor=phasor, phasor_cov=cov))
    problem, start = small_problem(holed, ())
    rows = phasors_of(problem).linearize(states_in(start.values), start.calibration, ())
    assert rows.by_pose is not None
    assert np.all(rows.error[4, 1] == 0.0)
    assert np.all(rows.by_pose[7] == 0.0)
    assert np.all(rows.error[4, 0] != 0.0)
    result = optimise(problem, start)
    states = read_states(result.estimate.values, small.truth.time)
    assert trajectory_errors(states, small.truth, max_gap=1.0).ate < 0.01  # m
    poses, _, _ = marginals(problem, result.estimate)
    trace = np.trace(poses[:, 3:, 3:], axis1=1, axis2=2)
    whole, _, _ = marginals(small_problem(small, ())[0], result.estimate)
    ratio = trace / np.trace(whole[:, 3:, 3:], axis1=1, axis2=2)
    assert np.argmax(ratio) == 7  # the IMU alone carries the empty epoch
    assert ratio[7] > 1.1
    assert np.all(ratio > 1.0 - 1e-9)


def test_loose_coupling_agrees_with_tight_within_millimetres() -> None:
    small = small_log(10)
    tight = smooth(small.log, small.site, SmootherSettings(estimate=()))
    loose = smooth(small.log, small.site, SmootherSettings(coupling="loose"))
    assert loose.blocks == ()
    assert np.all(np.isnan(loose.residual))
    separate = np.linalg.norm(loose.states.position_world - tight.states.position_world, axis=1)
    assert np.max(separate) < 0.005  # m
    for result in (tight, loose):
        assert trajectory_errors(result.states, small.truth, max_gap=1.0).ate < 0.01  # m


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["tight", "loose"])
def test_the_sigmas_of_either_coupling_hold_the_error_of_the_survey(coupling: str) -> None:
    settings = SmootherSettings(coupling=coupling, estimate=())
    nees = []
    for seed in range(100, 120):
        small = small_log(seed)
        errors = trajectory_errors(
            smooth(small.log, small.site, settings).states, small.truth, max_gap=1.0
        )
        assert errors.nees is not None
        nees.append(np.mean(errors.nees))
    low, high = average_nees_bounds(6, len(nees), confidence=0.999)
    # Loose coupling weighs its fixes by the survey's error as well: it may err on the safe side.
    assert (0.5 if coupling == "loose" else 1.0) * low < np.mean(nees) < high, np.mean(nees)
