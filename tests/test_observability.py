"""What a log told of the calibration: gauge recognised, directions counted, weak ones in words."""

from dataclasses import replace

import numpy as np
import pytest
from example_site import mixed_site
from scipy.spatial.transform import Rotation

from magfusion.model.parameters import (
    Block,
    Calibration,
    choose_blocks,
    dimension,
    initial_calibration,
    linearize_channels,
    predict_channels,
    prior_sigma,
    retract,
)
from magfusion.model.samples import ImuSamples
from magfusion.model.site import BeaconSigma, MagnetometerSigma, Site
from magfusion.model.trajectory import Trajectory
from magfusion.results.gauge import Gauge, gauges
from magfusion.results.motion_coverage import missing_motion, motion_coverage
from magfusion.results.observability import CalibrationObservability, gauge_basis, observability
from magfusion.results.transfer import Estimated, agreement
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site

GROUPS = ("beacons", "moments", "phase", "magnetometer", "extrinsics")

SCALE = "common scale of all distances"


def uncertain(site: Site) -> Site:
    sigma = BeaconSigma(np.full(3, 0.05), np.full(3, 0.03), np.full(2, 0.03))
    zeros = np.zeros(3)
    sensor = replace(
        site.platform.magnetometer,
        sigma=MagnetometerSigma(np.full((3, 3), 0.01), zeros, np.full(3, 0.02), zeros),
    )
    beacons = tuple(replace(b, sigma=sigma) for b in site.beacons)
    return replace(site, beacons=beacons, platform=replace(site.platform, magnetometer=sensor))


def poses(count: int, seed: int = 1) -> Trajectory:
    rng = np.random.default_rng(seed)
    position = rng.uniform(*DEMO_BOX_WORLD, (count, 3))
    rotated = Rotation.random(count, random_state=rng).as_matrix()
    return Trajectory(np.arange(float(count)), rotated, position)


def linear(
    calibration: Calibration, blocks: tuple[Block, ...], at: Trajectory
) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobians by pose and calibration, one row of channels' numbers each epoch."""
    _, by_pose, by_calibration = linearize_channels(
        calibration, blocks, at.time, at.world_from_body, at.position_world
    )
    n = len(at)
    return by_pose.reshape(n, -1, 6), by_calibration.reshape(n, by_pose.size // n // 6, -1)


def unexplained(gauge: Gauge, by_pose: np.ndarray, by_calibration: np.ndarray) -> float:
    """Return what of a gauge's effect no motion of the platform takes up, relative to its parts."""
    change = by_calibration @ gauge.direction
    rest = change - (by_pose @ (np.linalg.pinv(by_pose) @ change[..., None]))[..., 0]
    scale = np.linalg.norm(by_calibration * np.abs(gauge.direction))
    return float(np.linalg.norm(rest) / scale)


@pytest.fixture(scope="module", params=["mixed", "synchronised", "unsynchronised"])
def problem(request: pytest.FixtureRequest) -> tuple[Calibration, tuple[Block, ...]]:
    if request.param == "mixed":
        site = mixed_site()
    else:
        plain = demo_site(coil_radius=None, synchronised=request.param == "synchronised")
        site = uncertain(plain)
    calibration = initial_calibration(site, 0.0)
    return calibration, choose_blocks(site, GROUPS)


def test_no_measurement_tells_a_gauge(problem: tuple[Calibration, tuple[Block, ...]]) -> None:
    calibration, blocks = problem
    by_pose, by_calibration = linear(calibration, blocks, poses(20))
    result = gauges(calibration, blocks)
    assert len(result) >= 11  # shifts, turns, the scale of moments, the mounting, the scale of all
    for gauge in result:
        if not (gauge.name.startswith(SCALE) and len(calibration.site.channels) > 4):
            assert unexplained(gauge, by_pose, by_calibration) < 1e-9, gauge.name


def test_the_platform_need_not_move_for_what_is_between_sensor_and_coils() -> None:
    site = uncertain(demo_site(coil_radius=None, synchronised=False))
    calibration = initial_calibration(site, 0.0)
    blocks = choose_blocks(site, GROUPS)
    _, by_calibration = linear(calibration, blocks, poses(20))
    names = []
    for gauge in gauges(calibration, blocks):
        if not gauge.name.startswith("all beacons") and not gauge.name.startswith(SCALE):
            change = np.linalg.norm(by_calibration @ gauge.direction)
            assert change < 1e-9 * np.linalg.norm(by_calibration)
            names.append(gauge.name)
    assert sum("about its own axis against its drive phase" in name for name in names) == 4


def test_a_whole_shift_is_a_gauge_however_large() -> None:
    site = uncertain(demo_site(coil_radius=None))
    calibration = initial_calibration(site, 0.0)
    blocks = choose_blocks(site, GROUPS)
    along_y = next(g for g in gauges(calibration, blocks) if g.name.endswith("along y"))
    at = poses(5)
    moved = retract(calibration, blocks, 3.0 * along_y.direction)
    there = at.position_world + np.array([0.0, 3.0, 0.0])
    before = predict_channels(calibration, at.time, at.world_from_body, at.position_world)
    after = predict_channels(moved, at.time, at.world_from_body, there)
    np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-20)


def test_a_synchronised_beacon_cannot_hide_a_turn_in_its_phase() -> None:
    site = uncertain(demo_site(coil_radius=None))
    blocks = choose_blocks(site, GROUPS)
    names = [g.name for g in gauges(initial_calibration(site, 0.0), blocks)]
    assert not any("own axis" in name for name in names)


def test_a_beacon_that_is_held_holds_them_all() -> None:
    site = uncertain(demo_site(coil_radius=None))
    known = replace(site.beacons[0].sigma, position_world=np.zeros(3))
    fixed = replace(site, beacons=(replace(site.beacons[0], sigma=known), *site.beacons[1:]))
    names = [g.name for g in gauges(initial_calibration(fixed, 0.0), choose_blocks(fixed, GROUPS))]
    assert not any("shifted" in name for name in names)


def posterior(
    calibration: Calibration, blocks: tuple[Block, ...], at: Trajectory, sigma: float
) -> np.ndarray:
    """Return the covariance of the calibration after phasors at places that are free.

    The attitudes are known, as by a gyro, but for a rotation of them all.
    """
    by_pose, by_calibration = linear(calibration, blocks, at)
    by_turn = by_pose[..., :3] @ np.swapaxes(at.world_from_body, 1, 2)
    shared = np.concatenate([by_calibration, by_turn], axis=-1)
    by_place = by_pose[..., 3:]
    free_parameters = shared - by_place @ (np.linalg.pinv(by_place) @ shared)
    rows = free_parameters.reshape(-1, dimension(blocks) + 3) / sigma
    weight = np.concatenate([prior_sigma(blocks) ** -2.0, np.full(3, 1e-2)])
    return np.linalg.inv(rows.T @ rows + np.diag(weight))[:-3, :-3]


@pytest.fixture(scope="module")
def seen() -> tuple[Calibration, tuple[Block, ...], CalibrationObservability]:
    """Return what 60 poses tell of four beacons, without gravity."""
    site = uncertain(demo_site(coil_radius=None))
    calibration, blocks = initial_calibration(site, 0.0), choose_blocks(site, GROUPS)
    cov = posterior(calibration, blocks, poses(60), 1e-10)
    return calibration, blocks, observability(calibration, blocks, cov)


def test_the_gauge_is_named_with_what_it_leaves(
    seen: tuple[Calibration, tuple[Block, ...], CalibrationObservability],
) -> None:
    _, blocks, result = seen
    words = [one.words for one in result.gauge]
    # Four beacons of 5 cm each: their mean is known to 2.5 cm.
    assert "all beacons shifted together along x by 2.5 cm" in words[0]
    assert "not observable from any log" in words[0]
    assert any("rotated together about the vertical" in text for text in words)
    assert any("common scale of the moments" in text for text in words)
    assert [one.ratio for one in result.gauge] == pytest.approx([1.0] * len(words), abs=1e-6)
    # Tilt and scale are open where there is no IMU, and are told apart from the gauge.
    assert sum("tilted" in one.words for one in result.weakest) == 2
    assert sum(SCALE in one.words for one in result.weakest) == 1
    assert result.determined == dimension(blocks) - len(words) - len(result.weakest)


def test_beside_the_gauge_all_is_determined(
    seen: tuple[Calibration, tuple[Block, ...], CalibrationObservability],
) -> None:
    _, blocks, result = seen
    position = next(b for b in blocks if b.name == "B.position").columns
    assert np.all(result.ratio[position] > 0.5)
    assert np.all(result.ratio_but_for_gauge[position] < 0.1)


def test_the_gauge_basis_is_orthonormal_and_of_no_effect(
    seen: tuple[Calibration, tuple[Block, ...], CalibrationObservability],
) -> None:
    calibration, blocks, result = seen
    basis = gauge_basis(calibration, blocks)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), rtol=0.0, atol=1e-12)
    assert basis.shape[1] == len(result.gauge) == 8  # 3 shifts, heading, scale, 3 of the mounting


def test_a_weak_direction_is_told_by_what_dominates_it() -> None:
    site = uncertain(demo_site(coil_radius=None))
    calibration, blocks = (
        initial_calibration(site, 0.0),
        choose_blocks(site, ("beacons", "moments")),
    )
    prior = prior_sigma(blocks)
    own = {b.name: b.columns for b in blocks}
    weak = np.zeros(len(prior))
    weak[own["B.position"].start + 2] = 0.8
    weak[own["B.log_moment"]] = -0.6 / np.sqrt(2.0)
    scaled = 1e-4 * np.eye(len(prior)) + 0.81 * np.outer(weak, weak)
    result = observability(calibration, blocks, scaled * prior[:, None] * prior)
    assert len(result.weakest) == 1
    assert result.weakest[0].ratio == pytest.approx(0.9, abs=1e-3)
    reported = "the height of beacon B by +3.6 cm against the moments of beacon B by -1.1 %"
    assert result.weakest[0].words.startswith(reported)
    assert not result.gauge
    assert result.determined == len(prior) - 1


def test_missing_motion_is_told_from_what_is_open_and_where_the_platform_was() -> None:
    site = uncertain(demo_site(coil_radius=None))
    calibration, blocks = initial_calibration(site, 0.0), choose_blocks(site, GROUPS)
    still = Trajectory(
        np.arange(40.0), np.tile(np.eye(3), (40, 1, 1)), np.tile([3.0, 2.5, 1.0], (40, 1))
    )
    static = np.arange(0.0, 40.0, 0.01)
    moving = 2.0 * np.sin(7.0 * static)[:, None] * np.ones(3)
    imu = ImuSamples(static, moving, moving + np.array([0.0, 0.0, 9.81]))
    covered = motion_coverage(still, calibration, imu)
    sensor = still.position_world[0] + site.platform.magnetometer.position_body
    to_c = np.linalg.norm(sensor - site.beacons[2].position_world)
    assert covered.nearest["C"] == pytest.approx(to_c, rel=1e-12)
    assert covered.rest_share == 0.0
    np.testing.assert_allclose(covered.turned_deg, 0.0, atol=1e-9)
    cov = posterior(calibration, blocks, still, 1e-10)
    result = observability(calibration, blocks, cov)
    reported = " ".join(missing_motion(covered, calibration, blocks, result))
    assert f"never closer than {to_c:.1f} m to beacon C" in reported
    assert "Rotation about x and y and z of the body was small" in reported
    assert "moved by only 0 cm along x, 0 cm along y, 0 cm along z" in reported
    assert "was never stationary" in reported


def test_nothing_is_missing_where_all_is_determined() -> None:
    site = uncertain(demo_site(coil_radius=None))
    calibration, blocks = initial_calibration(site, 0.0), choose_blocks(site, GROUPS)
    time = np.arange(0.0, 20.0, 0.01)
    imu = ImuSamples(time, np.zeros((2000, 3)), np.tile([0.0, 0.0, 9.81], (2000, 1)))
    at = poses(60)
    result = observability(calibration, blocks, posterior(calibration, blocks, at, 1e-11))
    assert missing_motion(motion_coverage(at, calibration, imu), calibration, blocks, result) == []


def test_the_difference_of_two_estimates_has_the_sigma_that_agreement_says() -> None:
    """Calibrations drawn from the prior, measured twice, estimated with the prior."""
    site = uncertain(demo_site(coil_radius=None))
    start = initial_calibration(site, 0.0)
    blocks = choose_blocks(site, ("moments", "extrinsics"))
    rng = np.random.default_rng(5)
    prior = prior_sigma(blocks)
    size = len(prior)
    designs = [rng.standard_normal((2 * size, size)) * rng.uniform(0.3, 3.0, size) for _ in "12"]
    directions = []
    for _ in range(300):
        true = rng.standard_normal(size)
        estimated = []
        for design in designs:
            cov = np.linalg.inv(design.T @ design + np.eye(size))
            data = design @ true + rng.standard_normal(2 * size)
            step = cov @ design.T @ data * prior
            scaled = cov * prior[:, None] * prior
            moved = retract(start, blocks, 1e-3 * step)  # small: the chart is flat there
            tiny = tuple(b._replace(sigma=1e-3 * b.sigma) for b in blocks)
            estimated.append(Estimated(start, moved, tiny, 1e-6 * scaled))
        directions.append(agreement(*estimated))
    spread = np.std(directions, axis=0)
    np.testing.assert_allclose(spread, 1.0, rtol=0.15)
