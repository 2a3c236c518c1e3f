"""Trajectory errors agree with evo, and consistency figures with their definition."""

import gtsam
import numpy as np
import pytest
from evo.core.metrics import APE, RPE, PoseRelation, Unit
from evo.core.trajectory import PosePath3D
from nees import average_nees_bounds, pooled_nees
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.model.trajectory import Trajectory
from magfusion.results.errors import trajectory_errors

POSES = 80


def _pair(seed: int, attitude_sigma: float = 0.3) -> tuple[Trajectory, Trajectory]:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.05, 0.09, POSES))
    true = Rotation.random(POSES, random_state=rng)
    error = Rotation.from_rotvec(attitude_sigma * rng.standard_normal((POSES, 3)))
    position = 3.0 * rng.standard_normal((POSES, 3))
    truth = Trajectory(time, true.as_matrix(), position)
    tilt = Rotation.from_rotvec([0.2, -0.1, 0.4])
    shift = np.array([0.5, -1.0, 0.2])  # m
    moved = tilt.apply(position + 0.2 * rng.standard_normal((POSES, 3))) + shift
    return Trajectory(time, (tilt * true * error).as_matrix(), moved), truth


def _evo(trajectory: Trajectory) -> PosePath3D:
    poses = np.tile(np.eye(4), (len(trajectory), 1, 1))
    poses[:, :3, :3] = trajectory.world_from_body
    poses[:, :3, 3] = trajectory.position_world
    return PosePath3D(poses_se3=list(poses))


def _ape(estimate: PosePath3D, truth: PosePath3D, relation: PoseRelation) -> np.ndarray:
    metric = APE(relation)
    metric.process_data((truth, estimate))
    return metric.error


@pytest.mark.parametrize("seed", range(3))
def test_absolute_errors_are_those_of_evo(seed: int) -> None:
    estimate, truth = _pair(seed)
    errors = trajectory_errors(estimate, truth)
    position = _ape(_evo(estimate), _evo(truth), PoseRelation.translation_part)
    angle = _ape(_evo(estimate), _evo(truth), PoseRelation.rotation_angle_rad)
    np.testing.assert_allclose(np.linalg.norm(errors.position_world, axis=1), position, rtol=1e-9)
    np.testing.assert_allclose(errors.attitude, angle, rtol=1e-9)
    assert errors.ate == pytest.approx(np.sqrt(np.mean(position**2)), rel=1e-9)
    rms_deg = np.rad2deg(np.sqrt(np.mean(angle**2)))
    assert errors.attitude_rmse_deg == pytest.approx(rms_deg, rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_aligned_position_errors_are_those_of_evo(seed: int) -> None:
    estimate, truth = _pair(seed)
    aligned = _evo(estimate)
    aligned.align(_evo(truth))
    errors = trajectory_errors(estimate, truth)
    expected = _ape(aligned, _evo(truth), PoseRelation.translation_part)
    result = np.linalg.norm(errors.aligned_position_world, axis=1)
    np.testing.assert_allclose(result, expected, rtol=1e-9)
    assert errors.aligned_ate < 0.5 * errors.ate


@pytest.mark.parametrize("delta", [1, 5])
def test_relative_errors_are_those_of_evo(delta: int) -> None:
    estimate, truth = _pair(4)
    relative = trajectory_errors(estimate, truth, delta_frames=delta).relative
    for relation, result in (
        (PoseRelation.translation_part, relative.translation),
        (PoseRelation.rotation_angle_rad, relative.rotation),
    ):
        metric = RPE(relation, delta=delta, delta_unit=Unit.frames)
        metric.process_data((_evo(truth), _evo(estimate)))
        np.testing.assert_allclose(result, metric.error, rtol=1e-9)


def test_a_constant_world_rotation_is_no_aligned_attitude_error() -> None:
    estimate, truth = _pair(6, attitude_sigma=0.0)
    errors = trajectory_errors(estimate, truth)
    tilt_deg = np.rad2deg(np.linalg.norm([0.2, -0.1, 0.4]))
    assert errors.attitude_rmse_deg == pytest.approx(tilt_deg, rel=1e-9)
    assert errors.aligned_attitude_rmse_deg < 1e-6  # deg, rounding of arccos near one


def test_the_truth_is_interpolated_but_not_across_its_gaps() -> None:
    rate = np.array([0.3, -0.2, 0.5])  # rad/s
    velocity = np.array([0.4, 0.1, -0.2])  # m/s

    def at(time: np.ndarray) -> Trajectory:
        turn = Rotation.from_rotvec(time[:, None] * rate).as_matrix()
        return Trajectory(time, turn, time[:, None] * velocity)

    known = np.concatenate([np.arange(0.0, 2.0, 0.05), np.arange(5.0, 7.0, 0.05)])
    wanted = np.arange(-0.51, 8.0, 0.1)
    errors = trajectory_errors(at(wanted), at(known))
    inside = (wanted >= 0.0) & (wanted <= 1.95) | (wanted >= 5.0) & (wanted <= 6.95)
    assert np.array_equal(errors.compared, inside)
    assert errors.ate < 1e-12  # m, rounding
    assert errors.attitude_rmse_deg < 1e-9  # deg, rounding
    assert errors.aligned_ate < 1e-12  # m: the path is straight, its alignment not unique


def test_a_truth_on_another_clock_is_refused_with_the_remedy() -> None:
    estimate, truth = _pair(7)
    late = Trajectory(truth.time + 1e3, truth.world_from_body, truth.position_world)
    with pytest.raises(InputError, match=r"0 of the estimate's 80 epochs.*same clock"):
        trajectory_errors(estimate, late)


def test_nees_of_errors_drawn_from_the_covariance_is_chi_square() -> None:
    rng = np.random.default_rng(8)
    runs = 2000
    root = 0.02 * rng.standard_normal((6, 6))
    cov = root @ root.T + 1e-5 * np.eye(6)
    true = [gtsam.Pose3.Expmap(rng.standard_normal(6)) for _ in range(runs)]
    drawn = rng.multivariate_normal(np.zeros(6), cov, runs)
    moved = [pose.retract(step) for pose, step in zip(true, drawn, strict=True)]

    def build(poses: list[gtsam.Pose3], scale: float) -> Trajectory:
        return Trajectory(
            np.arange(float(runs)),
            np.array([p.rotation().matrix() for p in poses]),
            np.array([p.translation() for p in poses]),
            pose_cov=np.tile(scale * cov, (runs, 1, 1)),
        )

    errors = trajectory_errors(build(moved, 1.0), build(true, 1.0))
    low, high = average_nees_bounds(6, runs, 0.999)
    assert errors.nees is not None
    assert low < errors.nees.mean() < high
    assert errors.inside_3_sigma == pytest.approx(0.9973, abs=0.0015)  # three binomial sigmas
    claimed = trajectory_errors(build(moved, 1.1**-2), build(true, 1.0))
    assert claimed.nees is not None
    assert claimed.nees.mean() > high


def test_pooled_nees_catches_sigmas_that_are_ten_percent_wrong() -> None:
    rng = np.random.default_rng(9)
    runs, n, epochs = 50, 500, np.array([50, 150, 250, 350, 450])
    covs = np.tile(np.diag([1.0, 4.0, 9.0, 1.0, 2.0, 3.0]), (runs, n, 1, 1))
    errors = rng.standard_normal((runs, n, 6)) * np.sqrt(np.diag(covs[0, 0]))
    low, high = average_nees_bounds(6, runs * len(epochs), 0.99)
    assert low < 6.0 < high
    assert low < pooled_nees(errors, covs, epochs) < high
    assert pooled_nees(1.15 * errors, covs, epochs) > high
    assert pooled_nees(0.85 * errors, covs, epochs) < low


def test_position_sigma_is_turned_from_body_to_world() -> None:
    estimate, truth = _pair(10)
    cov = np.tile(np.diag([1e-4, 4e-4, 9e-4, 0.01, 0.04, 0.09]), (POSES, 1, 1))
    quarter = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    rotated = Trajectory(
        estimate.time, np.tile(quarter, (POSES, 1, 1)), estimate.position_world, pose_cov=cov
    )
    errors = trajectory_errors(rotated, truth)
    assert errors.position_sigma_world is not None
    assert errors.attitude_sigma_body is not None
    np.testing.assert_allclose(errors.position_sigma_world[7], [0.2, 0.1, 0.3], rtol=1e-9)  # m
    np.testing.assert_allclose(errors.attitude_sigma_body[7], [0.01, 0.02, 0.03], rtol=1e-9)  # rad
