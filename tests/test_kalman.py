"""The filter as users of filterpy know it: attributes, likelihood, overrides, and its graph."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from gtsam.symbol_shorthand import B, V, X
from scipy.optimize import least_squares
from scipy.stats import multivariate_normal, norm
from test_ekf import SEED, a_site, a_state, an_epoch, an_imu, one_interval

from magfusion.errors import EstimationError
from magfusion.estimation.graph.inertial import inertial_factor
from magfusion.estimation.graph.kalman import PartialUpdateFilter, considered_share
from magfusion.estimation.graph.measurement import measured_rows
from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.propagation import Propagated, propagate
from magfusion.estimation.graph.state import MOTION, POSITION, State, between, moved, values_of
from magfusion.estimation.measurements.zero_velocity import ZeroVelocity
from magfusion.estimation.online.ekf import ErrorStateFilter
from magfusion.estimation.online_integrity.bank import SubsetBank
from magfusion.estimation.solve import sparse_rows
from magfusion.files.plain_data import to_plain
from magfusion.model.parameters import choose_blocks, dimension
from magfusion.units import Array

GROUPS = ("beacons", "moments")
SIZE, ROWS = 9, 5


def a_problem(seed: int = 1) -> tuple[Array, Array, Array]:
    """Return covariance, measured values and derivatives, whitened, of numbers that say nothing."""
    rng = np.random.default_rng(seed)
    root, H = rng.normal(size=(SIZE, SIZE)), rng.normal(size=(ROWS, SIZE))
    return root @ root.T + 0.1 * np.eye(SIZE), rng.normal(size=ROWS), H


def a_filter(cov: Array, share: Array | None = None) -> PartialUpdateFilter:
    kalman = PartialUpdateFilter(len(cov), share)
    kalman.P = cov
    return kalman


def separate(one: Array, other: Array, cov: Array) -> float:
    """Return the largest difference of steps (n,) or covariances (n, n), in sigmas of another."""
    sigma = np.sqrt(np.diag(cov))
    scale = sigma if np.ndim(one) == 1 else np.outer(sigma, sigma)
    return float(np.max(np.abs(one - other) / scale))


# --- attributes ---


def test_attributes_after_an_update_are_those_of_the_textbook() -> None:
    start, blocks, predicted, epoch = one_interval(GROUPS)
    kalman = ErrorStateFilter(start, blocks)
    kalman.absorb(predicted, epoch)
    error, H = measured_rows(epoch, predicted.state, blocks)
    P = predicted.transition @ start.cov @ predicted.transition.T + predicted.noise
    S = H @ P @ H.T + np.eye(len(error))
    K = P @ H.T @ np.linalg.inv(S)
    posterior = (np.eye(len(P)) - K @ H) @ P
    assert isinstance(kalman, ExtendedKalmanFilter)
    for result, expected in (
        (kalman.F, predicted.transition),
        (kalman.Q, predicted.noise),
        (kalman.H, H),
        (kalman.z, -error),
        (kalman.y, -error),
        (kalman.R, np.eye(len(error))),
    ):
        np.testing.assert_array_equal(result, expected)
    np.testing.assert_allclose(kalman.S, S, rtol=1e-9)
    np.testing.assert_allclose(kalman.SI @ S, np.eye(len(S)), atol=1e-9)
    assert kalman.dim_z == len(error)
    assert separate(kalman.P_prior, P, P) < 1e-12
    assert separate(kalman.P_prior, predicted.state.cov, P) < 1e-12
    assert separate(kalman.K @ error, K @ error, posterior) < 1e-8
    assert separate(kalman.x_post, -K @ error, posterior) < 1e-8
    assert separate(kalman.P, posterior, posterior) < 1e-8
    np.testing.assert_array_equal(kalman.P, kalman.state.cov)


def test_the_error_is_zero_but_for_the_update_and_moves_the_nominal_state() -> None:
    start, blocks, predicted, epoch = one_interval(GROUPS)
    kalman = ErrorStateFilter(start, blocks)
    assert not np.any(kalman.x)
    kalman.absorb(predicted, epoch)
    assert not np.any(kalman.x)
    assert not np.any(kalman.x_prior)
    went = between(predicted.state, kalman.state, blocks)
    assert separate(went, kalman.x_post, kalman.P) < 1e-9
    kalman.absorb(replace(predicted, state=replace(predicted.state, time=9.0)), [])
    assert separate(between(predicted.state, kalman.state, blocks), 0.0 * went, kalman.P) < 1e-12


def test_a_failed_update_leaves_the_filter_as_it_was() -> None:
    start, blocks, predicted, epoch = one_interval(GROUPS)
    kalman = ErrorStateFilter(start, blocks)
    broken = replace(epoch[0], sqrt_information=1e200 * epoch[0].sqrt_information)
    with np.errstate(all="ignore"), pytest.raises(EstimationError, match="failed"):
        kalman.absorb(predicted, [broken])
    assert kalman.state is start
    np.testing.assert_array_equal(kalman.P, start.cov)
    assert not np.any(kalman.x)


def test_a_checkpoint_holds_the_state_and_nothing_of_filterpy() -> None:
    start, blocks, _, _ = one_interval(())
    plain = to_plain(replace(start, calibration=None))  # of a calibration rules are needed
    kalman = ErrorStateFilter(start, blocks)
    kalman.state = kalman.lagged = replace(start, calibration=None)
    kept = to_plain(kalman)
    assert kept.keys() == {"state", "lagged"}
    assert kept["state"].keys() == plain.keys()


# --- likelihood ---


@pytest.mark.parametrize("far", [False, True])
def test_the_likelihood_is_that_of_a_dense_gaussian(far: bool) -> None:
    start, blocks, predicted, epoch = one_interval(GROUPS)
    kalman = ErrorStateFilter(start, blocks)
    kalman.absorb(predicted, epoch, predicted.state if far else None)
    if far:  # of the last of its iterations
        assert np.max(np.abs(kalman.y)) > 0.0
    cov = kalman.H @ kalman.P_prior @ kalman.H.T + np.eye(kalman.dim_z)
    expected = multivariate_normal(cov=0.5 * (cov + cov.T)).logpdf(kalman.y)
    assert kalman.log_likelihood == pytest.approx(expected, rel=1e-6)
    assert kalman.likelihood == pytest.approx(np.exp(expected), rel=1e-3, abs=1e-300)
    square = kalman.y @ np.linalg.solve(cov, kalman.y)
    assert kalman.mahalanobis == pytest.approx(np.sqrt(square), rel=1e-6)


@pytest.mark.parametrize("far", [False, True])
def test_the_likelihood_is_exact_whatever_the_innovation_spans(far: bool) -> None:
    """Two independent numbers, one predicted a million times worse than the other."""
    kalman = a_filter(np.diag([1.0, 1.0, 4.0]))
    z, H = np.array([2e6, -1.5]), np.array([[1e6, 0.0, 0.0], [0.0, 1.0, 0.0]])
    (kalman.update_from_far if far else kalman.update_linear)(z, H)
    expected = norm.logpdf(z, scale=np.sqrt([1e12 + 1.0, 2.0])).sum()
    assert kalman.log_likelihood == pytest.approx(expected, rel=1e-9)
    assert kalman.mahalanobis == pytest.approx(np.sqrt(4.0 + 1.5**2 / 2.0), rel=1e-9)


@pytest.mark.parametrize("constant", [0, 3])
def test_all_is_as_in_filterpy(constant: int) -> None:
    cov, z, H = a_problem()
    transition = np.eye(SIZE) + 0.1 * np.eye(SIZE, k=1)
    transition[SIZE - constant :] = np.eye(SIZE)[SIZE - constant :]
    kalman, others = a_filter(cov), ExtendedKalmanFilter(SIZE, ROWS)
    others.x, others.P, R = np.zeros(SIZE), cov, np.diag(np.arange(1.0, 1.0 + ROWS))
    for filter_ in (kalman, others):
        filter_.F, filter_.Q = transition, 0.2 * np.eye(SIZE)
        filter_.predict()
    kalman.update_linear(z, H, R)
    others.update(z, lambda _: H, lambda x: H @ x, R)
    for name in ("x", "P", "K", "S", "SI", "y", "z", "x_post", "P_post", "x_prior", "P_prior"):
        np.testing.assert_allclose(
            getattr(kalman, name), getattr(others, name), rtol=1e-12, atol=1e-14, err_msg=name
        )
    for name in ("log_likelihood", "mahalanobis", "likelihood"):
        assert getattr(kalman, name) == pytest.approx(getattr(others, name), rel=1e-12)
    before = kalman.P
    kalman.update(None, None, None)
    np.testing.assert_array_equal(kalman.P, before)


# --- overrides ---


@pytest.mark.parametrize("share", ["considered", "partial"])
@pytest.mark.parametrize("far", [False, True])
def test_a_share_is_an_update_whose_gain_has_that_share(share: str, far: bool) -> None:
    """Of those considered it is zero; Joseph's form holds for any gain."""
    cov, z, H = a_problem()
    part = considered_share(SIZE, 3)
    assert part is not None
    np.testing.assert_array_equal(part, [1, 1, 1, 1, 1, 1, 0, 0, 0])
    if share == "partial":
        part = np.linspace(0.0, 1.0, SIZE)
    K = part[:, None] * (cov @ H.T @ np.linalg.inv(H @ cov @ H.T + np.eye(ROWS)))
    remaining = np.eye(SIZE) - K @ H
    expected = remaining @ cov @ remaining.T + K @ K.T
    kalman = a_filter(cov, part)
    kalman.x = np.arange(SIZE) / SIZE
    step = K @ (z - H @ kalman.x)
    (kalman.update_from_far if far else kalman.update_linear)(z, H)
    assert separate(kalman.x, np.arange(SIZE) / SIZE + step, cov) < 1e-12
    assert separate(kalman.P, expected, cov) < 1e-12
    np.testing.assert_allclose(kalman.K, K, atol=1e-12)
    np.testing.assert_array_equal(kalman.x_post, kalman.x)
    np.testing.assert_array_equal(kalman.P_post, kalman.P)
    if share == "considered":
        np.testing.assert_array_equal(kalman.P[6:, 6:], cov[6:, 6:])
        np.testing.assert_array_equal(kalman.x[6:], np.arange(6, SIZE) / SIZE)


def test_considered_parameters_of_a_state_are_those_whose_gain_is_zero() -> None:
    start, blocks, predicted, epoch = one_interval(GROUPS)
    considered = dimension(blocks) - blocks[0].columns.stop
    kalman = ErrorStateFilter(start, blocks, considered)
    kalman.absorb(predicted, epoch)
    error, H = measured_rows(epoch, predicted.state, blocks)
    P = predicted.state.cov
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(len(error)))
    K[-considered:] = 0.0
    remaining = np.eye(len(P)) - K @ H
    expected = remaining @ P @ remaining.T + K @ K.T
    assert separate(between(predicted.state, kalman.state, blocks), -K @ error, expected) < 1e-7
    assert separate(kalman.state.cov, expected, expected) < 1e-7


def test_rows_of_the_estimated_alone_update_as_filterpy(monkeypatch: pytest.MonkeyPatch) -> None:
    cov, z, H = a_problem(3)
    root = np.random.default_rng(3).normal(size=(ROWS, ROWS))
    R, share = root @ root.T + np.eye(ROWS), considered_share(SIZE, 4)
    whole = a_filter(cov, share)
    whole.H, whole.dim_z = H, ROWS
    whole.update(z, lambda _: H, lambda x: H @ x, R)
    for sparse_from in (1, sparse_rows.SPARSE_COLUMNS):
        monkeypatch.setattr(sparse_rows, "SPARSE_COLUMNS", sparse_from)
        rows = a_filter(cov, share)
        rows.update_linear(z, H, R)
        for name in ("x", "P", "K", "S", "SI", "y", "z", "H", "x_post", "P_post", "dim_z"):
            np.testing.assert_allclose(
                getattr(rows, name), getattr(whole, name), rtol=0, atol=1e-11, err_msg=name
            )


@pytest.mark.parametrize("share", [None, considered_share(SIZE, 2)])
def test_the_update_from_far_is_the_plain_one_where_both_apply(share: Array | None) -> None:
    cov, z, H = a_problem(2)
    plain, far = a_filter(cov, share), a_filter(cov, share)
    plain.update_linear(z, H)
    far.update_from_far(z, H)
    for name in ("x", "P", "K", "S", "SI", "y", "z", "H", "R", "x_post", "P_post", "dim_z"):
        np.testing.assert_allclose(
            getattr(far, name), getattr(plain, name), rtol=0, atol=1e-11, err_msg=name
        )
    for name in ("log_likelihood", "mahalanobis", "likelihood"):
        assert getattr(far, name) == pytest.approx(getattr(plain, name), rel=1e-11)


def test_from_far_a_state_is_updated_as_from_near_where_rows_are_linear() -> None:
    start, blocks, predicted, _ = one_interval(GROUPS)
    rest = [ZeroVelocity(np.zeros(1, dtype=int), np.array([0.01]))]
    near, far = ErrorStateFilter(start, blocks), ErrorStateFilter(start, blocks)
    near.absorb(predicted, rest)
    far.absorb(predicted, rest, predicted.state)
    assert separate(between(near.state, far.state, blocks), np.zeros(len(near.P)), near.P) < 1e-9
    assert separate(near.P, far.P, near.P) < 1e-9


def test_from_far_the_state_is_the_most_probable_one() -> None:
    """By SciPy, to a fifth of a sigma; one linearisation at the given point misses it by more."""
    rng = np.random.default_rng(1)
    site, point = a_site(), a_state(a_site(), (), rng)
    wide = replace(point, cov=np.diag(np.repeat([0.3, 0.5, 0.5, 0.05, 0.005], 3) ** 2))
    imu = an_imu(wide.time, wide.time + 0.1, rng)
    predicted = propagate(wide, imu, wide.time + 0.1, site, site.platform.imu.time_offset)
    prior = predicted.state
    true = moved(prior, (), 0.7 * np.sqrt(np.diag(prior.cov)) * rng.normal(size=MOTION))
    epoch = an_epoch(site, replace(true, cov=1e-20 * np.eye(MOTION)), (), rng)
    near = moved(true, (), np.repeat([0.02, 0.03, 0.0, 0.0, 0.0], 3))
    information = np.linalg.inv(np.linalg.cholesky(prior.cov))

    def residual(step: Array) -> Array:
        error, _ = measured_rows(epoch, moved(prior, (), step), ())
        return np.concatenate([error, information @ step])

    begin = between(prior, near, ())
    scale = np.sqrt(np.diag(prior.cov))
    best = least_squares(residual, begin, x_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    kalman = ErrorStateFilter(wide, ())
    kalman.absorb(predicted, epoch, near)
    assert separate(between(prior, kalman.state, ()), best, kalman.P) < 0.2
    error, H = measured_rows(epoch, near, ())
    once = a_filter(kalman.P_prior)
    once.update_from_far(H @ begin - error, H)
    assert separate(once.x, best, kalman.P) > 2.0


# --- with process noise on the calibration ---


def by_graph(
    start: State,
    predicted: Propagated,
    walked: Array,
    rows: tuple[Array, Array],
) -> tuple[Array, Array]:
    """Return step and covariance of the later state: one Gauss-Newton step over both epochs.

    Parameters
    ----------
    walked : ndarray, shape (dimension,)
        Variance that each calibration parameter has gained from the first epoch to the second.
    """
    size, order, native = len(start.cov), gtsam.Ordering(), gtsam.NonlinearFactorGraph()
    native.add(inertial_factor(0, predicted.link.measurement))
    for epoch in (0, 1):
        for key in (X, V, B):
            order.push_back(key(epoch))
    inertial, right = native.linearize(values_of([start, predicted.state])).hessian(order)
    first, second = slice(size), slice(size, None)
    motion = np.r_[:MOTION, size : size + MOTION]
    before, after = slice(MOTION, size), slice(size + MOTION, None)
    information, vector = np.zeros((2 * size, 2 * size)), np.zeros(2 * size)
    information[np.ix_(motion, motion)] += inertial
    vector[motion] += right
    information[first, first] += np.linalg.inv(start.cov)
    walk = np.diag(1.0 / walked)
    information[before, before] += walk
    information[after, after] += walk
    information[before, after] -= walk
    information[after, before] -= walk
    error, by = rows
    information[second, second] += by.T @ by
    vector[second] -= by.T @ error
    cov = np.linalg.inv(information)
    return (cov @ vector)[second], cov[second, second]


def test_the_filter_is_the_graph_with_process_noise_on_the_calibration() -> None:
    """Its variance grows by that of the walk, a second's by a second, and no half of it."""
    rng, site = np.random.default_rng(SEED), a_site()
    blocks = choose_blocks(site, GROUPS)
    start, elapsed = a_state(site, blocks, rng), 0.4
    variance = np.diag(start.cov)[MOTION:] * rng.uniform(0.5, 2.0, dimension(blocks))
    later, offset = start.time + elapsed, site.platform.imu.time_offset
    imu = an_imu(start.time, later, rng)
    result = {}
    for name, walk in (("whole", variance), ("half", 0.5 * variance)):
        noise = ProcessNoise(blocks, walk)
        predicted = propagate(start, imu, later, site, offset, noise, blocks=blocks)
        epoch = an_epoch(site, predicted.state, blocks, np.random.default_rng(3))
        kalman = ErrorStateFilter(start, blocks)
        kalman.absorb(predicted, epoch)
        result[name] = kalman.state
    noise = ProcessNoise(blocks, variance)
    predicted = propagate(start, imu, later, site, offset, noise, blocks=blocks)
    epoch = an_epoch(site, predicted.state, blocks, np.random.default_rng(3))
    rows = measured_rows(epoch, predicted.state, blocks)
    step, cov = by_graph(start, predicted, elapsed * variance, rows)
    went = max(1.0, separate(step, 0.0 * step, cov))
    assert separate(between(predicted.state, result["whole"], blocks), step, cov) < 1e-7 * went
    assert separate(result["whole"].cov, cov, cov) < 1e-7
    assert separate(result["half"].cov, cov, cov) > 0.05


# --- the bank ---


def crossed(bank: SubsetBank, group: int) -> Array:
    """Return the cross-covariance of a filter of the bank with the one of all beacons, (n, n)."""
    assert bank._cov is not None
    assert bank._joint is not None
    result, count = bank._whole()[0], bank._cov.shape[1]
    result[:count] = np.hstack([bank._joint[group], bank._cov[1 + group, :, count:]])
    return result


@pytest.mark.parametrize("sparse_from", [1, sparse_rows.SPARSE_COLUMNS])
@pytest.mark.parametrize("drifted", [0.0, 1e4])  # m
@pytest.mark.parametrize("considered", [0, 2])
def test_filters_of_the_bank_are_this_one_without_a_beacon(
    monkeypatch: pytest.MonkeyPatch, considered: int, drifted: float, sparse_from: int
) -> None:
    monkeypatch.setattr(sparse_rows, "SPARSE_COLUMNS", sparse_from)
    site = a_site()
    start, blocks, predicted, epoch = one_interval(GROUPS)
    bank = SubsetBank(site, blocks, considered)
    bank._begin(start)
    bank._cov[2, POSITION, POSITION] += drifted**2 * np.eye(3)
    before, across = bank._whole(), [crossed(bank, group) for group in range(bank.groups)]
    kalman = ErrorStateFilter(start, blocks, considered)
    kalman.absorb(predicted, epoch)
    bank.absorb(predicted, epoch, kalman.state)
    error, H = measured_rows(epoch, predicted.state, blocks)
    owner, close = np.repeat(bank._owner, 6), 1e-2 if drifted else 1e-6
    went = between(predicted.state, kalman.state, blocks)
    for group in range(-1, bank.groups):
        alone = a_filter(before[1 + group], considered_share(len(start.cov), considered))
        alone.F, alone.Q = predicted.transition, predicted.noise
        alone.predict()
        alone.update_from_far(-error[owner != group], H[owner != group])
        assert separate(bank._whole()[1 + group], alone.P, alone.P) < close
        if group >= 0:
            assert separate(bank._step[group] + went, alone.x, alone.P) < close
            one, every = alone.K @ np.eye(len(H))[owner != group], kalman.K
            cross = alone.F @ across[group] @ alone.F.T + alone.Q
            unit = np.eye(len(cross))
            cross = (unit - one @ H) @ cross @ (unit - every @ H).T + one @ every.T
            assert separate(crossed(bank, group), cross, alone.P) < close
