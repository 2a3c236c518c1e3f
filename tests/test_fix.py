"""The fix of one epoch: exact without noise, every mirror found, and as good as it claims."""

from dataclasses import replace

import numpy as np
import pytest
from example_site import mixed_site
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from magfusion.errors import EstimationError
from magfusion.estimation.snapshot.fix import Gravity
from magfusion.estimation.snapshot.likelihood import HYPOTHESES, fix_epochs
from magfusion.estimation.snapshot.problem import CHUNK
from magfusion.model.noise import measurement_cov
from magfusion.model.parameters import initial_calibration, predict_channels
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.field import Drives
from magfusion.simulation.log import simulate_fields

SIGMA = 3e-10  # T, of a phasor's component
# Where candidates must agree to count as one solution without noise, and costs as zero.
EXACT = 1e-6  # m, rad
NO_COST = 1e-3


def room(count=4, synchronised=True):
    """Return dipoles that are known exactly, the first few of the demo's."""
    site = demo_site(coil_radius=None, synchronised=synchronised)
    return replace(site, beacons=site.beacons[:count], model_error=0.0)


def floor(count, synchronised=True):
    """Return coplanar parallel beacons."""
    places = np.array([[0.0, 0.0, 0.0], [3.0, 0.5, 0.0], [1.0, 3.0, 0.0]])
    site = room(count, synchronised)
    beacons = tuple(
        replace(b, position_world=place, world_from_beacon=np.eye(3))
        for b, place in zip(site.beacons, places, strict=False)
    )
    return replace(site, beacons=beacons)


def poses(count, seed=1, box=DEMO_BOX_WORLD):
    rng = np.random.default_rng(seed)
    attitudes = Rotation.random(count, random_state=seed).as_matrix()
    return Trajectory(0.2 * np.arange(count), attitudes, rng.uniform(*box, (count, 3)))


def seen(site, truth, noise=0.0, seed=2, drives=None):
    """Return phasors that claim SIGMA and have another noise (T)."""
    samples = simulate_fields(site, truth, noise, np.random.default_rng(seed), drives)
    cov = np.broadcast_to(SIGMA**2 * np.eye(3), samples.phasor_cov.shape)
    return replace(samples, phasor_cov=cov.copy())


def fixed(site, samples, **options):
    options.setdefault("survey_error", False)
    return fix_epochs(samples, initial_calibration(site, 0.0), **options)


def deviations(fixes, truth, hypothesis=0):
    """Return the truth's right perturbation of a hypothesis, rotation then position, (n, 6)."""
    body_from_world = np.swapaxes(fixes.world_from_body[:, hypothesis], 1, 2)
    turn = Rotation.from_matrix(body_from_world @ truth.world_from_body).as_rotvec()
    separate = truth.position_world - fixes.position_world[:, hypothesis]
    return np.concatenate([turn, (body_from_world @ separate[..., None])[..., 0]], axis=1)


def is_exact(fixes, truth, hypothesis=0):
    return np.max(np.abs(deviations(fixes, truth, hypothesis)), axis=1) < EXACT


def holds_truth(fixes, truth):
    return np.any([is_exact(fixes, truth, h) for h in range(fixes.cost.shape[1])], axis=0)


def solutions(fixes):
    """Return how many hypotheses explain each epoch exactly."""
    return np.sum(fixes.cost < NO_COST, axis=1)


def gravity_of(truth, sigma=0.01):
    return Gravity(truth.world_from_body[:, 2], np.full(len(truth), sigma))


def drives_of(site, seed=3):
    """Return random phases for the beacons without synchronisation."""
    free_parameters = np.concatenate([[not b.synchronised] * len(b.tones) for b in site.beacons])
    phase = (
        np.random.default_rng(seed).uniform(-np.pi, np.pi, len(free_parameters)) * free_parameters
    )
    return Drives(phase, np.zeros(len(site.beacons)))


@pytest.mark.parametrize("survey_error", [False, True])
@pytest.mark.parametrize("synchronised", [True, False])
@pytest.mark.parametrize("count", [4, 3, 2])
def test_without_noise_the_fix_is_exact_from_no_guess(count, synchronised, survey_error):
    site, truth = room(count, synchronised), poses(150)
    drives = None if synchronised else drives_of(site)
    fixes = fixed(site, seen(site, truth, drives=drives), survey_error=survey_error)
    assert np.all(is_exact(fixes, truth))
    assert np.all(solutions(fixes) == 1)
    assert np.all(fixes.determined[:, 0])
    if drives is not None:
        lag = fixes.phase[:, 0] - drives.phase
        assert np.max(np.abs(np.exp(1j * lag) - 1.0)) < EXACT


@pytest.mark.parametrize("survey_error", [False, True])
def test_a_site_of_every_kind_of_beacon_is_fixed_exactly(survey_error):
    site, truth = replace(mixed_site(), model_error=0.0), poses(150)
    fixes = fixed(site, seen(site, truth, drives=drives_of(site)), survey_error=survey_error)
    assert np.all(is_exact(fixes, truth))


def three_coils(synchronised=False):
    """Return a beacon of three coils, each at its own frequency, and if need be another beside."""
    site = replace(mixed_site(), model_error=0.0)
    tracker = replace(site.beacons[1], synchronised=synchronised)
    return replace(site, beacons=(tracker,)), replace(site, beacons=(tracker, site.beacons[0]))


def test_three_coils_of_known_phase_leave_one_solution():
    # The offsets of their centres break the symmetry between opposite sides.
    site, truth = three_coils(synchronised=True)[0], poses(100, seed=22)
    fixes = fixed(site, seen(site, truth))
    assert np.all(is_exact(fixes, truth))


@pytest.mark.parametrize("site", three_coils(), ids=["alone", "beside another beacon"])
def test_three_coils_whose_phases_nobody_knows_are_fixed_exactly(site):
    truth = poses(200, seed=23)
    fixes = fixed(site, seen(site, truth, drives=drives_of(site)))
    assert np.all(is_exact(fixes, truth))


def test_half_turns_are_fixed_like_any_other_attitude():
    rng = np.random.default_rng(4)
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(54, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angle = np.pi - np.tile([0.0, 1e-9, 1e-6], 20)[:, None]
    attitudes = Rotation.from_rotvec(angle * axes).as_matrix()
    truth = replace(poses(60), world_from_body=attitudes)
    for site in (room(4), room(2), room(3, synchronised=False)):
        assert np.all(is_exact(fixed(site, seen(site, truth)), truth))


def test_one_beacon_leaves_four_positions_of_which_no_field_tells_the_true_one():
    site, truth = floor(1), poses(200, seed=5)
    fixes = fixed(site, seen(site, truth))
    assert HYPOTHESES == 4
    assert np.all(solutions(fixes) == 4)
    assert np.all(holds_truth(fixes, truth))
    # Positions of the sensor from the beacon: the group {1, Rz(pi), Mz, -1}.
    lever = site.platform.magnetometer.position_body
    result = fixes.position_world + fixes.world_from_body @ lever
    true = truth.position_world + truth.world_from_body @ lever
    images = true[:, None] * np.array([[1, 1, 1], [-1, -1, 1], [1, 1, -1], [-1, -1, -1]])
    separate = np.linalg.norm(result[:, :, None] - images[:, None], axis=-1)
    assert np.all(np.sum(separate < EXACT, axis=1) == 1)
    assert np.all(np.sum(separate < EXACT, axis=2) == 1)
    # -1 keeps the attitude.
    opposite = np.argmin(separate[:, :, 3], axis=1)
    kept = fixes.world_from_body[np.arange(200), opposite]
    assert np.max(np.abs(kept - truth.world_from_body)) < EXACT
    np.testing.assert_allclose(fixes.probability, np.full((200, 4), 0.25), atol=1e-3)


def test_gravity_leaves_of_one_beacons_four_the_two_that_keep_the_attitude():
    site, truth = floor(1), poses(200, seed=5)
    fixes = fixed(site, seen(site, truth), gravity=gravity_of(truth))
    assert np.all(solutions(fixes) == 2)
    assert np.all(holds_truth(fixes, truth))
    for h in (0, 1):
        assert np.max(np.abs(deviations(fixes, truth, h)[:, :3])) < EXACT


@pytest.mark.parametrize("count", [2, 3])
def test_coplanar_parallel_beacons_of_known_phase_leave_one_solution(count):
    site, truth = floor(count), poses(200, seed=6)
    fixes = fixed(site, seen(site, truth))
    assert np.all(solutions(fixes) == 1)
    assert np.all(is_exact(fixes, truth))


@pytest.mark.parametrize("with_gravity", [False, True])
@pytest.mark.parametrize("count", [2, 3])
def test_without_their_polarity_coplanar_beacons_leave_the_mirror_in_their_plane(
    count, with_gravity
):
    site, truth = floor(count, synchronised=False), poses(200, seed=7)
    gravity = gravity_of(truth) if with_gravity else None
    fixes = fixed(site, seen(site, truth, drives=drives_of(site)), gravity=gravity)
    assert np.all(solutions(fixes) == 2)
    assert np.all(holds_truth(fixes, truth))
    # The mirror's heading is turned by half a turn, its tilt is the same: gravity is no help.
    np.testing.assert_allclose(
        fixes.world_from_body[:, 0, 2], fixes.world_from_body[:, 1, 2], atol=EXACT
    )
    np.testing.assert_allclose(
        fixes.world_from_body[:, 0, :2], -fixes.world_from_body[:, 1, :2], atol=EXACT
    )


def test_close_to_the_plane_of_the_beacons_both_mirrors_are_found():
    box = np.array([[-1.0, -1.0, 0.2], [4.0, 4.0, 0.5]])
    site, truth = floor(3, synchronised=False), poses(300, seed=3, box=box)
    fixes = fixed(site, seen(site, truth))
    assert np.mean(holds_truth(fixes, truth)) > 0.99
    assert np.mean(solutions(fixes) == 2) > 0.99


def test_one_beacon_without_its_phase_leaves_the_azimuth_open_and_says_so():
    site, truth = floor(1, synchronised=False), poses(50, seed=8)
    fixes = fixed(site, seen(site, truth))
    assert not np.any(fixes.determined[:, 0])
    distance = np.linalg.norm(
        fixes.position_world[:, 0]
        + fixes.world_from_body[:, 0] @ site.platform.magnetometer.position_body,
        axis=1,
    )
    true = truth.position_world + truth.world_from_body @ site.platform.magnetometer.position_body
    np.testing.assert_allclose(distance, np.linalg.norm(true, axis=1), rtol=1e-6)


def nees(fixes, truth):
    """Return the squared deviations in units of the claimed covariance: all, rotation, position."""
    error, cov = deviations(fixes, truth), fixes.pose_cov[:, 0]
    parts = (slice(0, 6), slice(0, 3), slice(3, 6))
    return [
        np.sum(error[:, p] * np.linalg.solve(cov[:, p, p], error[:, p, None])[..., 0])
        for p in parts
    ]


@pytest.mark.parametrize("synchronised", [True, False])
@pytest.mark.parametrize("count", [4, 2])
def test_the_claimed_covariance_is_that_of_the_error_and_not_of_one_half_as_large_again(
    count, synchronised
):
    site, truth = room(count, synchronised), poses(300, seed=9)
    drives = None if synchronised else drives_of(site)
    as_told = fixed(site, seen(site, truth, SIGMA, drives=drives))
    for value, degrees in zip(nees(as_told, truth), (1800, 900, 900), strict=True):
        low, high = chi2.ppf([5e-5, 1.0 - 5e-5], degrees)
        assert low < value < high
    worse = fixed(site, seen(site, truth, 1.5 * SIGMA, drives=drives))
    better = fixed(site, seen(site, truth, SIGMA / 1.5, drives=drives))
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 1800)
    assert nees(worse, truth)[0] > high
    assert nees(better, truth)[0] < low


def test_the_cost_is_that_of_white_noise():
    site, truth = room(4), poses(300, seed=10)
    fixes = fixed(site, seen(site, truth, SIGMA))
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 300 * (24 - 6))
    assert low < np.sum(fixes.cost[:, 0]) < high
    np.testing.assert_allclose(
        fixes.residual_rms[:, 0] ** 2, fixes.cost[:, 0] / 24.0, rtol=1e-9, atol=0.0
    )


def with_cov(prior, sigma):
    n = len(prior)
    return replace(prior, pose_cov=np.broadcast_to(sigma**2 * np.eye(6), (n, 6, 6)).copy())


def shifted(truth, metres):
    return replace(truth, position_world=truth.position_world + np.array([metres, 0.0, 0.0]))


def test_a_prior_decides_between_mirrors():
    site, truth = floor(1), poses(100, seed=11)
    fixes = fixed(site, seen(site, truth, SIGMA), prior=with_cov(shifted(truth, 0.02), 0.05))
    error = deviations(fixes, truth)
    assert np.max(np.linalg.norm(error[:, 3:], axis=1)) < 0.2  # m; the next mirror is 1.2 m away
    assert np.all(fixes.cost[:, 1] > fixes.cost[:, 0] + 20.0)


def test_a_prior_counts_by_its_covariance():
    site, truth = room(4), poses(50, seed=12)
    samples, prior = seen(site, truth, SIGMA), shifted(truth, 0.01)
    free_parameters = fixed(site, samples)
    firm = fixed(site, samples, prior=with_cov(prior, 1e-8))
    loose = fixed(site, samples, prior=with_cov(prior, 1e3))
    np.testing.assert_allclose(firm.position_world[:, 0], prior.position_world, atol=1e-6)
    assert np.max(np.abs(loose.position_world[:, 0] - free_parameters.position_world[:, 0])) < 1e-6
    at_truth = fixed(site, seen(site, truth), prior=with_cov(truth, 1e-4))
    bare = fixed(site, seen(site, truth))
    added = np.linalg.inv(at_truth.pose_cov[:, 0]) - np.linalg.inv(bare.pose_cov[:, 0])
    np.testing.assert_allclose(1e-8 * added, np.broadcast_to(np.eye(6), (50, 6, 6)), atol=1e-3)


def test_a_prior_without_covariance_is_a_candidate_and_nothing_more():
    site, truth = room(4), poses(50, seed=13)
    samples = seen(site, truth, SIGMA)
    result, expected = fixed(site, samples, prior=shifted(truth, 0.3)), fixed(site, samples)
    np.testing.assert_allclose(
        result.position_world[:, 0], expected.position_world[:, 0], atol=1e-6
    )
    np.testing.assert_allclose(result.cost[:, 0], expected.cost[:, 0], rtol=1e-4)


def test_gravity_of_infinite_sigma_says_nothing():
    site, truth = room(3), poses(50, seed=14)
    samples = seen(site, truth, SIGMA)
    wrong = Gravity(np.broadcast_to([0.0, 0.0, 1.0], (50, 3)), np.full(50, np.inf))
    result, expected = fixed(site, samples, gravity=wrong), fixed(site, samples)
    np.testing.assert_allclose(
        result.position_world[:, 0], expected.position_world[:, 0], atol=1e-9
    )
    np.testing.assert_allclose(result.pose_cov[:, 0], expected.pose_cov[:, 0], rtol=1e-6)


def without(samples, epochs, channel):
    phasor, cov = samples.phasor_sensor.copy(), samples.phasor_cov.copy()
    phasor[epochs, channel] = np.nan
    cov[epochs, channel] = np.nan
    return replace(samples, phasor_sensor=phasor, phasor_cov=cov)


@pytest.mark.parametrize("survey_error", [False, True])
def test_missing_channels_are_left_out_of_their_epochs(survey_error):
    site, truth = room(4), poses(60, seed=15)
    samples = seen(site, truth)
    for channel in range(4):
        samples = without(samples, slice(10 * channel, 10 * channel + 25), channel)
    assert np.min(samples.valid.sum(axis=1)) == 1
    fixes = fixed(site, samples, survey_error=survey_error)
    several = samples.valid.sum(axis=1) > 1
    assert np.all(is_exact(fixes, truth)[several])
    assert np.all(holds_truth(fixes, truth))
    assert np.all(solutions(fixes)[~several] == 4)


def test_a_missing_beacon_is_as_one_that_is_not_there():
    truth = poses(40, seed=16)
    samples = seen(room(4), truth, SIGMA)
    three = replace(
        samples,
        channels=samples.channels[:3],
        phasor_sensor=samples.phasor_sensor[:, :3],
        phasor_cov=samples.phasor_cov[:, :3],
    )
    result, expected = fixed(room(4), without(samples, slice(None), 3)), fixed(room(3), three)
    np.testing.assert_allclose(
        result.position_world[:, 0], expected.position_world[:, 0], atol=1e-7
    )
    np.testing.assert_allclose(result.pose_cov[:, 0], expected.pose_cov[:, 0], rtol=1e-4)


def test_a_pose_is_determined_though_a_missing_beacons_phase_is_not():
    site, truth = room(4, synchronised=False), poses(20, seed=21)
    fixes = fixed(site, without(seen(site, truth), slice(None), 1))
    assert np.all(is_exact(fixes, truth))
    assert np.all(fixes.determined[:, 0])


def test_an_epoch_without_any_channel_is_not_determined_and_spoils_no_other():
    site, truth = room(4), poses(5, seed=17)
    samples = seen(site, truth)
    for channel in range(4):
        samples = without(samples, slice(2, 3), channel)
    fixes = fixed(site, samples)
    others = np.array([0, 1, 3, 4])
    assert np.all(is_exact(fixes, truth)[others])
    assert not np.any(fixes.determined[2])
    assert np.all(np.isfinite(fixes.position_world))
    assert np.all(np.isfinite(fixes.pose_cov))


def test_no_epoch_at_all_is_an_estimation_error():
    samples = seen(room(4), poses(0))
    with pytest.raises(EstimationError, match="no epoch to fix"):
        fixed(room(4), samples)


def test_epochs_do_not_know_of_each_other():
    site, truth = room(3), poses(CHUNK + 20, seed=18)
    samples = seen(site, truth, SIGMA)
    together = fixed(site, samples, gravity=gravity_of(truth))
    late = slice(CHUNK - 5, CHUNK + 5)
    rows = replace(
        samples,
        time=samples.time[late],
        window=samples.window[late],
        phasor_sensor=samples.phasor_sensor[late],
        phasor_cov=samples.phasor_cov[late],
    )
    gravity = gravity_of(truth)
    separate = fixed(site, rows, gravity=Gravity(gravity.up_body[late], gravity.sigma[late]))
    np.testing.assert_allclose(
        together.position_world[late, 0], separate.position_world[:, 0], atol=1e-9
    )
    assert together.best().time[late] == pytest.approx(separate.time)


@pytest.mark.parametrize("survey_error", [False, True])
@pytest.mark.parametrize("synchronised", [True, False])
def test_the_fix_is_where_scipys_least_squares_ends(synchronised, survey_error):
    site, truth = room(3, synchronised), poses(8, seed=19)
    samples = seen(site, truth, SIGMA)
    fixes = fixed(site, samples, survey_error=survey_error)
    calibration = initial_calibration(site, 0.0)
    cov = measurement_cov(site, samples, survey_error=survey_error)
    for n in range(8):
        roots = [np.linalg.inv(np.linalg.cholesky(1e18 * c)) * 1e9 for c in cov[n]]

        def residual(x, n=n, roots=roots):
            rotation = truth.world_from_body[n] @ Rotation.from_rotvec(x[:3]).as_matrix()
            lag = np.zeros(3) if synchronised else x[6:]
            value = predict_channels(
                replace(calibration, phase=lag),
                truth.time[n],
                rotation,
                truth.position_world[n] + x[3:6],
            )
            error = value - samples.phasor_sensor[n]
            white = np.array([root @ e for root, e in zip(roots, error, strict=True)]).ravel()
            return np.concatenate([white.real, white.imag])

        start = np.zeros(6 if synchronised else 9)
        best = least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
        position = truth.position_world[n] + best.x[3:6]
        assert np.linalg.norm(fixes.position_world[n, 0] - position) < 1e-6  # m
        assert 2.0 * best.cost == pytest.approx(fixes.cost[n, 0], rel=1e-3)


def test_hypotheses_come_best_first_and_their_shares_sum_to_one():
    site, truth = floor(1), poses(50, seed=20)
    fixes = fixed(site, seen(site, truth, SIGMA), gravity=gravity_of(truth, sigma=1.0))
    assert np.all(np.diff(fixes.cost, axis=1) >= 0.0)
    np.testing.assert_allclose(fixes.probability.sum(axis=1), np.ones(50), rtol=1e-12)
    assert np.array_equal(fixes.best().position_world, fixes.position_world[:, 0])
