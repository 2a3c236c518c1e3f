"""A truth of any rate is compared with where its motion allows it, and the rest is reported."""

from pathlib import Path

import numpy as np
import pytest
from conftest import run_command

from magfusion.errors import InputError
from magfusion.files.trajectory_table import write_trajectory
from magfusion.files.tum import write_tum
from magfusion.model.trajectory import Trajectory
from magfusion.model.truth_poses import truth_poses
from magfusion.results.errors import trajectory_errors
from magfusion.simulation.demo_site import DEMO_BOX_WORLD, demo_site
from magfusion.simulation.log import SimulationConfig, simulate_log
from magfusion.units import DEGREE


@pytest.fixture(scope="module")
def walked() -> Trajectory:
    """Return the poses of a walk, at the rate of its IMU."""
    config = SimulationConfig(DEMO_BOX_WORLD, duration=30.0)
    truth = simulate_log(demo_site(), config, np.random.default_rng(3)).log.truth
    assert truth is not None
    return _rows(truth, np.arange(len(truth)))


def _rows(poses: Trajectory, rows: np.ndarray) -> Trajectory:
    return Trajectory(poses.time[rows], poses.world_from_body[rows], poses.position_world[rows])


def _at_rate(poses: Trajectory, rate_hz: float) -> Trajectory:
    step = round(1.0 / rate_hz / float(np.median(np.diff(poses.time))))
    return _rows(poses, np.arange(0, len(poses), step))


@pytest.mark.parametrize("rate_hz", [20.0, 10.0, 5.0])
def test_a_slow_truth_is_interpolated_to_a_millimetre(walked: Trajectory, rate_hz: float) -> None:
    slow = _at_rate(walked, rate_hz)
    inside = _rows(walked, np.flatnonzero(walked.time <= slow.time[-1]))
    errors = trajectory_errors(inside, slow)
    assert np.all(errors.compared)
    assert not errors.not_covered
    assert errors.ate < 1e-3  # m
    assert errors.attitude_rmse_deg < 0.05


def test_what_a_truth_of_uneven_steps_covers_is_right(walked: Trajectory) -> None:
    kept = np.sort(np.random.default_rng(1).choice(len(walked), len(walked) // 30, replace=False))
    poses, covered, reason = truth_poses(_rows(walked, kept), walked.time)
    assert 0.5 < np.mean(covered) < 1.0
    assert "moves too much" in reason
    off = np.linalg.norm(poses.position_world - walked.position_world[covered], axis=1)
    assert np.quantile(off, 0.99) < 2e-3  # m


def test_a_motion_too_fast_for_its_truth_is_not_compared(walked: Trajectory) -> None:
    slow = _at_rate(walked, 0.4)
    with pytest.raises(InputError, match=r"moves too much to interpolate to 2 mm and 0\.1 deg"):
        trajectory_errors(_rows(walked, np.arange(3, len(walked), 600)), slow)


def test_a_gap_of_a_truth_is_reported(walked: Trajectory) -> None:
    slow = _at_rate(walked, 5.0)
    cut = _rows(slow, np.flatnonzero((slow.time < 10.0) | (slow.time > 14.0)))
    errors = trajectory_errors(walked, cut)
    missing = walked.time[~errors.compared]
    assert np.all((missing > 9.7) & (missing < 14.3) | (missing > slow.time[-1]))
    assert errors.ate < 1e-3  # m
    assert "in steps of up to" in errors.not_covered
    assert "outside of its" in errors.not_covered


def test_at_rest_a_truth_may_have_any_rate() -> None:
    time = np.arange(0.0, 60.0, 10.0)
    attitude = np.tile(np.eye(3), (len(time), 1, 1))
    still = Trajectory(time, attitude, np.ones((len(time), 3)))
    poses, covered, reason = truth_poses(still, np.arange(0.0, 50.0, 0.3))
    assert np.all(covered)
    assert not reason
    np.testing.assert_allclose(poses.position_world, 1.0, atol=1e-12)


def test_a_turn_is_interpolated_as_a_rotation() -> None:
    """Two rotations at once, of 1 rad/s: at 5 Hz the chord would miss 0.3 deg."""

    def turned(time: np.ndarray) -> Trajectory:
        from scipy.spatial.transform import Rotation

        first = Rotation.from_rotvec(np.outer(time, [0.0, 0.0, 1.0]))
        second = Rotation.from_rotvec(np.outer(np.sin(time), [1.0, 0.0, 0.0]))
        return Trajectory(time, (first * second).as_matrix(), np.zeros((len(time), 3)))

    wanted = np.arange(0.5, 9.0, 0.01)
    errors = trajectory_errors(turned(wanted), turned(np.arange(0.0, 10.0, 0.2)))
    assert np.all(errors.compared)
    assert np.max(errors.attitude) < 0.03 * DEGREE


def test_evaluate_reads_a_slow_truth_and_reports_what_it_lacks(
    walked: Trajectory, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    estimate = _rows(walked, np.arange(5, len(walked), 40))
    write_trajectory(estimate, tmp_path / "estimate.parquet", 0)
    slow = _at_rate(walked, 5.0)
    write_tum(_rows(slow, np.arange(len(slow) // 2)), tmp_path / "truth.tum", 0)
    run_command("evaluate", tmp_path / "estimate.parquet", tmp_path / "truth.tum")
    shown = capfd.readouterr().out
    assert "compared epochs" in shown
    assert "The truth does not cover" in shown
