"""Solution separation: alarms as often as promised, levels that hold, the right beacon found."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from magfusion.estimation.posterior.protection_levels import (
    pair_modes,
    protection_levels,
    with_rivals,
)
from magfusion.estimation.posterior.separation import Separation, linear_separation, radii
from magfusion.estimation.snapshot.fix_separation import separate_fixes, separation_trust
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import initial_calibration
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Risk, Verdict
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import simulate_fields

SIGMA = 3e-10  # T
MODEL_ERROR = 5e-4
BEACONS, PER_BEACON = 4, 6
OWNER = np.repeat(np.arange(BEACONS), PER_BEACON)


def _linear(rng, count, beacons=BEACONS):
    """Return Jacobians of epochs, each with a geometry of its own."""
    return rng.standard_normal((count, PER_BEACON * beacons, 6)) * rng.uniform(0.3, 3.0, 6)


def _separated(jacobian, error):
    return linear_separation(jacobian, error, None, OWNER, BEACONS)


def _error(jacobian, noise):
    """Return the error of the estimate with all: the truth is zero."""
    gain = np.linalg.pinv(jacobian)
    return -(gain @ noise[..., None])[..., 0]


@pytest.mark.parametrize("spread", [(1.0, 1.0, 1.0), (1.0, 0.6, 0.3), (1.0, 0.1, 0.05)])
@pytest.mark.parametrize("probability", [0.3, 0.01, 1e-3])
def test_a_radius_is_exceeded_no_more_often_than_it_says_and_not_much_less(spread, probability):
    rng = np.random.default_rng(1)
    turn = Rotation.random(random_state=2).as_matrix()
    root = turn @ np.diag(spread)
    cov = np.zeros((6, 6))
    cov[:3, :3] = cov[3:, 3:] = root @ root.T
    result = radii(cov)
    np.testing.assert_allclose(result.largest, max(spread), rtol=1e-9)
    np.testing.assert_allclose(result.whole, np.linalg.norm(spread), rtol=1e-12)
    radius = result.beyond(probability)[0]
    norm = np.linalg.norm(rng.standard_normal((400_000, 3)) @ root.T, axis=1)
    count = np.sum(norm > radius)
    assert count <= binom.isf(1e-4, len(norm), probability)
    assert np.quantile(norm, 1.0 - probability) > (0.75 if probability < 0.1 else 0.5) * radius
    assert np.all(result.tail(np.array(radius)) <= (1.0 + 1e-6) * probability)


def test_the_step_is_that_of_the_least_squares_without_the_beacon():
    rng = np.random.default_rng(3)
    jacobian, noise = _linear(rng, 5), rng.standard_normal((5, len(OWNER)))
    result = _separated(jacobian, noise)
    for j in range(BEACONS):
        kept = j != OWNER
        without = _error(jacobian[:, kept], noise[:, kept])
        np.testing.assert_allclose(result.step[:, j], without - _error(jacobian, noise), atol=1e-9)
        remaining = noise[:, kept] + (jacobian[:, kept] @ without[..., None])[..., 0]
        np.testing.assert_allclose(result.cost[:, j], np.sum(remaining**2, axis=1), rtol=1e-8)
    # Of estimates by the same measurements the covariance of the step is the difference.
    np.testing.assert_allclose(
        result.separation_cov, result.subset_cov - result.cov[:, None], rtol=1e-6, atol=1e-9
    )


@pytest.mark.slow
def test_without_a_fault_alarms_come_no_more_often_than_promised():
    rng, risk, count = np.random.default_rng(4), Risk(false_alarm=0.02), 20_000
    result = _separated(_linear(rng, count), rng.standard_normal((count, len(OWNER))))
    alarms = int(np.sum(np.any(result.excess(risk) > 1.0, axis=1)))
    assert alarms <= binom.isf(1e-4, count, risk.false_alarm)
    assert alarms > 0.05 * risk.false_alarm * count


@pytest.mark.parametrize("size", [0.0, 3.0, 6.0, 10.0, 20.0])
def test_what_a_false_beacon_does_unseen_stays_within_the_level(size):
    """A bias of one beacon in the direction that moves the position most, of so many sigma."""
    rng, count = np.random.default_rng(5), 8_000
    risk = Risk(total=2e-3, fault=0.05, false_alarm=5e-3, mirrors=0.0)
    jacobian = _linear(rng, count, 3)
    owner, rows = np.repeat(np.arange(3), PER_BEACON), slice(0, PER_BEACON)
    noise = rng.standard_normal((count, len(owner)))
    gain = np.linalg.pinv(jacobian)
    worst = np.linalg.svd(gain[:, 3:, rows])[2][:, 0]
    noise[:, rows] += size * worst
    result = linear_separation(jacobian, noise, None, owner, 3)
    # Two at once would have the whole of so small a risk.
    prior = np.where(np.arange(3) == 0, risk.fault, 0.0) * np.ones((count, 1))
    position_m, _ = protection_levels(result, risk, prior=prior)
    error = np.linalg.norm(_error(jacobian, noise)[:, 3:], axis=1)
    unseen = (error > position_m) & ~np.any(result.excess(risk) > 1.0, axis=1)
    maximum = risk.total / 2.0 / (risk.fault if size else 1.0)
    assert np.all(np.isfinite(position_m))
    assert np.sum(unseen) <= binom.isf(1e-4, count, maximum)


def test_a_pair_deviates_as_the_least_squares_without_both_do():
    rng = np.random.default_rng(6)
    jacobian, noise = _linear(rng, 5), rng.standard_normal((5, len(OWNER)))
    result, prior = _separated(jacobian, noise), np.full((5, BEACONS), 1e-3)
    modes, determined = pair_modes(result, prior, 0.5)  # the observed deviation where it is larger
    assert np.all(determined)
    for k, (i, j) in enumerate(itertools.combinations(range(BEACONS), 2)):
        kept = (i != OWNER) & (j != OWNER)
        without = _error(jacobian[:, kept], noise[:, kept]) - _error(jacobian, noise)
        cov = np.linalg.inv(np.swapaxes(jacobian[:, kept], 1, 2) @ jacobian[:, kept])
        np.testing.assert_allclose(modes.sigma.whole[:, k], radii(cov).whole, rtol=1e-6)
        away = np.linalg.norm(without[:, 3:6], axis=1)
        assert np.all(modes.threshold[:, k, 1] >= away - 1e-9)
    np.testing.assert_allclose(modes.prior, 1e-6)


@pytest.mark.parametrize("size", [3.0, 6.0, 20.0])
def test_what_two_false_beacons_do_unseen_stays_within_the_level(size):
    """Biases of two beacons in the direction that moves the position most, of so many sigma."""
    rng, count = np.random.default_rng(8), 4_000
    risk = Risk(total=2e-3, fault=0.1, false_alarm=5e-3, mirrors=0.0)
    jacobian = _linear(rng, count)
    false = OWNER < 2
    noise = rng.standard_normal((count, len(OWNER)))
    gain = np.linalg.pinv(jacobian)
    noise[:, false] += size * np.linalg.svd(gain[:, 3:6, false])[2][:, 0]
    result = _separated(jacobian, noise)
    prior = np.where(np.arange(BEACONS) < 2, risk.fault, 0.0) * np.ones((count, 1))
    position_m, _ = protection_levels(result, risk, prior=prior)
    assert np.all(np.isfinite(position_m))
    error = np.linalg.norm(_error(jacobian, noise)[:, 3:6], axis=1)
    unseen = (error > position_m) & ~np.any(result.excess(risk) > 1.0, axis=1)
    assert np.sum(unseen) <= binom.isf(1e-4, count, risk.total / 2.0 / risk.fault**2)


def test_sixteen_beacons_have_levels_and_two_of_three_none():
    """By the default risk two of sixteen are false too often to be ignored."""
    rng = np.random.default_rng(9)
    jacobian = _linear(rng, 3, 16)
    owner = np.repeat(np.arange(16), PER_BEACON)
    result = linear_separation(jacobian, np.zeros((3, len(owner))), None, owner, 16)
    assert np.all(np.isfinite(protection_levels(result, Risk())[0]))
    jacobian[:, owner > 2] = 0.0
    jacobian[:, owner < 3, 5] *= owner[owner < 3] == 2  # one axis is seen by the third alone
    result = linear_separation(jacobian, np.zeros((3, len(owner))), None, owner, 16)
    assert np.all(np.isnan(protection_levels(result, Risk(total=1e-6))[0]))


def test_a_beacon_that_is_not_heard_is_no_risk():
    jacobian = _linear(np.random.default_rng(7), 4)
    jacobian[:, OWNER >= 2] = 0.0
    result = _separated(jacobian, np.zeros((4, len(OWNER))))
    assert np.all(result.prior(Risk())[:, 2:] == 0.0)
    np.testing.assert_allclose(result.step[:, 2:], 0.0, atol=1e-12)
    assert np.all(np.isfinite(protection_levels(result, Risk())[0]))


def test_a_level_reaches_to_a_rival_that_is_too_likely():
    weight = np.array([[0.3, 1e-7], [1e-7, 1e-9]])
    distance = np.array([[2.0, 5.0], [2.0, 5.0]])
    result = with_rivals(np.array([0.01, 0.01]), distance, weight, 1e-5)
    np.testing.assert_allclose(result, [2.01, 0.01], rtol=1e-12)


def _room(beacons=4, *, synchronised=True):
    site = demo_site(coil_radius=None, synchronised=synchronised)
    return replace(site, beacons=site.beacons[:beacons], model_error=MODEL_ERROR)


def _seen(site, count, share, seed=1, *, always=None):
    """Return fixes' inputs with one false beacon in each epoch, the truth, and which it is."""
    rng = np.random.default_rng(seed)
    truth = Trajectory(
        0.2 * np.arange(count),
        Rotation.random(count, random_state=seed).as_matrix(),
        rng.uniform(*DEMO_BOX_WORLD, (count, 3)),
    )
    samples = simulate_fields(site, truth, SIGMA, rng)
    phasor = samples.phasor_sensor
    size = np.sqrt(np.sum(np.abs(phasor) ** 2, axis=-1, keepdims=True) / 6.0)
    draws = rng.standard_normal((2, *phasor.shape))
    phasor = phasor + MODEL_ERROR * size * (draws[0] + 1j * draws[1])
    false = rng.integers(0, len(site.beacons), count) if always is None else np.full(count, always)
    phasor[np.arange(count), false] *= 1.0 + share
    cov = np.broadcast_to(SIGMA**2 * np.eye(3), samples.phasor_cov.shape).copy()
    return replace(samples, phasor_sensor=phasor, phasor_cov=cov), truth, false


def _separate(site, samples):
    calibration = initial_calibration(site, 0.0)
    fixes = fix_epochs(samples, calibration, survey_error=False)
    return separate_fixes(samples, calibration, fixes, survey_error=False)


def _position_error(fixes, truth):
    return np.linalg.norm(fixes.position_world[:, 0] - truth.position_world, axis=1)


@pytest.mark.parametrize(
    ("share", "alarms"),
    [(0.01, 0.8), (0.02, 0.95), (0.1, 1.0), (-0.995, 1.0)],  # the last has fallen silent
)
def test_a_false_beacon_is_found_and_left_out(share, alarms):
    site, count = _room(), 100
    samples, truth, false = _seen(site, count, share)
    result = _separate(site, samples)
    alarmed = np.any(result.excess > 1.0, axis=1)
    assert np.mean(alarmed) >= alarms
    right = [
        result.states.excluded[i] == (site.beacons[false[i]].name,) for i in np.flatnonzero(alarmed)
    ]
    assert np.mean(right) >= 0.98
    error = _position_error(result.fixes, truth)
    undetected = ~alarmed & (error > result.states.protection_level_m)
    assert not np.any(undetected)
    clean = _position_error(_separate(site, _seen(site, count, 0.0)[0]).fixes, truth)
    assert np.median(error[alarmed]) < 2.0 * np.median(clean)


def test_good_fixes_stay_as_they_were_and_have_a_useful_level():
    site = _room()
    samples, truth, _ = _seen(site, 200, 0.0)
    before = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False)
    result = _separate(site, samples)
    same = [not names for names in result.states.excluded]
    assert np.mean(same) >= 0.99
    np.testing.assert_array_equal(
        result.fixes.position_world[same], before.position_world[same], strict=True
    )
    level = result.states.protection_level_m
    assert np.mean(np.isfinite(level)) >= 0.99
    assert not np.any(_position_error(result.fixes, truth) > level)
    radius = 3.0 * np.sqrt(np.trace(before.pose_cov[:, 0, 3:, 3:], axis1=1, axis2=2))
    assert np.nanmedian(level / radius) <= 4.0


def test_one_beacon_has_no_level_and_that_is_no_doubt():
    site = _room(1)
    samples, _, _ = _seen(site, 10, 0.0)
    result = _separate(site, samples)
    assert np.all(np.isnan(result.states.protection_level_m))
    trust = separation_trust(result, ("A",), Risk())
    assert trust.verdict is Verdict.TRUSTWORTHY
    assert [finding.code for finding in trust.findings] == ["no_redundancy"]


def test_two_beacons_that_contradict_each_other_are_in_doubt_and_honest():
    """Which of the two is false cannot be told."""
    site = _room(2)
    samples, truth, _ = _seen(site, 40, 0.05, always=0)
    result = _separate(site, samples)
    doubtful = np.array([v is Verdict.DOUBTFUL for v in result.states.verdict])
    assert np.mean(doubtful) > 0.5
    assert not any(result.states.excluded)
    assert np.all(np.isnan(result.states.protection_level_m[doubtful]))
    assert separation_trust(result, ("A", "B"), Risk()).verdict is Verdict.DOUBTFUL
    rotation = result.fixes.world_from_body[:, 0]
    shift = result.fixes.position_world[:, 0] - truth.position_world
    body = (np.swapaxes(rotation, 1, 2) @ shift[..., None])[..., 0]
    cov = result.fixes.pose_cov[:, 0, 3:, 3:]
    nees = np.einsum("ni,nij,nj->n", body, np.linalg.inv(cov), body)
    assert np.median(nees[doubtful]) < 12.0


def test_a_mirrored_pose_is_within_the_level():
    """Parallel beacons on a floor, of unknown phase, leave the pose below it as likely."""
    site = _room(synchronised=False)
    flat = tuple(
        replace(b, position_world=np.array([x, y, 0.0]), world_from_beacon=np.eye(3))
        for b, (x, y) in zip(site.beacons, ((0, 0), (6, 0), (6, 5), (0, 5)), strict=True)
    )
    site = replace(site, beacons=flat)
    samples, truth, _ = _seen(site, 20, 0.0)
    result = _separate(site, samples)
    mirrored = 2.0 * truth.position_world[:, 2]
    known = np.isfinite(result.states.protection_level_m)
    assert np.mean(known) > 0.9
    assert np.all(result.states.protection_level_m[known] > 0.9 * mirrored[known])


def test_no_separation_is_told_of_an_estimate_that_does_not_exist():
    nothing = Separation(
        step=np.full((1, 1, 6), 1e9),
        cov=np.eye(6)[None],
        subset_cov=np.eye(6)[None, None],
        separation_cov=np.eye(6)[None, None],
        determined=np.zeros((1, 1), dtype=bool),
        cost=np.zeros((1, 1)),
        rows=np.full((1, 1), 6),
    )
    assert nothing.excess(Risk())[0, 0] == 0.0
    assert np.all(nothing.likely(nothing.prior(Risk())) == 0.0)
    assert np.isnan(protection_levels(nothing, Risk())[0][0])
