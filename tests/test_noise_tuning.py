"""Noise that tunes itself: what was declared wrongly is found, and the sigmas are honest."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.stats import chi2
from small_problem import small_log

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.integrity.judge import judge_result
from magfusion.estimation.posterior import variance_components
from magfusion.estimation.posterior.noise_tuning import Tuned, tuned_site
from magfusion.estimation.posterior.residual_redundancy import ChannelErrors
from magfusion.estimation.posterior.tuned_noise import covered_beacons, tuned_noise
from magfusion.estimation.posterior.variance_components import (
    KINDS,
    NORMAL,
    STUDENT,
    BeaconErrors,
    BeaconParts,
    maximize_likelihood,
    parts_of,
)
from magfusion.estimation.solve.bounded import minimise_curved
from magfusion.files.site import load_site, save_site
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Verdict
from magfusion.results.errors import trajectory_errors
from magfusion.results.refinement import result_site
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log


def simulated(seed: int, duration: float = 30.0) -> Log:
    config = SimulationConfig(DEMO_BOX_WORLD, duration=duration, motion="walk", perturb=False)
    return simulate_log(demo_site(), config, np.random.default_rng(seed)).log


def declared(imu: float = 1.0, model: float = 1.0) -> Site:
    """Return the demo site, exact, with its densities declared too large by factors."""
    site = demo_site()
    own = site.platform.imu
    noisy = replace(own, gyro_noise=imu * own.gyro_noise, accel_noise=imu * own.accel_noise)
    platform = replace(site.platform, imu=noisy)
    return replace(site, model_error=model * site.model_error, platform=platform)


Cost = Callable[[np.ndarray], np.ndarray]
Curved = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def tuned(result: Smoothed, key: str) -> np.ndarray:
    return np.array([t.estimated for t in result.noise if t.key == key])


def mean_nees(result: Smoothed, log: Log) -> float:
    assert log.truth is not None
    nees = trajectory_errors(result.states, log.truth).nees
    assert nees is not None
    return float(np.mean(nees))


@pytest.fixture(scope="module")
def log() -> Log:
    return simulated(1)


@pytest.fixture(scope="module")
def plain(log: Log) -> Smoothed:
    return smooth(log, declared())


@pytest.mark.slow
def test_the_dipole_model_is_found_to_be_better_than_declared(log: Log, plain: Smoothed) -> None:
    """A coil of 0.1 m is a dipole within a thousandth here; half a per cent was declared."""
    error = tuned(plain, "model_error")
    assert len(error) == 4
    assert np.all(error < 0.6 * 0.005)
    assert np.mean(error) < 0.4 * 0.005
    assert np.all((tuned(plain, "noise_factor") > 0.5) & (tuned(plain, "noise_factor") < 1.3))
    untuned = smooth(log, declared(), SmootherSettings(tune=False))
    assert untuned.noise == ()
    assert log.truth is not None
    better, before = (trajectory_errors(r.states, log.truth).ate for r in (plain, untuned))
    # Half a per cent costs less than it would if epochs forgot what they know of each other.
    assert better < 0.9 * before


@pytest.mark.slow
def test_densities_declared_too_small_are_found(log: Log) -> None:
    result = smooth(log, declared(imu=1.0 / 5.0))
    for kind, true in (("gyro_noise", 3e-4), ("accel_noise", 3e-3)):
        assert 0.5 * true < tuned(result, kind)[0] < 2.0 * true, kind
    untuned = smooth(log, declared(imu=1.0 / 5.0), SmootherSettings(tune=False))
    assert mean_nees(untuned, log) > mean_nees(result, log)


@pytest.mark.slow
def test_a_tenth_of_the_noise_declared_is_reported_and_the_sigmas_are_right(log: Log) -> None:
    """By so much no fault is hidden: the samples themselves show their white noise."""
    result, trust = judge_result(smooth(log, declared(imu=0.1)), log)
    for kind, true in (("gyro_noise", 3e-4), ("accel_noise", 3e-3)):
        (one,) = (t for t in result.noise if t.key == kind)
        assert one.declared == pytest.approx(0.1 * true)
        assert 0.7 * true < one.estimated < 1.4 * true
    (finding,) = trust.reasons
    assert finding.code == "noise_tuned"
    assert set(finding.remedy or ()) == {"platform.imu.gyro_noise", "platform.imu.accel_noise"}
    sigma = [
        float(np.sqrt(np.mean(np.trace(one.states.pose_cov, axis1=1, axis2=2))))
        for one in (result, judge_result(smooth(log, declared()), log)[0])
        if one.states.pose_cov is not None
    ]
    assert sigma[0] == pytest.approx(sigma[1], rel=0.2)


@pytest.mark.slow
def test_the_noise_of_the_samples_is_reported_where_none_is_tuned(log: Log) -> None:
    settings = SmootherSettings(coupling="loose", loss=None)
    _, trust = judge_result(smooth(log, declared(imu=0.1), settings), log)
    assert {f.code for f in trust.reasons} & {"noise_tuned", "imu_noise"}


@pytest.mark.slow
def test_what_is_declared_too_large_of_the_imu_stays(log: Log) -> None:
    """Scale and vibration may be in it, which are not white."""
    result = smooth(log, declared(imu=3.0))
    assert tuned(result, "gyro_noise") == pytest.approx(3.0 * 3e-4)


@pytest.mark.slow
def test_a_result_is_the_same_again(log: Log, plain: Smoothed) -> None:
    again = smooth(log, declared())
    assert again.noise == plain.noise
    assert np.array_equal(again.states.position_world, plain.states.position_world)


@pytest.mark.slow
def test_the_refined_site_has_what_was_found(plain: Smoothed, tmp_path: Path) -> None:
    save_site(result_site(plain, "a log"), tmp_path / "site.yaml")
    site = load_site(tmp_path / "site.yaml")
    by_name = {b.name: b for b in site.beacons}
    for one in plain.noise:
        part = site.platform.imu if one.owner == "imu" else by_name[one.owner]
        assert getattr(part, one.key) == pytest.approx(one.estimated, rel=1e-12)


def test_a_site_that_says_nothing_of_it_is_as_before(tmp_path: Path) -> None:
    save_site(demo_site(), tmp_path / "site.yaml")
    text = (tmp_path / "site.yaml").read_text()
    assert "noise_factor" not in text
    assert "correlation_m" not in text
    site = load_site(tmp_path / "site.yaml")
    assert site.model_error_length == Site.model_error_length
    assert all(b.model_error is None and b.noise_factor == 1.0 for b in site.beacons)


def test_more_than_three_times_the_noise_is_a_doubt_and_less_is_only_said() -> None:
    stronger, quieter = Tuned("B", "model_error", 0.005, 0.04), Tuned("A", "noise_factor", 1.0, 0.2)
    usual = Tuned("imu", "gyro_noise", 3e-4, 8e-4)
    doubt, remark = tuned_noise([usual, stronger, quieter])
    assert doubt.verdict is Verdict.DOUBTFUL
    assert "beacon B is 0.04, declared 0.005" in doubt.text
    assert "gyroscope" not in doubt.text
    assert remark.verdict is Verdict.TRUSTWORTHY
    assert "beacon A" in remark.text
    assert list(tuned_noise([usual])) == []
    (of_imu,) = tuned_noise([Tuned("imu", "gyro_noise", 3e-4, 1.234e-3)])
    assert of_imu.remedy == {"platform.imu.gyro_noise": 1.23e-3}
    assert doubt.remedy is None
    site = tuned_site(demo_site(), [stronger, quieter, usual])
    assert [b.model_error for b in site.beacons] == [None, 0.04, None, None]
    assert site.platform.imu.gyro_noise == 8e-4


@pytest.mark.parametrize("components", [3, 6])
def test_the_gain_of_the_robust_fit_leaves_normal_residuals_as_they_are(components: int) -> None:
    def influence(square: float) -> float:
        share = NORMAL[components] * square / STUDENT
        weight = (STUDENT + components) * share / (1.0 + share)
        return float(weight * chi2.pdf(square, components))

    assert quad(influence, 0.0, 100.0)[0] == pytest.approx(components, rel=1e-5)


def test_of_a_strong_beacon_nothing_is_found_that_was_not_declared() -> None:
    """A white error as large as its model error would be a thousand times its noise."""
    rng = np.random.default_rng(0)
    over_scales = np.tile([10.0, 1.0, 0.1, 0.01], 100)
    smoother = np.tile([10.0, 0.3, 0.02, 0.001], 100)
    parts = np.stack([np.ones(400), over_scales, smoother, np.full(400, 1e6)])
    variance = np.array([1.0, 0.25, 0.0, 0.0]) @ parts
    square = variance * rng.chisquare(6, 400)
    fixed, weight = np.zeros((1, 400)), np.full((1, 400), 0.5)
    log = maximize_likelihood(square[None], parts[None], fixed, weight, 6, KINDS)[0]
    noise, _, _, white = np.exp(2.0 * log)[:, None] * parts
    assert np.mean(noise + white) == pytest.approx(1.0, abs=0.2)


def test_slope_and_curvature_of_the_likelihood_are_its_derivatives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    requested: list[tuple[np.ndarray, np.ndarray]] = []

    def compare(cost: Cost, curved: Curved, start: np.ndarray, *_: object) -> np.ndarray:
        at, step = start + 0.3, 1e-6 * np.eye(start.shape[1])
        slope = [(cost(at + one) - cost(at - one)) / 2e-6 for one in step]
        curvature = [(curved(at + one)[0] - curved(at - one)[0]) / 2e-6 for one in step]
        requested.append((curved(at)[0], np.stack(slope, axis=1)))
        requested.append((curved(at)[1], np.stack(curvature, axis=1)))
        return start

    monkeypatch.setattr(variance_components, "minimise_curved", compare)
    rng = np.random.default_rng(0)
    parts, square = rng.uniform(0.1, 2.0, (2, 4, 50)), rng.chisquare(6, (2, 50))
    maximize_likelihood(square, parts, np.full((2, 50), 0.1), np.full((2, 50), 0.5), 6, KINDS)
    assert len(requested) == 2
    for given, expected in requested:
        assert given == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_no_quasi_newton_search_finds_a_likelier_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of parts that are there and of parts that are not, among them two that are much alike."""
    behind: list[float] = []

    def compare(cost: Cost, curved: Curved, start: np.ndarray, limits: np.ndarray) -> np.ndarray:
        result = minimise_curved(cost, curved, start, limits)
        assert np.all((result >= limits[:, 0]) & (result <= limits[:, 1]))
        options = {"maxiter": 500, "ftol": 1e-15, "gtol": 1e-9}
        for k in range(len(start)):

            def own(at: np.ndarray, k: int = k) -> float:
                return float(cost(np.tile(at, (len(start), 1)))[k])

            other = minimize(own, start[k], method="L-BFGS-B", bounds=limits, options=options)
            behind.append(float(cost(result)[k]) - float(other.fun))
        return result

    monkeypatch.setattr(variance_components, "minimise_curved", compare)
    square, parts = _many_sizes(20)
    maximize_likelihood(square, parts, np.full((20, 480), 0.1), np.full((20, 480), 0.5), 6, KINDS)
    assert len(behind) == 20
    assert max(behind) < 1e-3  # of a log-likelihood


def _many_sizes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return squares of residuals, and parts of which some are there and some are not."""
    rng = np.random.default_rng(0)
    time = np.tile(np.arange(1, 9), 60)
    squares, every = [], []
    for _ in range(count):
        parts = np.stack([np.ones(480), 4.0 / time, 4.0 / time**2, rng.uniform(0.1, 3.0, 480)])
        sizes = rng.permutation([1.0, 0.5, 0.0, 0.0]) * rng.uniform(0.3, 3.0, 4)
        squares.append((sizes**2 @ parts + 0.1) * rng.chisquare(6, 480))
        every.append(parts)
    return np.stack(squares), np.stack(every)


def test_no_noise_found_from_the_start_is_likelier_than_from_what_was_found_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before, that is, with other weights, by which some parts came to nothing."""
    costs: list[np.ndarray] = []

    def kept(cost: Cost, curved: Curved, start: np.ndarray, limits: np.ndarray) -> np.ndarray:
        result = minimise_curved(cost, curved, start, limits)
        costs.append(cost(result))
        return result

    monkeypatch.setattr(variance_components, "minimise_curved", kept)
    square, parts = _many_sizes(40)
    fixed, weight = np.full((40, 480), 0.1), np.full((40, 480), 0.5)
    weight[:, ::2] = 0.1
    before = maximize_likelihood(square, parts, fixed, weight, 6, KINDS)
    assert np.any(before[:, 2] < -9.0)
    weight[:, ::2] = 0.5
    maximize_likelihood(square, parts, fixed, weight, 6, KINDS)
    maximize_likelihood(square, parts, fixed, weight, 6, KINDS, before)
    assert np.max(costs[2] - costs[1]) < 1e-3  # of a log-likelihood


def test_searches_side_by_side_know_nothing_of_each_other() -> None:
    square, parts = _many_sizes(6)
    fixed, weight = np.full((6, 480), 0.1), np.full((6, 480), 0.5)
    together = maximize_likelihood(square, parts, fixed, weight, 6, KINDS)
    for k in range(6):
        one = slice(k, k + 1)
        alone = maximize_likelihood(square[one], parts[one], fixed[one], weight[one], 6, KINDS)
        assert together[one] == pytest.approx(alone, abs=1e-9)


def test_rows_that_a_beacon_has_more_than_another_change_nothing() -> None:
    rng = np.random.default_rng(0)

    def errors(count: int) -> BeaconErrors:
        noise, rough, smooth, inertial = rng.normal(size=(4, count, 6))
        remaining = noise, 0.3 * rough, 0.3 * smooth, 0.1 * inertial
        variance = np.full(count, 6.0), rng.uniform(1.0, 50.0, count)
        seen = rng.normal(size=(count, 6)) * 1.5
        channel = ChannelErrors(np.arange(count), seen, remaining, variance, (1.0, 0.01))
        return BeaconErrors([channel], (1.0, 0.01), bent=True)

    several = [errors(160), errors(80), replace(errors(120), bent=False), errors(4)]
    shared = np.full(160, 10.0)
    together = parts_of(several, shared, 1)
    assert together[3] is None
    assert together[2] is not None
    assert together[2].model is None
    for one, others in zip(several, together, strict=True):
        alone = parts_of([one], shared, 1)[0]
        assert (alone is None) == (others is None)
        if alone is not None and others is not None:
            assert _numbers(others) == pytest.approx(_numbers(alone), rel=1e-9)


def _numbers(part: BeaconParts) -> list[float]:
    return [part.white, part.model or 0.0, part.smooth, part.accepted_factor]


@pytest.mark.slow
def test_a_survey_by_hand_is_not_taken_for_noise_of_the_imu() -> None:
    """Its errors are not estimated, and bend the path: the IMU contradicts, and is right."""
    site = demo_site()
    beacons = tuple(
        replace(b, sigma=replace(b.sigma, position_world=np.full(3, 0.05))) for b in site.beacons
    )
    site = replace(site, beacons=beacons)
    config = SimulationConfig(DEMO_BOX_WORLD, duration=20.0, motion="walk")
    built = simulate_log(site, config, np.random.default_rng(3)).log
    result = smooth(built, site)
    for kind, true in (("gyro_noise", 3e-4), ("accel_noise", 3e-3)):
        assert tuned(result, kind)[0] < 2.0 * true, kind
    assert np.all(tuned(result, "noise_factor") < 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 3.0, 1.0 / 3.0])
def test_the_mean_nees_is_honest_whatever_was_declared(factor: float) -> None:
    """A dozen logs, each with its own survey error as declared."""
    site, values, untuned = declared(factor, factor), [], []
    for seed in range(12):
        config = SimulationConfig(DEMO_BOX_WORLD, duration=15.0, motion="walk")
        log = simulate_log(demo_site(), config, np.random.default_rng(seed)).log
        values.append(mean_nees(smooth(log, site), log))
        if factor > 1.0 and seed < 6:
            raw = smooth(log, site, SmootherSettings(tune=False))
            untuned.append(mean_nees(raw, log))
    # On the safe side: what the survey's errors leave in the residuals is counted as model error,
    # and a density of the IMU is never taken for smaller than it was declared.
    low, high = 2.8, 7.0
    assert low < np.mean(values) < high
    if factor > 1.0:
        assert np.mean(untuned) < low


def test_noise_that_the_declared_model_error_covers_is_no_doubt() -> None:
    """The part of a model error that changes quickly is tuned as noise, far below the error."""
    small = small_log(1, sigma=1e-12, perturb=False)
    name = small.site.beacons[0].name
    grown = Tuned(name, "noise_factor", 1.0, 5.0)
    for model_error, expected in ((1e-2, {name}), (1e-9, set())):
        covered = covered_beacons(
            [grown], small.fields, replace(small.site, model_error=model_error)
        )
        assert covered == expected
        assert len(list(tuned_noise([grown], covered))) == 1 - len(expected)
