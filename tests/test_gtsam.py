"""The estimators' graph as GTSAM's own, and fields as factors of a user's graph."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, V, X
from small_problem import SmallLog, small_log, small_problem
from test_measurement_seam import KINDS

import magfusion as mf
from magfusion.estimation.graph.drift_segments import Segments
from magfusion.estimation.graph.graph import Graph, GraphEstimate
from magfusion.estimation.graph.gtsam_factors import measurement_factors
from magfusion.estimation.graph.gtsam_graph import NativeProblem
from magfusion.estimation.graph.inertial import inertial_factor, links_between
from magfusion.estimation.graph.preintegration import cut_at_epochs, preintegrate
from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.propagation import propagate
from magfusion.estimation.graph.state import State, values_of
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.posterior.marginals import marginals
from magfusion.model.parameters import choose_blocks, corrected_imu, dimension
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.units import Array

SEVERAL = ("beacons", "moments", "magnetometer", "time-offset")


@pytest.fixture(scope="module")
def earth_result() -> mf.SmoothedLog:
    config = mf.SimulationConfig(DEMO_BOX_WORLD, duration=12.0)
    site = demo_site(coil_radius=None)
    simulated = mf.simulate_log(site, config, np.random.default_rng(3))
    return mf.smooth(simulated.log, site, mf.SmootherSettings(earth=True, estimate=SEVERAL))


@pytest.fixture(scope="module")
def small() -> SmallLog:
    return small_log(5)


def moved(problem: Graph, start: GraphEstimate, seed: int, size: float = 0.3) -> GraphEstimate:
    """Return an estimate at which every variable is away from its prior."""
    rng, step = np.random.default_rng(seed), gtsam.VectorValues()
    for key, scale in problem.damping_scales():
        step.insert(key, 0.1 * size * scale * rng.normal(size=len(scale)))
    return problem.moved(start, step)


def in_segments(small: SmallLog) -> tuple[Graph, GraphEstimate]:
    blocks = choose_blocks(small.site, SEVERAL)
    problem, start = small_problem(small, blocks, loss="huber")
    of_epoch = np.repeat([0, 1, 2], [9, 8, problem.epochs - 17])
    drifting = np.array([0, 1, 2, 7])
    weight = np.broadcast_to(50.0 * np.eye(4), (2, 4, 4))
    return replace(problem, segments=Segments(of_epoch, 1, drifting, weight)), start


def with_links(small: SmallLog) -> tuple[Graph, GraphEstimate]:
    blocks = choose_blocks(small.site, ("gyro-scale", "moments"), parameters=KINDS)
    problem, start = small_problem(small, blocks)
    zero, imu = np.zeros((problem.epochs, 3)), small.site.platform.imu

    def measured(calibration: mf.Calibration) -> list[gtsam.PreintegratedCombinedMeasurementsG]:
        corrected = corrected_imu(calibration, blocks, small.imu)
        increments = cut_at_epochs(corrected, 0.0, small.fields.time)
        return preintegrate(increments, imu, small.site.gravity, zero, zero)

    links = links_between(measured, start.calibration, blocks, lambda _: start.values)
    return replace(problem, links=tuple(links)), start


def robust(small: SmallLog) -> tuple[Graph, GraphEstimate]:
    return small_problem(small, choose_blocks(small.site, SEVERAL), loss="cauchy")


PROBLEMS = {"segments": in_segments, "inertial links": with_links, "a robust loss": robust}


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_native_graph_has_the_cost_and_the_slope_of_the_problem(
    name: str, small: SmallLog
) -> None:
    problem, start = PROBLEMS[name](small)
    at = moved(problem, start, 1)
    native = NativeProblem(problem, at)
    assert native.graph.error(native.values) == pytest.approx(problem.cost(at), rel=1e-9)
    # Elsewhere too: values are read, not remembered.
    rng, zero = np.random.default_rng(2), native.values.zeroVectors()
    keys = list(native.values.keys())
    direction = {key: 1e-4 * rng.normal(size=len(zero.at(key))) for key in keys}

    def gone(share: float) -> gtsam.Values:
        step = gtsam.VectorValues()
        for key in keys:
            step.insert(key, share * direction[key])
        return native.values.retract(step)

    cost = problem.cost(native.estimate(gone(1.0)))
    assert native.graph.error(gone(1.0)) == pytest.approx(cost, rel=1e-9)
    gradient = native.graph.linearize(native.values).gradientAtZero()
    slope = sum(float(gradient.at(key) @ direction[key]) for key in keys)
    ahead, behind = (native.graph.error(gone(share)) for share in (1e-2, -1e-2))
    assert slope == pytest.approx((ahead - behind) / 2e-2, rel=1e-5)


@pytest.mark.slow
def test_a_result_as_a_gtsam_graph_has_the_cost_of_the_last_pass(
    earth_result: mf.SmoothedLog,
) -> None:
    exported = earth_result.to_gtsam()
    assert exported.graph.error(exported.values) == pytest.approx(earth_result.cost, rel=1e-9)
    assert exported.time is earth_result.states.time
    for i, position in enumerate(earth_result.states.position_world):
        np.testing.assert_array_equal(exported.values.atPose3(X(i)).translation(), position)
    for i, block in enumerate(exported.blocks):
        assert len(exported.values.atVector(C(i))) == len(block.sigma)


@pytest.mark.slow
def test_gtsam_has_nothing_to_improve_in_a_polished_result(earth_result: mf.SmoothedLog) -> None:
    exported = earth_result.to_gtsam(polish=True)
    graph, values = exported.graph, exported.values
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    newton = graph.linearize(values).optimize()
    assert earth_result.states.pose_cov is not None
    for i, cov in enumerate(earth_result.states.pose_cov):
        sigma = np.sqrt(np.diag(cov))
        went = values.atPose3(X(i)).localCoordinates(solved.atPose3(X(i)))
        assert np.max(np.abs(went) / sigma) < 1e-6
        assert np.max(np.abs(newton.at(X(i))) / sigma) < 1e-6


# --- fields in a user's own graph ---


def numeric(factor: gtsam.NoiseModelFactor, values: gtsam.Values, key: int, size: int) -> Array:
    out = []
    for direction in 1e-6 * np.eye(size):
        steps = [gtsam.VectorValues(), gtsam.VectorValues()]
        for step, sign in zip(steps, (1.0, -1.0), strict=True):
            step.insert(key, sign * direction)
        ahead, behind = (factor.unwhitenedError(values.retract(step)) for step in steps)
        out.append((ahead - behind) / 2e-6)
    return np.array(out).T


def test_a_pose_from_field_factors_alone(small: SmallLog) -> None:
    fields, truth = small.fields, small.truth
    calibration = mf.initial_calibration(small.true_site, 0.0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, channel in enumerate(fields.channels):
        cov = fields.phasor_cov[4, k]
        phasor = fields.phasor_sensor[4, k]
        graph.add(mf.gtsam.field_factor(X(7), calibration, channel, phasor, cov))
    pose = gtsam.Pose3(gtsam.Rot3(truth.world_from_body[4]), truth.position_world[4])
    values.insert(X(7), pose.retract(np.array([0.02, -0.02, 0.01, 0.03, 0.02, -0.03])))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    sigma = np.sqrt(np.diag(gtsam.Marginals(graph, solved).marginalCovariance(X(7))))
    away = pose.localCoordinates(solved.atPose3(X(7)))
    assert np.max(np.abs(away) / sigma) < 4.0
    assert np.max(sigma[3:]) < 0.01
    with pytest.raises(ValueError, match="channel must be one of"):
        mf.gtsam.field_factor(X(7), calibration, ("Z", 0), phasor, cov)


def test_factors_have_the_derivatives_of_their_errors() -> None:
    site = demo_site(coil_radius=None)
    calibration = mf.initial_calibration(site, 0.0)
    keys = mf.gtsam.calibration_keys(calibration, SEVERAL)
    values, rng = gtsam.Values(), np.random.default_rng(5)
    values.insert(X(0), gtsam.Pose3(gtsam.Rot3.Expmap([0.3, 0.4, -0.8]), [0.4, -0.7, 1.2]))
    keys.insert(values, calibration)
    for i, block in enumerate(keys.blocks):
        values.update(C(i), block.sigma * rng.normal(size=len(block.sigma)))
    phasor = np.array([3e-7 + 1e-7j, -2e-7, 1e-7j])
    factors = [
        mf.gtsam.field_factor(
            X(0), calibration, site.channels[1], phasor, 1e-16 * np.eye(3), keys=keys, loss=None
        ),
        mf.gtsam.earth_field_factor(
            X(0),
            calibration,
            np.array([2e-5, 1e-6, -4e-5]),
            1e-14 * np.eye(3),
            keys=keys,
            robust=False,
        ),
    ]
    beacons = {keys.blocks[gtsam.Symbol(key).index()].owner for key in factors[0].keys()[1:]}
    assert site.channels[0][0] not in beacons
    assert site.channels[1][0] in beacons
    for factor in factors:
        linear = factor.linearize(values)
        assert isinstance(linear, gtsam.JacobianFactor)
        start = 0
        for key in list(factor.keys()):
            size = values.zeroVectors().at(key).size
            expected = numeric(factor, values, key, size)
            given = linear.getA()[:, start : start + size]
            scale = np.max(np.abs(expected)) + 1e-9
            np.testing.assert_allclose(given / scale, expected / scale, atol=2e-5)
            start += size


def test_zero_velocity_is_gtsams_own_prior() -> None:
    factor, values = mf.gtsam.zero_velocity_factor(V(3), 0.01), gtsam.Values()
    values.insert(V(3), np.array([0.02, 0.0, -0.01]))
    assert factor.error(values) == pytest.approx(2.5)


def test_the_prior_of_calibration_keys_is_that_of_the_site() -> None:
    calibration = mf.initial_calibration(demo_site(), 0.0)
    keys = mf.gtsam.calibration_keys(calibration, ("beacons",))
    values = gtsam.Values()
    keys.insert(values, calibration)
    for i, block in enumerate(keys.blocks):
        values.update(C(i), block.sigma)
    assert keys.prior_factor().error(values) == pytest.approx(0.5 * dimension(keys.blocks))


def test_considered_parameters_are_what_marginals_of_the_graph_do_not_have(
    earth_result: mf.SmoothedLog,
) -> None:
    exported = earth_result.to_gtsam()
    of_gtsam = gtsam.Marginals(exported.graph, exported.values)
    estimated, _, _ = marginals(earth_result.graph, earth_result.estimate)
    assert earth_result.states.pose_cov is not None
    ratio = []
    for i, whole in enumerate(earth_result.states.pose_cov):
        sigma = np.sqrt(np.diag(estimated[i]))
        own = of_gtsam.marginalCovariance(X(i))
        np.testing.assert_allclose(np.sqrt(np.diag(own)), sigma, rtol=1e-3)
        ratio.append(np.sqrt(np.diag(whole)) / sigma)
    assert np.min(ratio) > 1.0 - 1e-9
    assert 1.3 < np.median(ratio) < 1.9  # docs/gtsam.md has the figure


def test_an_exported_graph_is_not_serialised(earth_result: mf.SmoothedLog) -> None:
    graph = earth_result.to_gtsam().graph
    with pytest.raises(RuntimeError, match="clone"):
        graph.clone()


@pytest.mark.slow
def test_gtsams_optimiser_ends_at_the_same_trajectory(small: SmallLog) -> None:
    ours, theirs = (
        mf.smooth(small.log, small.site, mf.SmootherSettings(engine=engine))
        for engine in ("bordered", "gtsam")
    )
    assert theirs.iterations != ours.iterations
    assert ours.states.pose_cov is not None
    for i, cov in enumerate(ours.states.pose_cov):
        one, other = (result.estimate.values.atPose3(X(i)) for result in (ours, theirs))
        away = one.localCoordinates(other) / np.sqrt(np.diag(cov))
        assert np.max(np.abs(away)) < 1e-3


def test_isam2_fed_epoch_by_epoch_ends_where_the_fixed_lag_does(small: SmallLog) -> None:
    problem, start = small_problem(small, (), loss="cauchy")
    calibration, truth, site = start.calibration, small.truth, small.site
    measured, sigma = problem.measurements[0], np.repeat([0.02, 0.05, 0.1, 0.05, 0.002], 3)
    assert truth.velocity_world is not None
    state = State(
        float(truth.time[0]),
        truth.world_from_body[0],
        truth.position_world[0] + 0.02,
        truth.velocity_world[0],
        np.zeros(3),
        np.zeros(3),
        calibration,
        np.diag(sigma**2),
    )
    window = SlidingWindow(state, (), 100.0, ProcessNoise((), np.zeros(0)))
    parameters = gtsam.ISAM2Params()
    # GTSAM's thresholds are absolute: its defaults are many sigmas of these poses.
    parameters.setRelinearizeThreshold(1e-7)
    parameters.relinearizeSkip = 1
    steps = gtsam.ISAM2GaussNewtonParams()
    steps.setWildfireThreshold(1e-9)
    parameters.setOptimizationParams(steps)
    isam, keys = gtsam.ISAM2(parameters), mf.gtsam.CalibrationKeys(calibration, ())
    graph, values = gtsam.NonlinearFactorGraph(), values_of([state])
    graph.addPriorPose3(X(0), state.pose, gtsam.noiseModel.Diagonal.Sigmas(sigma[:6]))
    graph.addPriorVector(V(0), state.velocity_world, gtsam.noiseModel.Diagonal.Sigmas(sigma[6:9]))
    graph.addPriorConstantBias(
        B(0), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(sigma[9:])
    )
    kept = []  # GTSAM does not hold a reference to a factor of Python
    for i in range(1, len(truth)):
        predicted = propagate(window.state, small.imu, float(truth.time[i]), site, 0.0, blocks=())
        own = measured.rows(slice(i, i + 1))
        # To convergence: its usual one step leaves a tenth of the newest pose's sigma or more.
        window.absorb(predicted, [own.at(0)], predicted.state)
        assert predicted.link is not None
        graph.add(inertial_factor(i - 1, predicted.link.measurement))
        there = values_of([predicted.state])
        values.insert(X(i), there.atPose3(X(0)))
        values.insert(V(i), there.atVector(V(0)))
        values.insert(B(i), there.atConstantBias(B(0)))
        for factor in measurement_factors(own, keys, values):
            kept.append(factor)
            graph.add(factor)
        isam.update(graph, values)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for _ in range(3):
        isam.update()
    last = len(truth) - 1
    cov = isam.marginalCovariance(X(last))
    away = window.state.pose.localCoordinates(isam.calculateEstimatePose3(X(last)))
    assert np.max(np.abs(away) / np.sqrt(np.diag(cov))) < 0.01
    np.testing.assert_allclose(
        np.sqrt(np.diag(window.state.cov)[:6]), np.sqrt(np.diag(cov)), rtol=0.01
    )
