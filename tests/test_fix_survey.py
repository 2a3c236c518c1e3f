"""A fix knows what the error of the survey does to it."""

from dataclasses import replace

import numpy as np
import pytest
from nees import average_nees_bounds

from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import BeaconSigma, MagnetometerSigma, Site
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import draw_drives, perturb_site, simulate_fields
from magfusion.simulation.motion import random_walk_motion
from magfusion.units import DEGREE

RUNS = 60
NOISE = 1e-9  # T


def surveyed(beacons: int, *, synchronised: bool) -> Site:
    """Return a site whose beacons stand within 2 cm and 1 degree of where they are said to."""
    site = demo_site(coil_radius=None, synchronised=synchronised)
    sigma = BeaconSigma(np.full(3, 0.02), np.full(3, DEGREE), np.full(2, 0.01))
    kept = tuple(replace(b, sigma=sigma) for b in site.beacons[:beacons])
    return replace(site, beacons=kept, model_error=1e-6)


def mean_nees(site: Site, *, survey_error: bool) -> float:
    """Return the mean over runs, each with its own survey error, of one epoch's NEES."""
    result = []
    for seed in range(RUNS):
        rng = np.random.default_rng(seed)
        motion = random_walk_motion(rng, 20.0, DEMO_BOX_WORLD)
        truth = motion.trajectory(np.array([6.0, 9.0, 12.0]))
        true_site = perturb_site(site, rng)
        drives = draw_drives(site, rng)
        samples = simulate_fields(true_site, truth, NOISE, rng, drives)
        fixes = fix_epochs(samples, initial_calibration(site, 0.0), survey_error=survey_error)
        errors = trajectory_errors(fixes.best(), truth, max_gap=10.0)
        assert errors.nees is not None
        result.append(errors.nees[1])
    return float(np.mean(result))


@pytest.mark.slow
@pytest.mark.parametrize(("beacons", "synchronised"), [(2, True), (4, True), (4, False)])
def test_the_covariance_of_a_fix_holds_the_error_of_the_survey(
    beacons: int, synchronised: bool
) -> None:
    low, high = average_nees_bounds(6, RUNS, 0.999)
    assert low < mean_nees(surveyed(beacons, synchronised=synchronised), survey_error=True) < high


@pytest.mark.slow
def test_a_fix_that_takes_the_survey_for_exact_is_found_out() -> None:
    _, high = average_nees_bounds(6, RUNS, 0.999)
    assert mean_nees(surveyed(4, synchronised=True), survey_error=False) > 10.0 * high


def test_a_survey_that_is_exact_adds_nothing_to_the_covariance() -> None:
    site, sensor = surveyed(4, synchronised=True), demo_site().platform.magnetometer
    exact = BeaconSigma(np.zeros(3), np.zeros(3), np.zeros(2))
    none = MagnetometerSigma(np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3))
    site = replace(
        site,
        beacons=tuple(replace(b, sigma=exact) for b in site.beacons),
        platform=replace(site.platform, magnetometer=replace(sensor, sigma=none)),
    )
    rng = np.random.default_rng(1)
    truth = random_walk_motion(rng, 20.0, DEMO_BOX_WORLD).trajectory(np.array([6.0, 9.0]))
    samples = simulate_fields(site, truth, NOISE, rng)
    with_survey, without = (
        fix_epochs(samples, initial_calibration(site, 0.0), survey_error=on) for on in (True, False)
    )
    assert with_survey.determined[:, 0].all()
    np.testing.assert_allclose(with_survey.pose_cov[:, 0], without.pose_cov[:, 0], rtol=1e-6)
