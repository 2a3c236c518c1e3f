"""The smoothed trajectory without each beacon: the sweep is exact, a false stretch is left out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom
from small_problem import SIGMA, SmallLog

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.graph import considered, factors
from magfusion.estimation.integrity import smoothed_separation
from magfusion.estimation.integrity.smoothed_exclusion import separated_smooth
from magfusion.estimation.integrity.smoothed_separation import separate_smoothed
from magfusion.estimation.posterior import block_tridiagonal_system, marginals, native_rows
from magfusion.estimation.posterior.protection_levels import protection_levels
from magfusion.estimation.posterior.separation import SLACK
from magfusion.estimation.solve.chain import Chain, solve_chain
from magfusion.model.trust import Risk, Verdict
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.inertial import simulate_imu
from magfusion.simulation.log import simulate_fields
from magfusion.simulation.motion import Rests, random_walk_motion
from magfusion.units import Array, BoolArray

STEP, EPOCHS = 0.25, 120  # s


def _dense(chain: Chain, variant: int) -> tuple[Array, Array]:
    _, n, size, _ = chain.diagonal.shape
    c = chain.corner.shape[1]
    whole = np.zeros((n * size + c, n * size + c))
    for i in range(n):
        own = slice(i * size, (i + 1) * size)
        whole[own, own] = chain.diagonal[variant, i]
        whole[own, n * size :] = chain.border[variant, i]
        if i + 1 < n:
            after = slice(own.stop, own.stop + size)
            whole[own, after] = chain.following[variant, i]
            whole[after, own] = chain.following[variant, i].T
    whole[n * size :, : n * size] = whole[: n * size, n * size :].T
    whole[n * size :, n * size :] = chain.corner[variant]
    right = np.concatenate(
        [chain.right[variant].reshape(n * size, -1), chain.right_border[variant]]
    )
    return whole, right


@pytest.mark.parametrize("border", [0, 3])
def test_a_chain_is_solved_as_the_dense_system_is(border: int) -> None:
    rng = np.random.default_rng(1)
    variants, n, size, r = 3, 5, 4, 2
    rows = rng.standard_normal((variants, n - 1, 12, 2 * size + border))
    chain = Chain(
        np.tile(1e-3 * np.eye(size), (variants, n, 1, 1)),
        np.zeros((variants, n - 1, size, size)),
        np.zeros((variants, n, size, border)),
        np.tile(np.eye(border), (variants, 1, 1)),
        rng.standard_normal((variants, n, size, r)),
        rng.standard_normal((variants, border, r)),
    )
    for i in range(n - 1):
        own, after, by = np.split(rows[:, i], [size, 2 * size], axis=2)
        chain.diagonal[:, i] += np.swapaxes(own, 1, 2) @ own
        chain.diagonal[:, i + 1] += np.swapaxes(after, 1, 2) @ after
        chain.following[:, i] += np.swapaxes(own, 1, 2) @ after
        chain.border[:, i] += np.swapaxes(own, 1, 2) @ by
        chain.border[:, i + 1] += np.swapaxes(after, 1, 2) @ by
        chain.corner[...] += np.swapaxes(by, 1, 2) @ by
    result = solve_chain(chain, size)
    for v in range(variants):
        whole, right = _dense(chain, v)
        inverse = np.linalg.inv(whole)
        expected = inverse @ right
        np.testing.assert_allclose(
            result.states[v].reshape(n * size, r), expected[: n * size], rtol=1e-7, atol=1e-9
        )
        np.testing.assert_allclose(result.border[v], expected[n * size :], rtol=1e-7, atol=1e-9)
        assert result.explained[v] == pytest.approx(right[:, 0] @ expected[:, 0], rel=1e-7)
        for i in range(n):
            own = slice(i * size, (i + 1) * size)
            np.testing.assert_allclose(result.cov[v, i], inverse[own, own], rtol=1e-6, atol=1e-9)


def _walk(seed: int, beacons: int = 4) -> SmallLog:
    """Return a walk among beacons that are surveyed exactly."""
    rng = np.random.default_rng(seed)
    site = demo_site(coil_radius=None)
    site = replace(site, beacons=site.beacons[:beacons], model_error=1e-3)
    duration = STEP * EPOCHS + 1.0
    rests = Rests(start=0.0, move=duration, pause=0.0)
    motion = random_walk_motion(rng, duration, DEMO_BOX_WORLD, rests=rests)
    imu = simulate_imu(motion, site.platform.imu, site.gravity, 100.0, duration, rng)
    truth = motion.trajectory(0.5 + STEP * np.arange(EPOCHS))
    fields = simulate_fields(site, truth, SIGMA, rng, window=STEP)
    return SmallLog(site, site, imu.samples, fields, truth)


def _false(small: SmallLog, share: Array, beacon: int = 1) -> SmallLog:
    """Return a log in which one beacon's field is too large by a share, shape (epochs,)."""
    name = small.site.beacons[beacon].name
    own = np.array([owner == name for owner, _ in small.fields.channels])
    factor = 1.0 + np.where(own, share[:, None], 0.0)
    phasor = small.fields.phasor_sensor * factor[..., None]
    return replace(small, fields=replace(small.fields, phasor_sensor=phasor))


def _smoothed(small: SmallLog, loss: str | None = "cauchy") -> Smoothed:
    # Noise as declared: tuned, it would take a part of a small fault for model error.
    return smooth(small.log, small.site, SmootherSettings(loss=loss, tune=False))


def _rms(result: Smoothed, small: SmallLog) -> float:
    error = result.states.position_world - small.truth.position_world
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def _when() -> BoolArray:
    epoch = np.arange(EPOCHS)
    return np.asarray((epoch >= 40) & (epoch < 80))


@pytest.mark.slow
def test_the_sweep_agrees_with_the_graph_and_with_a_log_without_the_beacon() -> None:
    small = _walk(1)
    result = _smoothed(small, None)
    estimate = separate_smoothed(result)
    assert estimate is not None
    assert result.states.pose_cov is not None
    sigma = np.sqrt(np.einsum("nii->ni", result.states.pose_cov))
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(estimate.cov / scale, result.states.pose_cov / scale, atol=1e-3)
    for beacon in (0, 2):
        missing = [name == small.site.beacons[beacon].name for name, _ in small.fields.channels]
        phasor = np.where(np.array(missing)[:, None], np.nan, small.fields.phasor_sensor)
        fields = replace(small.fields, phasor_sensor=phasor)
        without = _smoothed(replace(small, fields=fields), None)
        moved = without.states.position_world - result.states.position_world
        body = np.swapaxes(result.states.world_from_body, 1, 2) @ moved[..., None]
        expected = estimate.step[:, beacon, 3:]
        # What is left is of second order: it grows with the step, which is up to 1.6 sigma here.
        step = max(np.max(sigma[:, 3:]), np.max(np.abs(expected)))
        assert np.max(np.abs(body[..., 0] - expected)) < 0.1 * step
        assert without.states.pose_cov is not None
        np.testing.assert_allclose(
            np.einsum("nii->ni", estimate.subset_cov[:, beacon]),
            np.einsum("nii->ni", without.states.pose_cov),
            rtol=0.05,
        )


def _marginals(result: Smoothed) -> tuple[Array, Array, Array]:
    return marginals.marginals(result.graph, result.estimate, result.uncertain)


def test_piece_by_piece_a_log_is_separated_as_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    result = _smoothed(_walk(1))
    known = separate_smoothed(result), _marginals(result)
    for module in (factors, native_rows):
        monkeypatch.setattr(module, "PIECE", 7)
    for module in (smoothed_separation, considered):  # one beacon or parameter at once
        monkeypatch.setattr(module, "AT_ONCE", 1.0)
    estimate = separate_smoothed(result), _marginals(result)
    assert known[0] is not None
    assert estimate[0] is not None
    for name, value in vars(known[0]).items():
        scale = max(float(np.max(np.abs(value))), 1e-300)
        np.testing.assert_allclose(getattr(estimate[0], name), value, rtol=1e-7, atol=1e-10 * scale)
    for one, other in zip(known[1], estimate[1], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=0.0)


@pytest.mark.slow
def test_what_is_considered_is_taken_in_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    result = _smoothed(_walk(1))
    known = separate_smoothed(result), _marginals(result)
    monkeypatch.setattr(block_tridiagonal_system, "SIDES", 1.0)  # one block at once
    assert len(block_tridiagonal_system.column_groups(result.uncertain, result.graph.epochs)) > 3
    estimate = separate_smoothed(result), _marginals(result)
    assert known[0] is not None
    assert estimate[0] is not None
    pairs = [(getattr(estimate[0], name), value) for name, value in vars(known[0]).items()]
    for one, other in (*pairs, *zip(estimate[1], known[1], strict=True)):
        scale = max(float(np.max(np.abs(other))), 1e-300)
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * scale)


@pytest.mark.parametrize("seed", [2, 3])
def test_good_logs_stay_as_they_are_within_a_useful_level(seed: int) -> None:
    small = _walk(seed)
    result = _smoothed(small)
    estimate = separated_smooth(result)
    assert estimate.trust.verdict is Verdict.TRUSTWORTHY
    assert not any(estimate.states.excluded)
    np.testing.assert_array_equal(
        estimate.result.states.position_world, result.states.position_world
    )
    level = estimate.states.protection_level_m
    error = np.linalg.norm(result.states.position_world - small.truth.position_world, axis=1)
    assert np.all(error < level)
    assert result.states.pose_cov is not None
    radius = 3.0 * np.sqrt(np.trace(result.states.pose_cov[:, 3:, 3:], axis1=1, axis2=2))
    assert np.median(level / radius) <= 4.0


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["cauchy", None])
@pytest.mark.parametrize(("size", "ramp"), [(0.2, False), (0.02, False), (0.1, True)])
def test_a_beacon_that_is_false_for_a_while_is_left_out(
    size: float, ramp: bool, loss: str | None
) -> None:
    small = _walk(2)
    clean = _rms(_smoothed(small), small)
    shape = np.cumsum(_when()) / np.sum(_when()) * _when() if ramp else _when()
    faulted = _false(small, size * shape)
    result = separated_smooth(_smoothed(faulted, loss))
    assert _rms(result.result, small) < 1.5 * clean
    named = {name for names in result.states.excluded for name in names}
    assert named == {small.site.beacons[1].name}
    out = np.array([bool(names) for names in result.states.excluded])
    assert np.mean(out[_when()]) > (0.5 if ramp else 0.95)
    assert np.mean(out[~_when()]) < 0.15
    assert [finding.code for finding in result.trust.findings] == ["beacon_excluded"]
    assert result.trust.verdict is Verdict.TRUSTWORTHY
    error = np.linalg.norm(result.result.states.position_world - small.truth.position_world, axis=1)
    assert np.all(error < result.states.protection_level_m)


@pytest.mark.slow
def test_beacons_that_all_contradict_each_other_are_in_doubt() -> None:
    small = _walk(4)
    for beacon, share in enumerate((0.04, -0.04, 0.05, -0.03)):
        small = _false(small, np.full(EPOCHS, share), beacon)
    result = separated_smooth(_smoothed(small))
    assert result.trust.verdict is Verdict.DOUBTFUL
    assert result.trust.reasons[0].code == "separation"
    assert Verdict.DOUBTFUL in result.states.verdict
    doubtful = np.array([v is Verdict.DOUBTFUL for v in result.states.verdict])
    assert np.all(np.isnan(result.states.protection_level_m[doubtful]))


@pytest.mark.slow
def test_one_beacon_is_no_doubt_but_has_no_level() -> None:
    result = _smoothed(_walk(5, beacons=1))
    estimate = separated_smooth(result)
    assert np.all(np.isnan(estimate.states.protection_level_m))
    assert estimate.trust.verdict is Verdict.TRUSTWORTHY
    assert [finding.code for finding in estimate.trust.findings] == ["no_redundancy"]


@pytest.mark.slow
def test_clean_logs_have_alarms_no_more_often_than_promised() -> None:
    """Of states: those of one log are alike, so that logs are counted."""
    risk, logs, alarmed, beyond = Risk(), 30, 0, 0
    for seed in range(100, 100 + logs):
        small = _walk(seed)
        result = _smoothed(small)
        estimate = separate_smoothed(result)
        assert estimate is not None
        alarmed += bool(np.any(estimate.excess(risk, SLACK) > 1.0))
        level_m, _ = protection_levels(estimate, risk, SLACK)
        error = np.linalg.norm(result.states.position_world - small.truth.position_world, axis=1)
        beyond += bool(np.any(error > level_m))
    assert alarmed <= binom.isf(1e-3, logs, 0.02)
    assert beyond == 0


@pytest.mark.slow
def test_the_chain_gives_the_covariance_of_the_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    result = _smoothed(_walk(1))
    chain = _marginals(result)
    monkeypatch.setattr(marginals, "AGREED", 0.0)  # so that the tree is asked for all
    tree = _marginals(result)
    sigma = np.sqrt(np.einsum("nii->ni", tree[0]))
    separate = np.abs(chain[0] - tree[0]) / (sigma[:, :, None] * sigma[:, None])
    assert 0.0 < np.max(separate) < 1e-9
    for one, other in zip(chain[1:], tree[1:], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9 * float(np.max(np.abs(other))))
