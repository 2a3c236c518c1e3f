"""Errors and sigmas by axis, and the part of the frame in them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magfusion.model.trajectory import Trajectory
from magfusion.results.axes import Frame, axis_figures
from magfusion.results.errors import trajectory_errors

FRAME = np.array([0.02, -0.03, 0.01])  # m, by which the beacons are shifted
YAW = np.deg2rad(0.5)


def poses(seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(
        time=np.arange(40.0),
        world_from_body=Rotation.random(40, random_state=1).as_matrix(),
        position_world=rng.uniform(-3.0, 3.0, (40, 3)),
    )


def moved(truth: Trajectory, shift: np.ndarray, yaw: float, cov: np.ndarray) -> Trajectory:
    turn = Rotation.from_euler("z", yaw)
    return Trajectory(
        time=truth.time,
        world_from_body=turn.as_matrix() @ truth.world_from_body,
        position_world=turn.apply(truth.position_world) + shift,
        pose_cov=np.broadcast_to(cov, (len(truth), 6, 6)),
    )


def test_an_error_of_the_frame_alone_is_removed_with_the_frame() -> None:
    truth, sigma = poses(), np.diag([1e-2] * 3 + [0.1] * 3)
    estimate = moved(truth, FRAME, YAW, sigma**2)
    frame = Frame(np.diag([0.03**2] * 3 + [1e-3**2]), 0.03)
    figures = axis_figures(estimate, trajectory_errors(estimate, truth), frame)
    assert figures["error_yaw_deg"] == pytest.approx(0.5, rel=1e-3)
    assert figures["error_z_m"] == pytest.approx(0.01)
    for axis in "xyz":
        assert figures[f"frame_removed_error_{axis}_m"] < 2e-4  # m, of second order in the yaw
    assert figures["frame_removed_error_yaw_deg"] < 0.01


def test_the_variances_of_frame_and_rest_add_up_to_the_whole() -> None:
    truth = poses()
    estimate = moved(truth, FRAME, YAW, np.diag([1e-2] * 3 + [0.05] * 3) ** 2)
    figures = axis_figures(estimate, None, Frame(np.diag([0.03**2] * 3 + [2e-3**2]), 0.03))
    radius = np.mean(truth.position_world[:, 1] ** 2)
    assert figures["frame_sigma_x_m"] == pytest.approx(np.sqrt(0.03**2 + 4e-6 * radius), rel=0.03)
    assert figures["frame_sigma_z_m"] == pytest.approx(0.03)
    assert figures["frame_sigma_rot_x_deg"] == 0.0
    for axis in ("x_m", "y_m", "z_m", "yaw_deg"):
        parts = [figures[f"{row}_{axis}"] for row in ("frame_sigma", "frame_removed_sigma")]
        assert np.hypot(*parts) == pytest.approx(figures[f"sigma_{axis}"])


def test_a_frame_that_other_sensors_determine_is_not_shown() -> None:
    estimate = moved(poses(), FRAME, YAW, np.diag([1e-2] * 3 + [0.01] * 3) ** 2)
    figures = axis_figures(estimate, None, Frame(np.diag([0.03**2] * 3 + [1e-6]), 0.03))
    assert "frame_sigma_x_m" not in figures
    assert figures["sigma_x_m"] == pytest.approx(0.01)


def test_the_axes_are_those_of_the_world() -> None:
    """A sigma about the body's x axis is one of yaw where this axis is vertical."""
    upright = Rotation.from_euler("y", -90.0, degrees=True).as_matrix()
    states = Trajectory(
        time=np.arange(3.0),
        world_from_body=np.broadcast_to(upright, (3, 3, 3)),
        position_world=np.zeros((3, 3)),
        pose_cov=np.broadcast_to(np.diag([1.0, 0.1, 0.1, 1.0, 2.0, 3.0]) ** 2, (3, 6, 6)),
    )
    figures = axis_figures(states, None)
    assert np.deg2rad(figures["sigma_yaw_deg"]) == pytest.approx(1.0)
    assert figures["sigma_z_m"] == pytest.approx(1.0)
    assert figures["sigma_x_m"] == pytest.approx(3.0)
