"""Coils of 10 to 30 cm at 0.3 to 1 m: what the estimators claim is what they err by.

The field is that of the simulator, which sums over elements of the wire.
"""

from dataclasses import replace

import numpy as np
import pytest
from nees import average_nees_bounds
from scipy.spatial.transform import Rotation

from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.refine import refine
from magfusion.model.coil_field import as_points
from magfusion.model.parameters import initial_calibration
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import pose_errors, trajectory_errors
from magfusion.simulation.demo_site import demo_site
from magfusion.simulation.log import SimulationConfig, simulate_fields, simulate_log

SIGMA = 1e-9  # T, of a phasor's component
POSES = 200


def poses_about(site: Site, radius: float) -> Trajectory:
    """Return poses of which each is near one of the beacons, yet outside its coils."""
    rng = np.random.default_rng(4)
    direction = rng.normal(size=(POSES, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    distance = rng.uniform(max(0.3, 1.5 * radius), 1.0, POSES)
    centre = np.array([b.position_world for b in site.beacons])[rng.integers(0, 4, POSES)]
    attitude = Rotation.random(POSES, random_state=3).as_matrix()
    return Trajectory(0.2 * np.arange(POSES), attitude, centre + distance[:, None] * direction)


def squares(fixes: Fixes, truth: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance from the truth (m), and the square of the error in sigmas."""
    error = pose_errors(fixes.world_from_body[:, 0], fixes.position_world[:, 0], truth)
    separate = np.linalg.norm(fixes.position_world[:, 0] - truth.position_world, axis=1)
    return separate, np.einsum("ni,nij,nj->n", error, np.linalg.inv(fixes.pose_cov[:, 0]), error)


@pytest.mark.parametrize("radius", [0.1, 0.2, 0.3])
def test_fixes_without_a_guess_are_as_good_as_they_claim(radius: float) -> None:
    site = replace(demo_site(coil_radius=radius), model_error=0.0)
    truth = poses_about(site, radius)
    samples = simulate_fields(site, truth, SIGMA, np.random.default_rng(5))
    known = initial_calibration(site, 0.0)
    separate, nees = squares(fix_epochs(samples, known, survey_error=False), truth)
    assert np.max(separate) < 0.01
    low, high = average_nees_bounds(6, POSES, 0.999)
    assert low < np.mean(nees) < high
    # The dipoles that stand for the coils are not, even started from the truth.
    dipoles = replace(site, beacons=tuple(as_points(b) for b in site.beacons))
    plain = refine(samples, initial_calibration(dipoles, 0.0), truth, survey_error=False)
    assert np.mean(squares(plain, truth)[1]) > 1e3


@pytest.mark.slow
@pytest.mark.parametrize(("radius", "nearer"), [(0.1, 0.0), (0.3, 0.1)])
def test_a_log_that_passes_a_coil(radius: float, nearer: float) -> None:
    """Motion within the windows and all: from 0.35 m, a calibration drawn from its prior."""
    site = replace(demo_site(coil_radius=radius), model_error=1e-4)
    box = np.array([[0.3, 0.1, 0.25], [0.7, 0.6, 0.7]]) - nearer  # m; beacon A is at its corner
    config = SimulationConfig(box, duration=20.0, speed=0.2)
    nees = []
    for seed in range(2):
        log = simulate_log(site, config, np.random.default_rng(seed)).log
        assert log.truth is not None
        errors = trajectory_errors(smooth(log, site).states, log.truth)
        assert errors.ate < 0.01
        assert errors.nees is not None
        nees.append(np.nanmean(errors.nees))
    assert np.mean(nees) < 8.0  # the survey's error is one and the same in all of a log
