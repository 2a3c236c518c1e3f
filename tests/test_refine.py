"""Refinement from a given pose, and what it costs to find phases and gains beside the pose."""

from dataclasses import replace

import numpy as np
import pytest
from example_site import mixed_site
from paper_rooms import ROOM, S0, draw_world
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from magfusion.errors import EstimationError
from magfusion.estimation.snapshot.fix import Gravity
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.problem import CHUNK, ESTIMABLE
from magfusion.estimation.snapshot.refine import refine
from magfusion.model.field_map import FieldMap
from magfusion.model.noise import measurement_cov, paired_whitening, sensor_positions, stacked
from magfusion.model.parameters import GAIN, Block, initial_calibration, predict_channels, retract
from magfusion.model.samples import FieldSamples
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import simulate_fields
from magfusion.units import DEGREE

SIGMA = 3e-10  # T, of a phasor's component
EXACT = 1e-6  # m, rad


def dipoles(count=3):
    """Return the first few of the demo's beacons as dipoles that are known exactly."""
    site = demo_site(coil_radius=None)
    return replace(site, beacons=site.beacons[:count], model_error=0.0)


def poses(count, seed=1):
    rng = np.random.default_rng(seed)
    attitudes = Rotation.random(count, random_state=seed).as_matrix()
    return Trajectory(np.arange(float(count)), attitudes, rng.uniform(*DEMO_BOX_WORLD, (count, 3)))


def astray(truth, seed=2, metres=0.1, radians=0.05):
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(0.0, radians, (len(truth), 3))).as_matrix()
    shift = rng.normal(0.0, metres, (len(truth), 3))
    return replace(
        truth,
        world_from_body=truth.world_from_body @ turn,
        position_world=truth.position_world + shift,
    )


def seen(site, truth, noise=SIGMA):
    """Return phasors that claim SIGMA and have another noise (T)."""
    samples = simulate_fields(site, truth, noise, np.random.default_rng(3))
    cov = np.broadcast_to(SIGMA**2 * np.eye(3), samples.phasor_cov.shape)
    return replace(samples, phasor_cov=cov.copy())


def refined(site, samples, start, **options):
    options.setdefault("survey_error", False)
    return refine(samples, initial_calibration(site, 0.0), start, **options)


def deviations(fixes, truth):
    """Return the truth's right perturbation of the fixes, rotation then position, (n, 6)."""
    body_from_world = np.swapaxes(fixes.world_from_body[:, 0], 1, 2)
    turn = Rotation.from_matrix(body_from_world @ truth.world_from_body).as_rotvec()
    separate = truth.position_world - fixes.position_world[:, 0]
    return np.concatenate([turn, (body_from_world @ separate[..., None])[..., 0]], axis=1)


def nees(fixes, truth):
    error = deviations(fixes, truth)
    return np.sum(error * np.linalg.solve(fixes.pose_cov[:, 0], error[..., None])[..., 0], axis=1)


@pytest.mark.parametrize("survey_error", [False, True])
@pytest.mark.parametrize("free_parameters", [(), ("phase",), ("gain",), ESTIMABLE])
def test_without_noise_the_truth_is_found_from_nearby(survey_error, free_parameters):
    site, truth = dipoles(4), poses(CHUNK + 100)
    fixes = refined(
        site,
        seen(site, truth, 0.0),
        astray(truth),
        survey_error=survey_error,
        free_parameters=free_parameters,
    )
    assert fixes.cost.shape == (len(truth), 1)
    right = np.max(np.abs(deviations(fixes, truth)), axis=1) < EXACT
    # Free gains make other minima; where these lie nearer, that is where the start leads.
    assert np.mean(right) > (0.99 if "gain" in free_parameters else 0.9995)


def test_it_ends_where_the_search_ends_with_the_same_covariance():
    site, truth = dipoles(), poses(60)
    samples = seen(site, truth)
    result = refined(site, samples, astray(truth))
    expected = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False)
    np.testing.assert_allclose(
        result.position_world[:, 0], expected.position_world[:, 0], atol=1e-6
    )
    np.testing.assert_allclose(
        result.pose_cov[:, 0], expected.pose_cov[:, 0], rtol=1e-3, atol=1e-12
    )
    np.testing.assert_allclose(result.cost[:, 0], expected.cost[:, 0], rtol=1e-4)


def test_it_stays_on_the_side_where_it_starts():
    site, truth = dipoles(1), poses(30)
    lever = truth.world_from_body @ site.platform.magnetometer.position_body
    centre = site.beacons[0].position_world
    mirrored = replace(truth, position_world=2.0 * (centre - lever) - truth.position_world)
    fixes = refined(site, seen(site, truth, 0.0), mirrored)
    np.testing.assert_allclose(fixes.position_world[:, 0], mirrored.position_world, atol=EXACT)
    np.testing.assert_allclose(fixes.cost, 0.0, atol=1e-3)


def test_gravity_and_a_prior_count_as_they_do_in_the_search():
    site, truth = dipoles(2), poses(40)
    samples = seen(site, truth)
    known = {
        "gravity": Gravity(truth.world_from_body[:, 2], np.full(40, 0.01)),
        "prior": replace(truth, pose_cov=np.broadcast_to(1e-4 * np.eye(6), (40, 6, 6)).copy()),
    }
    result = refined(site, samples, astray(truth), **known)
    expected = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=False, **known)
    np.testing.assert_allclose(
        result.position_world[:, 0], expected.position_world[:, 0], atol=1e-6
    )
    np.testing.assert_allclose(result.residual_rms[:, 0], expected.residual_rms[:, 0], rtol=1e-4)


def test_no_epoch_at_all_is_an_estimation_error():
    site, none = dipoles(), poses(0)
    with pytest.raises(EstimationError, match="no epoch to fix"):
        refined(site, seen(site, none), none)


def test_what_cannot_be_free_is_refused_by_name():
    site, truth = dipoles(), poses(2)
    with pytest.raises(ValueError, match="'matrix'"):
        refined(site, seen(site, truth), truth, free_parameters=("matrix",))


@pytest.mark.parametrize("from_guess", [True, False])
def test_phases_and_gains_that_the_site_does_not_know_of_are_found(from_guess):
    site, truth = dipoles(4), poses(80)
    calibration = initial_calibration(site, 0.0)
    lag, gain = np.array([0.3, -0.2, 0.1, 0.4]), np.array([0.1, -0.05, 0.2, -0.1])
    odd = replace(calibration, phase=lag, log_gain=gain)
    phasor = predict_channels(odd, truth.time, truth.world_from_body, truth.position_world)
    samples = replace(seen(site, truth), phasor_sensor=phasor)
    options = {"survey_error": False, "free_parameters": ESTIMABLE, "gain_sigma": 10.0}
    if from_guess:
        fixes = refine(samples, calibration, astray(truth, metres=0.02), **options)
    else:
        fixes = fix_epochs(samples, calibration, **options)
    right = np.max(np.abs(deviations(fixes, truth)), axis=1) < 1e-4
    assert np.mean(right) > 0.9  # the others are mirrored or in another minimum
    np.testing.assert_allclose(fixes.phase[right, 0], np.broadcast_to(lag, (80, 4))[right], 0, 1e-3)
    gains = np.broadcast_to(gain, (80, 4))[right]
    np.testing.assert_allclose(fixes.log_gain[right, 0], gains, 0, 1e-3)
    fixed = refined(site, samples, truth)
    assert np.median(fixed.cost) > 1e3 * np.median(fixes.cost[right, 0] + 1.0)


def test_a_gain_is_held_by_its_prior():
    site, truth = dipoles(), poses(20)
    samples = seen(site, truth)
    firm = refined(site, samples, truth, free_parameters=("gain",), gain_sigma=1e-6)
    plain = refined(site, samples, truth)
    np.testing.assert_allclose(firm.position_world, plain.position_world, atol=1e-7)
    np.testing.assert_allclose(firm.pose_cov, plain.pose_cov, rtol=1e-3, atol=1e-12)


def test_the_gain_of_a_beacon_with_several_tones_is_one():
    site = replace(mixed_site(), model_error=0.0)
    truth, calibration = poses(30), initial_calibration(site, 0.0)
    blocks = (Block(GAIN, "B", slice(0, 1), np.ones(1)),)
    odd = retract(calibration, blocks, np.array([0.1]))
    phasor = predict_channels(odd, truth.time, truth.world_from_body, truth.position_world)
    channels = phasor.shape[1]
    samples = FieldSamples(
        time=truth.time,
        window=np.ones(30),
        channels=site.channels,
        phasor_sensor=phasor,
        phasor_cov=np.broadcast_to(SIGMA**2 * np.eye(3), (30, channels, 3, 3)).copy(),
    )
    fixes = refine(
        samples, calibration, truth, survey_error=False, free_parameters=("gain",), gain_sigma=10.0
    )
    np.testing.assert_allclose(
        fixes.log_gain[:, 0], np.broadcast_to(odd.log_gain, (30, channels)), atol=1e-4
    )


# (free, rms of the bound: position (m), attitude (deg)); physics of the beacon papers, section 7.
PRICES = [((), 0.0009, 0.045), (("phase",), 0.0015, 0.064), (ESTIMABLE, 0.0137, 0.126)]


@pytest.mark.parametrize(("free_parameters", "metres", "degrees"), PRICES)
def test_what_free_phases_and_gains_cost_in_the_room_of_paper_004(free_parameters, metres, degrees):
    rng = np.random.default_rng(4)
    site = draw_world(S0, rng, model_error=0.0).site
    position = ROOM.draw_targets(rng, 3000)
    level = np.broadcast_to(np.eye(3), (3000, 3, 3)).copy()
    truth = Trajectory(np.arange(3000.0), level, position)
    fixes = refined(site, seen(site, truth), truth, free_parameters=free_parameters)
    variance = np.diagonal(fixes.pose_cov[:, 0], axis1=1, axis2=2)
    bound = np.sqrt(np.mean(np.sum(variance[:, 3:], axis=1)))
    assert bound == pytest.approx(metres, rel=0.05)
    assert np.sqrt(np.mean(np.sum(variance[:, :3], axis=1))) / DEGREE == pytest.approx(
        degrees, rel=0.05
    )
    # The errors are what the covariance claims.
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 6 * 3000)
    assert low < np.sum(nees(fixes, truth)) < high
    error = deviations(fixes, truth)
    assert np.sqrt(np.mean(np.sum(error[:, 3:] ** 2, axis=1))) == pytest.approx(bound, rel=0.05)


def half_mapped(site):
    """Return the site with maps that are known on one side of the room alone."""
    points = np.stack(np.meshgrid([0.0, 0.7, 1.4], [0.0, 1.5, 3.0], [1.0]), axis=-1).reshape(-1, 3)
    field_map = FieldMap(
        points_world=points,
        weights=0.3 * np.random.default_rng(6).normal(size=(len(points), 4)),
        information=np.broadcast_to(1e4 * np.eye(4), (len(points), 4, 4)).copy(),
        length_scale=1.0,
        gain_sigma=0.1,
        rotation_sigma=0.05,
        residual=0.002,
    )
    return replace(site, beacons=tuple(replace(b, field_map=field_map) for b in site.beacons))


@pytest.mark.parametrize("from_guess", [True, False])
def test_a_map_counts_by_how_well_it_is_known_where_the_fix_is(from_guess):
    site, truth = half_mapped(dipoles()), poses(60)
    calibration = initial_calibration(site, 0.0)
    samples = seen(dipoles(), truth)
    phasor = predict_channels(
        calibration, truth.time, truth.world_from_body, truth.position_world
    ) + (samples.phasor_sensor - seen(dipoles(), truth, 0.0).phasor_sensor)
    samples = replace(samples, phasor_sensor=phasor)
    if from_guess:
        fixes = refined(site, samples, astray(truth, metres=0.02))
    else:
        fixes = fix_epochs(samples, calibration, survey_error=False)
    result = fixes.best()
    error = stacked(
        predict_channels(calibration, result.time, result.world_from_body, result.position_world)
        - samples.phasor_sensor
    )

    def chi_square(sensor_world):
        cov = measurement_cov(site, samples, sensor_world=sensor_world)
        white = paired_whitening(cov, samples.valid) @ error[..., None]
        return np.sum(white**2, axis=(1, 2, 3))

    # The weights are those of the first solution, millimetres from the last.
    there = chi_square(sensor_positions(site, result))
    np.testing.assert_allclose(fixes.cost[:, 0], there, rtol=0.02)
    assert np.median(np.abs(chi_square(None) / there - 1.0)) > 0.1
