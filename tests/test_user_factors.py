"""Factors of a user's GTSAM graph in the estimators."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, V, X
from small_problem import SmallLog, small_log

import magfusion as mf
from magfusion.estimation.graph.graph import GraphEstimate
from magfusion.estimation.graph.gtsam_graph import NativeProblem
from magfusion.units import Array

SETTINGS = mf.SmootherSettings(estimate=("magnetometer",), tune=False)
TIMES = (3.13, 7.0, 10.21)  # s; the second is an epoch of the fields


@pytest.fixture(scope="module")
def small() -> SmallLog:
    return small_log(5, sigma=4e-8, perturb=False)


def speed(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
    """Return the speed's square less 0.04 m^2/s^2."""
    velocity = values.atVector(this.keys()[0])
    if jacobians is not None:
        jacobians[0] = 2.0 * velocity[None]
    return np.array([velocity @ velocity - 0.04])


def user_graph(small: SmallLog) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return one factor of each kind, which pull as much as the fields do."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    sigma = gtsam.noiseModel.Isotropic.Sigma
    first, last = (
        small.truth.position_world[np.searchsorted(small.truth.time, t)] for t in (3, 10)
    )
    graph.add(gtsam.GPSFactor(X(0), first + 0.02, sigma(3, 0.01)))
    graph.add(gtsam.BetweenFactorPose3(X(0), X(2), gtsam.Pose3(), sigma(6, 0.5)))
    huber = gtsam.noiseModel.mEstimator.Huber.Create(1.345)
    loss = gtsam.noiseModel.Robust.Create(huber, sigma(1, 0.005))
    anchor = first + np.array([2.0, 0.5, 0.1])
    graph.add(gtsam.RangeFactor3D(X(1), L(4), 2.0, loss))
    away = float(np.linalg.norm(last - anchor))
    graph.add(gtsam.RangeFactor3D(X(2), L(4), away, loss))
    graph.addPriorPoint3(L(4), anchor, sigma(3, 0.02))
    robust = gtsam.noiseModel.Robust.Create(huber, sigma(1, 0.02))
    graph.add(gtsam.CustomFactor(robust, [V(1)], speed))
    values.insert(L(4), anchor)
    return graph, values


def dense(result: mf.SmoothedLog) -> tuple[Array, Array]:
    """Return the step of a dense solution at a result, and the covariance of all variables."""
    linear = result.graph.linearized(result.estimate)
    jacobian, right = linear.jacobian(result.graph.ordering)
    cov = np.linalg.inv(jacobian.T @ jacobian)
    return np.asarray(cov @ (jacobian.T @ right)), np.asarray(cov)


@pytest.mark.slow
def test_users_factors_move_a_result_as_a_dense_solution_does(small: SmallLog) -> None:
    graph, values = user_graph(small)
    alone = mf.smooth(small.log, small.site, SETTINGS)
    result = mf.smooth(small.log, small.site, SETTINGS, factors=graph, values=values, times=TIMES)
    assert set(TIMES) <= set(result.states.time.tolist())
    assert result.states.pose_cov is not None
    assert alone.states.pose_cov is not None
    step, cov = dense(result)
    sigma = np.sqrt(np.diag(cov))
    assert np.max(np.abs(step) / sigma) < 0.02  # the pass ends at a millionth of the cost
    # The factors in the dense system are those of the user, and nothing else is.
    user = result.graph.user
    assert user is not None
    at = gtsam.Values(user.values if result.estimate.own is None else result.estimate.own)
    for j, time in enumerate(TIMES):
        i = int(np.searchsorted(result.states.time, time))
        at.insert(X(j), result.estimate.values.atPose3(X(i)))
        at.insert(V(j), result.estimate.values.atVector(V(i)))
        at.insert(B(j), result.estimate.values.atConstantBias(B(i)))
    without = mf.smooth(
        small.log, small.site, SETTINGS, factors=gtsam.NonlinearFactorGraph(), times=TIMES
    )
    rest = without.graph.cost(GraphEstimate(result.estimate.values, result.estimate.calibration))
    assert result.cost == pytest.approx(rest + graph.error(at), rel=1e-6)
    assert graph.error(at) > 0.5
    # They reduce the uncertainty where they are, and pull.
    rows, before = (np.searchsorted(r.states.time, TIMES) for r in (result, without))
    assert without.states.pose_cov is not None
    ratio = [
        np.sqrt(np.trace(result.states.pose_cov[a, 3:, 3:]) / np.trace(b[3:, 3:]))
        for a, b in zip(rows, without.states.pose_cov[before], strict=True)
    ]
    assert max(ratio) < 1.0 + 1e-9
    assert min(ratio) < 0.9
    shift = result.states.position_world[rows] - without.states.position_world[before]
    assert np.max(np.abs(shift)) > 1e-3
    order = result.graph.ordering
    start = {order.at(i): i for i in range(order.size())}
    widths = [len(result.graph.linearized(result.estimate).optimize().at(k)) for k in start]
    first = dict(zip(start, np.cumsum([0, *widths[:-1]]), strict=True))
    for i in rows:
        own = slice(first[X(i)], first[X(i)] + 6)
        np.testing.assert_allclose(
            np.sqrt(np.diag(cov[own, own])),
            np.sqrt(np.diag(gtsam_cov(result, int(i)))),
            rtol=1e-6,
        )


def gtsam_cov(result: mf.SmoothedLog, i: int) -> Array:
    exported = result.to_gtsam()
    return np.array(gtsam.Marginals(exported.graph, exported.values).marginalCovariance(X(i)))


def test_a_result_with_users_factors_is_exported_with_them(small: SmallLog) -> None:
    graph, values = user_graph(small)
    result = mf.smooth(small.log, small.site, SETTINGS, factors=graph, values=values, times=TIMES)
    exported = result.to_gtsam(polish=True)
    native = NativeProblem(result.graph, result.estimate)
    assert native.graph.error(native.values) == pytest.approx(result.cost, rel=1e-9)
    newton = exported.graph.linearize(exported.values).optimize()
    assert result.states.pose_cov is not None
    for i, cov in enumerate(result.states.pose_cov):
        assert np.max(np.abs(newton.at(X(i))) / np.sqrt(np.diag(cov))) < 1e-6
    _, trust = mf.judge_result(result, small.log)
    assert isinstance(trust, mf.Trust)
    assert not np.array_equal(exported.values.atPoint3(L(4)), values.atPoint3(L(4)))


WRONG: dict[str, tuple[int, tuple[float, ...], str]] = {
    "no time": (X(1), (3.0,), "x1, but times has 1"),
    "no value": (L(0), (3.0,), "l0, which has no initial value"),
    "a key of the estimator": (gtsam.symbol("c", 0), (3.0,), "c0, a key of the estimator"),
    "times that fall": (X(1), (3.0, 2.0), "finite and ascending"),
    "another type": (V(0), (3.0,), "cannot be evaluated"),
    "a time outside": (X(0), (300.0,), "outside the log"),
}


@pytest.mark.parametrize(("key", "times", "text"), WRONG.values(), ids=WRONG)
def test_wrong_factors_are_refused(
    small: SmallLog, key: int, times: tuple[float, ...], text: str
) -> None:
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.GPSFactor(key, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    with pytest.raises(mf.InputError, match=text):
        mf.smooth(small.log, small.site, SETTINGS, factors=graph, times=times)
