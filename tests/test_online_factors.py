"""GTSAM factors of a user's in the online estimators."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, V, X
from online_log import OnlineLog, epoch, online_log
from small_problem import SmallLog, small_log, small_problem
from test_measurement_seam import one_update
from test_user_factors import speed

import magfusion as mf
from magfusion.estimation.graph.gtsam_factors import CalibrationKeys, measurement_factors
from magfusion.estimation.graph.inertial import inertial_factor
from magfusion.estimation.graph.kalman import considered_share, partial_update
from magfusion.estimation.graph.preintegration import cut_at_epochs, preintegrate
from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.propagation import propagate
from magfusion.estimation.graph.state import State, between, values_of
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.estimation.measurements.factor_of_state import state_factor
from magfusion.estimation.online.fixed_lag import SlidingWindow
from magfusion.estimation.online.window_prior import WindowPrior
from magfusion.model.parameters import PHASOR_PARAMETERS
from magfusion.units import Array

SIGMA = gtsam.noiseModel.Isotropic.Sigma
PRIOR_SIGMA = np.repeat([0.02, 0.05, 0.1, 0.05, 0.002], 3)  # rad, m, m/s, m/s^2, rad/s
Given = tuple[gtsam.NonlinearFactorGraph, gtsam.Values, list[float]]


@pytest.fixture(scope="module")
def small() -> SmallLog:
    return small_log(5, sigma=4e-8, perturb=False)


def as_graph(*factors: gtsam.NonlinearFactor) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def a_position(small: SmallLog) -> Given:
    """Return a position between two epochs that is off by a sigma."""
    place = small.truth.position_world[4] + [0.01, 0.0, -0.01]
    return as_graph(gtsam.GPSFactor(X(0), place, SIGMA(3, 0.01))), gtsam.Values(), [2.55]


def a_step(small: SmallLog, begin: float, end: float) -> Given:
    """Return a relative pose, of states of which none is an epoch's."""
    rows = np.searchsorted(small.truth.time, [begin, end])
    first, last = (
        gtsam.Pose3(gtsam.Rot3(small.truth.world_from_body[k]), small.truth.position_world[k])
        for k in rows
    )
    factor = gtsam.BetweenFactorPose3(X(0), X(1), first.between(last), SIGMA(6, 0.02))
    return as_graph(factor), gtsam.Values(), [begin + 0.03, end - 0.07]


def ranges(small: SmallLog, times: list[float], sigma: float = 0.005) -> Given:
    """Return distances to a point that is roughly known."""
    rows = np.searchsorted(small.truth.time, times)
    point = small.truth.position_world[rows[0]] + [1.5, 0.4, 0.2]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for j, k in enumerate(rows):
        away = float(np.linalg.norm(small.truth.position_world[k] - point))
        graph.add(gtsam.RangeFactor3D(X(j), L(0), away, SIGMA(1, sigma)))
    graph.addPriorPoint3(L(0), point + 0.02, SIGMA(3, 0.03))
    values.insert(L(0), point + 0.02)
    return graph, values, times


def a_speed() -> Given:
    robust = gtsam.noiseModel.mEstimator.Huber.Create(1.345)
    noise = gtsam.noiseModel.Robust.Create(robust, SIGMA(1, 0.02))
    return as_graph(gtsam.CustomFactor(noise, [V(0)], speed)), gtsam.Values(), [6.31]


CASES: dict[str, Callable[[SmallLog], list[Given]]] = {
    "a position": lambda small: [a_position(small)],
    "a step of half a second": lambda small: [a_step(small, 5.0, 5.5)],
    "ranges to a point of its own": lambda small: [ranges(small, [4.5, 5.5, 6.0])],
    "a function of its own": lambda _: [a_speed()],
    "several that overlap": lambda small: [
        a_position(small),
        *(a_step(small, begin, begin + 1.5) for begin in np.arange(1.0, 10.0, 0.5).tolist()),
        ranges(small, [2.5, 3.5]),
        ranges(small, [9.0, 9.5, 10.5]),
        a_speed(),
    ],
}


def first_state(small: SmallLog) -> State:
    truth = small.truth
    assert truth.velocity_world is not None
    calibration = mf.initial_calibration(small.site, float(np.mean(small.fields.time)))
    position = truth.position_world[0] + 0.02
    start = truth.world_from_body[0], position, truth.velocity_world[0]
    cov = np.diag(PRIOR_SIGMA**2)
    return State(float(truth.time[0]), *start, np.zeros(3), np.zeros(3), calibration, cov)


def in_window(small: SmallLog, given: list[Given], lag: float) -> SlidingWindow:
    """Return the window at the end, converged at every epoch."""
    measured = small_problem(small, ())[0].measurements[0]
    window = SlidingWindow(first_state(small), (), lag, ProcessNoise((), np.zeros(0)))
    window.waiting = [UserFactors.of(graph, values, times) for graph, values, times in given]
    for i in range(1, len(small.truth)):
        time = float(small.truth.time[i])
        predicted = propagate(window.state, small.imu, time, small.site, 0.0)
        window.absorb(predicted, [measured.rows(slice(i, i + 1)).at(0)], predicted.state)
    return window


def dense(small: SmallLog, given: list[Given]) -> tuple[Array, gtsam.Values, Array]:
    """Return times, states and their poses' covariances of a solution of the whole log."""
    problem, start = small_problem(small, ())
    time = np.unique(np.concatenate([small.fields.time, *(times for _, _, times in given)]))
    zero, imu, state = np.zeros((len(time), 3)), small.site.platform.imu, first_state(small)
    steps = cut_at_epochs(small.imu, 0.0, time)
    graph, diagonal = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Diagonal.Sigmas
    graph.addPriorPose3(X(0), state.pose, diagonal(PRIOR_SIGMA[:6]))
    graph.addPriorVector(V(0), state.velocity_world, diagonal(PRIOR_SIGMA[6:9]))
    graph.addPriorConstantBias(B(0), gtsam.imuBias.ConstantBias(), diagonal(PRIOR_SIGMA[9:]))
    for i, measurement in enumerate(preintegrate(steps, imu, small.site.gravity, zero, zero)):
        graph.add(inertial_factor(i, measurement))
    before = np.maximum(np.searchsorted(small.truth.time, time + 1e-6) - 1, 0)
    path = small.truth
    assert path.velocity_world is not None
    values = values_of(
        [
            replace(
                state,
                world_from_body=path.world_from_body[k],
                position_world=path.position_world[k],
                velocity_world=path.velocity_world[k],
            )
            for k in before
        ]
    )
    measured = replace(problem.measurements[0], epoch=np.searchsorted(time, small.fields.time))
    keys, kept = CalibrationKeys(start.calibration, ()), []
    for factor in measurement_factors(measured.rows(slice(1, None)), keys, values):
        kept.append(factor)
        graph.add(factor)
    for j, (own, initial, times) in enumerate(given):
        at = np.searchsorted(time, times)
        for key in list(initial.keys()):
            values.insert(L(100 + j), initial.atPoint3(key))
        names = {symbol(i): symbol(int(k)) for symbol in (X, V) for i, k in enumerate(at)}
        names[L(0)] = L(100 + j)
        for i in range(own.size()):
            factor = own.at(i)
            if isinstance(factor, gtsam.CustomFactor):
                renamed = [names[key] for key in list(factor.keys())]
                graph.add(gtsam.CustomFactor(factor.noiseModel(), renamed, speed))
            else:
                graph.add(factor.rekey([names[key] for key in list(factor.keys())]))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    jacobian, _ = graph.linearize(solved).jacobian()
    cov = np.linalg.inv(jacobian.T @ jacobian)
    keys_of = sorted(solved.keys())
    widths = [len(solved.zeroVectors().at(key)) for key in keys_of]
    begin = dict(zip(keys_of, np.cumsum([0, *widths]), strict=False))
    return (
        time,
        solved,
        np.array([cov[b : b + 6, b : b + 6] for b in (begin[X(i)] for i in range(len(time)))]),
    )


@pytest.mark.parametrize("name", CASES)
def test_a_window_with_factors_ends_where_a_dense_solution_does(small: SmallLog, name: str) -> None:
    given = CASES[name](small)
    window, alone = in_window(small, given, 30.0), in_window(small, [], 30.0)
    time, solved, cov = dense(small, given)
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    assert window.dropped == 0
    assert not window.waiting
    assert [node.state.time for node in window.nodes] == time.tolist()
    for i, node in enumerate(window.nodes):
        away = node.state.pose.localCoordinates(solved.atPose3(X(i))) / sigma[i]
        assert np.max(np.abs(away)) < 0.01
    newest = np.sqrt(np.diag(window.state.cov)[:6])
    np.testing.assert_allclose(newest, sigma[-1], rtol=0.01)
    pulled = [
        node.state.pose.localCoordinates(window.nodes[i].state.pose) / sigma[i]
        for node in alone.nodes
        for i in [int(np.searchsorted(time, node.state.time))]
    ]
    assert np.max(np.abs(pulled)) > 0.2


@pytest.mark.slow
def test_states_that_left_stay_as_clones_for_the_factors_on_them(small: SmallLog) -> None:
    given = CASES["several that overlap"](small)
    window = in_window(small, given, 2.0)
    time, solved, cov = dense(small, given)
    assert [clone.time for clone in window.clones] == [9.0, 9.03, 9.5, 9.53]
    assert all(clone.time < window.oldest for clone in window.clones)
    assert all(factors.time[-1] >= window.oldest for factors in window.factors)
    for state in (*window.clones, *(node.state for node in window.nodes)):
        i = int(np.searchsorted(time, state.time))
        away = state.pose.localCoordinates(solved.atPose3(X(i))) / np.sqrt(np.diag(cov[i]))
        # What left is linearised elsewhere: 0.02 without any factor.
        assert np.max(np.abs(away)) < 0.05
    newest = np.sqrt(np.diag(window.state.cov)[:6])
    np.testing.assert_allclose(newest, np.sqrt(np.diag(cov[-1])), rtol=0.01)
    assert window.dropped == 0


@pytest.mark.parametrize("considered", [0, 2])
def test_clones_change_nothing_in_the_drift_and_the_considered_parameters(considered: int) -> None:
    rng, size, states = np.random.default_rng(3), 15 + 4, (first_state(small_log(5)),) * 3
    root, mean = rng.normal(size=(30 + size, 30 + size)), rng.normal(size=30 + size)
    joint = WindowPrior(states, root, root @ mean)
    cov = np.linalg.inv(root.T @ root)[30:, 30:]
    alone = np.linalg.inv(np.linalg.cholesky(cov))
    share, noise = considered_share(size, considered), np.diag([0.0, 0.3, 0.0, 0.2])
    known = np.diag(rng.uniform(0.5, 2.0, size))
    several, single = (
        prior.predicted(noise, known, share)
        for prior in (joint, WindowPrior(states[:1], alone, alone @ mean[30:]))
    )
    for prior in (several, single):
        inverse = np.linalg.inv(prior.sqrt_information)
        expected = partial_update(mean[30:], cov.copy(), known, share)
        np.testing.assert_allclose(
            (inverse @ prior.right)[-size:], expected[0], rtol=1e-6, atol=1e-9
        )
        expected[1][15:, 15:] += noise
        np.testing.assert_allclose(
            (inverse @ inverse.T)[-size:, -size:], expected[1], rtol=1e-6, atol=1e-9
        )


def test_a_factor_that_fails_leaves_the_window_as_it_was(small: SmallLog) -> None:
    window, time = in_window(small, [], 4.0), float(small.truth.time[-1])
    before = window.nodes, window.prior, window.state
    predicted = propagate(window.state, small.imu, time + 0.3, small.site, 0.0)
    wrong = as_graph(gtsam.GPSFactor(V(0), np.zeros(3), SIGMA(3, 0.1)))
    window.waiting = [UserFactors.of(wrong, None, [time - 0.1])]
    with pytest.raises(mf.InputError, match="a factor of yours cannot be evaluated"):
        window.absorb(predicted, [])
    assert (window.nodes, window.prior, window.state) == before
    assert window.dropped == 1
    window.absorb(predicted, [])
    assert window.state.time == predicted.state.time


# --- a factor on one state, for both estimators ---


def state_factors() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return factors on the pose, the velocity and the bias, and on a point of their own."""
    huber = gtsam.noiseModel.mEstimator.Huber.Create(1.345)
    robust = gtsam.noiseModel.Robust.Create(huber, SIGMA(1, 0.05))
    point, values = np.array([1.5, 0.4, 1.0]), gtsam.Values()
    values.insert(L(0), point)
    graph = as_graph(
        gtsam.GPSFactor(X(0), np.array([0.3, 0.2, 1.1]), SIGMA(3, 0.02)),
        gtsam.RangeFactor3D(X(0), L(0), 1.0, SIGMA(1, 0.002)),
        gtsam.CustomFactor(robust, [V(0)], speed),
        gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), SIGMA(6, 0.02)),
    )
    graph.addPriorPoint3(L(0), point, SIGMA(3, 0.001))
    return graph, values


def test_online_factors_have_the_effect_of_a_dense_solution() -> None:
    graph, values = state_factors()
    measured = [state_factor(UserFactors.of(graph, values, [0.0]))]
    light, window, predicted, blocks = one_update(("moments",), PHASOR_PARAMETERS, measured)
    prior = predicted.state
    values.insert(X(0), prior.pose)
    values.insert(V(0), prior.velocity_world)
    values.insert(B(0), gtsam.imuBias.ConstantBias(prior.accel_bias_body, prior.gyro_bias_body))
    ordering = gtsam.Ordering()
    for key in (X(0), V(0), B(0), L(0)):
        ordering.push_back(key)
    jacobian, right = graph.linearize(values).jacobian(ordering)
    size = len(prior.cov)
    whole = np.zeros((len(right), size + 3))
    whole[:, :15], whole[:, size:] = jacobian[:, :15], jacobian[:, 15:]
    information = whole.T @ whole
    information[:size, :size] += np.linalg.inv(prior.cov)
    cov = np.linalg.inv(information)
    step, cov = (cov @ whole.T @ right)[:size], cov[:size, :size]
    sigma = np.sqrt(np.diag(cov))
    assert np.max(np.abs(step) / sigma) > 0.1
    for state in (light, window):
        np.testing.assert_allclose(between(prior, state, blocks) / sigma, step / sigma, atol=0.01)
        np.testing.assert_allclose(
            state.cov / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=0.01
        )


# --- the navigator ---


def fed(
    log: OnlineLog, settings: mf.NavigatorSettings, give: Callable[[mf.Navigator, float], None]
) -> tuple[mf.Navigator, list[State], list[State]]:
    """Feed a log; return the states of the epochs and those that left the window."""
    navigator, states, lagged = mf.Navigator(log.site, settings), list[State](), list[State]()
    for k, now in enumerate(log.fields.time.tolist()):
        begin = -np.inf if k == 0 else log.fields.time[k - 1]
        own = (log.imu.time >= begin) & (log.imu.time < now)
        navigator.add_imu(log.imu.time[own], log.imu.gyro_body[own], log.imu.accel_body[own])
        navigator.add_fields(epoch(log.fields, k))
        give(navigator, now)
        states += navigator.take()
        lagged += navigator.take_lagged()
    return navigator, states, lagged


def nothing(_navigator: mf.Navigator, _now: float) -> None:
    """Add nothing."""


@pytest.mark.parametrize("estimator", ["smoother", "ekf"])
def test_the_navigator_creates_the_state_of_a_factor(
    estimator: Literal["smoother", "ekf"],
) -> None:
    log, when = online_log(6, 13.0), 11.13
    truth = log.motion.trajectory(np.array([when])).position_world[0]

    def give(navigator: mf.Navigator, now: float) -> None:
        if now - 0.5 < when <= now:
            navigator.add_factor(gtsam.GPSFactor(X(0), truth, SIGMA(3, 1e-4)), times=[when])

    navigator, states, _ = fed(log, mf.NavigatorSettings(estimator=estimator), give)
    assert navigator.counts["measurement too late"] == 0
    there = next(state for state in states if state.time == when)
    assert np.linalg.norm(there.position_world - truth) < 3e-4
    assert there.position_sigma < 1.1e-4


@pytest.mark.slow
def test_the_navigator_makes_states_between_its_epochs_for_odometry() -> None:
    log, given = online_log(6, 16.0), list[float]()

    def give(navigator: mf.Navigator, now: float) -> None:
        times = [now - 0.65, now - 0.15]  # s; they come late, as those of a camera do
        if now < 8.0:
            return
        at = log.motion.trajectory(np.array(times))
        first, last = (
            gtsam.Pose3(gtsam.Rot3(turn), place)
            for turn, place in zip(at.world_from_body, at.position_world, strict=True)
        )
        step = gtsam.BetweenFactorPose3(X(0), X(1), first.between(last), SIGMA(6, 1e-4))
        navigator.add_factor(step, times)
        given.extend(times)

    settings = mf.NavigatorSettings(lag=2.0)
    navigator, states, lagged = fed(log, settings, give)
    _, alone, _ = fed(log, settings, nothing)
    assert "factors dropped" not in navigator.losses
    left = [state.time for state in lagged]
    assert {time for time in given if time <= left[-1]} <= set(left)
    assert left == sorted(left)
    assert states[-1].position_sigma < 0.6 * alone[-1].position_sigma
    errors = log.errors(states[-6:]).position_world
    assert np.max(np.linalg.norm(errors, axis=1)) < 5.0 * states[-1].position_sigma


REFUSED: dict[str, tuple[Literal["smoother", "ekf"], list[float], str]] = {
    "no time": ("smoother", [], "that are none or too close"),
    "one state twice": ("smoother", [11.0, 11.000001], "that are none or too close"),
    "a state before the window": ("smoother", [3.0, 11.0], "3, 11 s, not within the smoother's"),
    "states too far apart": ("smoother", [11.0, 16.5], "not within the smoother's lag of 4 s"),
    "an earlier state of the filter": ("ekf", [11.0], "the filter has only the state of one"),
    "two states of the filter": ("ekf", [12.9, 13.2], "12.9, 13.2 s, but the filter has only"),
}


@pytest.mark.parametrize(("estimator", "times", "text"), REFUSED.values(), ids=REFUSED)
def test_factors_on_states_that_the_estimator_has_not_are_refused(
    estimator: Literal["smoother", "ekf"], times: list[float], text: str
) -> None:
    settings = mf.NavigatorSettings(estimator=estimator)
    navigator, _, _ = fed(online_log(6, 13.0), settings, nothing)
    graph = as_graph(
        *(gtsam.PriorFactorPose3(X(j), gtsam.Pose3(), SIGMA(6, 0.1)) for j in range(len(times)))
    )
    with pytest.raises(mf.InputError, match=text):
        navigator.add_factor(graph, times)


@pytest.mark.slow
def test_a_checkpoint_stores_no_factor() -> None:
    step = gtsam.BetweenFactorPose3(X(0), X(1), gtsam.Pose3(), SIGMA(6, 1.0))
    log = online_log(6, 15.0)

    def give(navigator: mf.Navigator, now: float) -> None:
        if 9.5 < now < 10.0:
            navigator.checkpoint()
            navigator.add_factor(step, [now - 0.3, now + 0.1])
        if 9.5 < now < 13.0:
            with pytest.raises(mf.InputError, match="cannot store a GTSAM factor"):
                navigator.checkpoint()

    settings = mf.NavigatorSettings(lag=3.0)
    navigator, _, _ = fed(log, settings, give)
    navigator.checkpoint()
    early = mf.Navigator(log.site)
    early.add_factor(step, [1.0, 2.0])
    with pytest.raises(mf.InputError, match="cannot store a GTSAM factor"):
        early.checkpoint()
