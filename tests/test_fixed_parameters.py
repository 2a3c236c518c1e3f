"""What a smoothed log says of parameters that are not estimated, against smoothing that does."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_problem import small_log

from magfusion.estimation.batch.batch import Smoothed, SmootherSettings, smooth
from magfusion.estimation.graph.state import pose_steps, states_in
from magfusion.estimation.integrity.fixed_parameter_test import check_fixed_parameters
from magfusion.estimation.integrity.score import moved_estimate, scores_of
from magfusion.estimation.integrity.test_result import Case
from magfusion.model.parameters import GROUPS, difference, prior_sigma
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.units import Array

MODEL_ERROR = 1e-3


def smoothed(log: Log, site: Site, estimate: tuple[str, ...] = ()) -> Smoothed:
    settings = SmootherSettings(loss=None, tune=False, estimate=estimate)
    return smooth(log, replace(site, model_error=MODEL_ERROR), settings)


def test_a_declared_sigma_allows_the_step_that_estimating_finds() -> None:
    """All parameters are wrong by what the site declares: as if they were estimated with it."""
    small = small_log(6, epochs=40, sigma=2e-9)
    fixed = smoothed(small.log, small.site)
    estimated = smoothed(small.log, small.site, GROUPS)
    assert {b.name for b in estimated.blocks} == {b.name for b in fixed.considered}
    scores = scores_of(fixed, small.log.imu)
    assert scores is not None
    score = scores.fixed
    allowed = moved_estimate(fixed, score, score.allowed(np.zeros(len(score.gradient))))
    blocks = estimated.blocks
    result = difference(fixed.calibration, estimated.calibration, blocks) / prior_sigma(blocks)
    stepped = difference(fixed.calibration, allowed.calibration, blocks) / prior_sigma(blocks)
    assert np.max(np.abs(result)) > 1.5  # declared sigmas; there is something to find
    np.testing.assert_allclose(stepped, result, atol=0.2)
    # The poses follow: what is left is that a step is linear.
    assert estimated.states.pose_cov is not None
    sigma = np.sqrt(np.diagonal(estimated.states.pose_cov, axis1=1, axis2=2))
    poses = states_in(estimated.estimate.values)
    before, after = (
        float(np.sqrt(np.mean((pose_steps(poses, states_in(e.values)) / sigma) ** 2)))
        for e in (fixed.estimate, allowed)
    )
    assert before > 1.5
    assert after < 0.4


def beacon_moved(site: Site, along_x: float) -> Site:
    first, *others = site.beacons
    place = first.position_world + np.array([along_x, 0.0, 0.0])
    return replace(site, beacons=(replace(first, position_world=place), *others))


def damage(result: Smoothed, right: Smoothed) -> float:
    """Return the mean squared distance of poses to those of the right site, by the claim."""
    off = pose_steps(states_in(right.estimate.values), states_in(result.estimate.values))
    cov = result.states.pose_cov
    assert cov is not None
    solved: Array = np.linalg.solve(cov, off[..., None])[..., 0]
    return float(np.mean(np.sum(off * solved, axis=1)))


@pytest.fixture(scope="module")
def clean() -> tuple[Log, Site, Smoothed, float]:
    """Return a log, its site, its poses, and what moving a beacon by 1 cm does to them."""
    small = small_log(3, epochs=100, sigma=2e-9, perturb=False)
    right = smoothed(small.log, small.site)
    by_1_cm = damage(smoothed(small.log, beacon_moved(small.site, 0.01)), right)
    return small.log, small.site, right, by_1_cm


@pytest.mark.parametrize(("added", "named"), [(2.5, False), (6.5, True)])
def test_a_moved_beacon_is_named_where_it_doubles_the_nees(
    clean: tuple[Log, Site, Smoothed, float], *, added: float, named: bool
) -> None:
    """Poses with the claimed covariance have a NEES of 6; what adds less than half is no doubt."""
    log, site, right, by_1_cm = clean
    result = smoothed(log, beacon_moved(site, 0.01 * float(np.sqrt(added / by_1_cm))))
    assert damage(result, right) == pytest.approx(added, rel=0.05)
    scores, cov = scores_of(result, log.imu), result.states.pose_cov
    assert scores is not None
    assert cov is not None
    findings = check_fixed_parameters(Case(result, log, scores.fixed, cov)).findings
    assert [f.code for f in findings] == (["beacon_pose"] if named else [])


def tilted(site: Site, turn_world: Array) -> Site:
    turn = Rotation.from_rotvec(turn_world).as_matrix()
    return replace(
        site,
        beacons=tuple(
            replace(
                b,
                position_world=turn @ b.position_world,
                world_from_beacon=turn @ b.world_from_beacon,
            )
            for b in site.beacons
        ),
    )


@pytest.mark.parametrize("turn_deg", [(2.0, -1.0, 0.0), (0.0, 0.0, 0.0)])
def test_a_survey_whose_vertical_is_off_is_named_with_its_tilt(
    clean: tuple[Log, Site, Smoothed, float], turn_deg: tuple[float, float, float]
) -> None:
    """The fields agree with a survey that is rotated as a whole; gravity does not."""
    log, site, _, _ = clean
    turn = np.deg2rad(turn_deg)
    result = smoothed(log, tilted(site, turn))
    scores, cov = scores_of(result, log.imu), result.states.pose_cov
    assert scores is not None
    assert cov is not None
    test = check_fixed_parameters(Case(result, log, scores.fixed, cov))
    assert [f.code for f in test.findings] == (["survey_tilt"] if np.any(turn) else [])
    if np.any(turn):
        found = re.search(r"by (\S+) deg about x and (\S+) deg about y", test.findings[0].text)
        assert found is not None
        tilt_deg = [float(x) for x in found.groups()]
        np.testing.assert_allclose(tilt_deg, turn_deg[:2], atol=0.3)  # deg
