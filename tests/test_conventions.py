"""Facts of the libraries on which the conventions of the package rest.

An upgrade that changes one of them fails here, by name, and not somewhere as a wrong trajectory.
"""

import gtsam
import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

GRAVITY = 9.81  # m/s^2


def _random_pose(rng: np.random.Generator) -> gtsam.Pose3:
    rotation = Rotation.random(random_state=rng).as_matrix()
    return gtsam.Pose3(gtsam.Rot3(rotation), rng.standard_normal(3))


def test_pose3_perturbs_rotation_then_translation_in_body_axes() -> None:
    pose = _random_pose(np.random.default_rng(1))
    rotated = pose.retract(np.array([0.01, -0.02, 0.03, 0.0, 0.0, 0.0]))
    relative = Rotation.from_matrix(pose.rotation().matrix().T @ rotated.rotation().matrix())
    np.testing.assert_allclose(relative.as_rotvec(), [0.01, -0.02, 0.03], rtol=1e-10)
    np.testing.assert_allclose(rotated.translation(), pose.translation(), rtol=1e-12)
    moved = pose.retract(np.array([0.0, 0.0, 0.0, 0.4, 0.5, -0.6]))
    shift_body = pose.rotation().matrix().T @ (moved.translation() - pose.translation())
    np.testing.assert_allclose(shift_body, [0.4, 0.5, -0.6], rtol=1e-10)


def test_pose3_retract_composes_with_the_exponential() -> None:
    rng = np.random.default_rng(2)
    pose, step = _random_pose(rng), rng.standard_normal(6)
    expected = pose.compose(gtsam.Pose3.Expmap(step)).matrix()
    np.testing.assert_allclose(pose.retract(step).matrix(), expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(pose.localCoordinates(pose.retract(step)), step, rtol=1e-9)


def test_navstate_perturbs_rotation_position_velocity_in_body_axes() -> None:
    pose = _random_pose(np.random.default_rng(3))
    state = gtsam.NavState(pose, np.array([4.0, 5.0, 6.0]))
    step = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    moved = state.retract(step)
    body_from_world = pose.rotation().matrix().T
    turn = Rotation.from_matrix(body_from_world @ moved.attitude().matrix()).as_rotvec()
    np.testing.assert_allclose(turn, step[:3], rtol=1e-10)
    shift = body_from_world @ (moved.position() - state.position())
    np.testing.assert_allclose(shift, step[3:6], rtol=1e-10)
    gain = body_from_world @ (moved.velocity() - state.velocity())
    np.testing.assert_allclose(gain, step[6:], rtol=1e-10)


def test_imu_bias_is_accelerometer_then_gyroscope() -> None:
    bias = gtsam.imuBias.ConstantBias(np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))
    np.testing.assert_array_equal(bias.vector(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    np.testing.assert_array_equal(bias.accelerometer(), [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(bias.gyroscope(), [4.0, 5.0, 6.0])


def test_quaternions_of_gtsam_are_read_by_name_and_those_of_scipy_are_xyzw() -> None:
    rotations = Rotation.random(2, random_state=np.random.default_rng(4))
    for rotation in rotations:
        named = gtsam.Rot3(rotation.as_matrix()).toQuaternion()
        xyzw = np.array([named.x(), named.y(), named.z(), named.w()])
        assert abs(xyzw @ rotation.as_quat()) == pytest.approx(1.0, abs=1e-14)
        assert abs(named.w()) == pytest.approx(np.cos(0.5 * rotation.magnitude()), rel=1e-9)
        np.testing.assert_array_equal(rotation.as_quat(scalar_first=True)[0], rotation.as_quat()[3])


def _preintegrate(
    accel: np.ndarray, gyro: np.ndarray, duration: float, steps: int
) -> gtsam.NavState:
    parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    measurement = gtsam.PreintegratedCombinedMeasurementsG(parameters)
    for _ in range(steps):
        measurement.integrateMeasurement(accel, gyro, duration / steps)
    return measurement.predict(gtsam.NavState(), gtsam.imuBias.ConstantBias())


def test_a_level_imu_that_feels_gravity_upwards_stays_at_rest() -> None:
    state = _preintegrate(np.array([0.0, 0.0, GRAVITY]), np.zeros(3), 10.0, 1000)
    np.testing.assert_allclose(state.position(), 0.0, atol=1e-10)  # m
    np.testing.assert_allclose(state.velocity(), 0.0, atol=1e-11)  # m/s
    np.testing.assert_allclose(state.attitude().matrix(), np.eye(3), atol=1e-14)


@pytest.mark.parametrize("turns", [0.25, 1.0, 1.5])
def test_preintegration_on_the_group_holds_through_a_full_turn(turns: float) -> None:
    duration = 10.0  # s
    rate = 2.0 * np.pi * turns / duration * np.array([0.3, -0.5, 0.8]) / np.sqrt(0.98)
    accel = np.array([0.5, 0.2, GRAVITY])
    state = _preintegrate(accel, rate, duration, 2000)

    def moved(time: float) -> np.ndarray:
        world_accel = Rotation.from_rotvec(rate * time).apply(accel) - [0.0, 0.0, GRAVITY]
        return world_accel * (duration - time)

    expected, _ = quad_vec(moved, 0.0, duration, epsabs=1e-12)
    turn = Rotation.from_rotvec(rate * duration).as_matrix()
    np.testing.assert_allclose(state.attitude().matrix(), turn, atol=1e-12)
    np.testing.assert_allclose(state.position(), expected, atol=1e-8)  # m


def test_the_matrices_of_a_jacobian_factor_are_writable_views() -> None:
    noise = gtsam.noiseModel.Unit.Create(2)
    factor = gtsam.JacobianFactor(1, np.eye(2, 3), 2, np.ones((2, 2)), np.zeros(2), noise)
    factor.getA()[0, 0] = 7.0
    factor.getb()[:] = 3.0
    expected = [[7.0, 0.0, 0.0, 1.0, 1.0], [0.0, 1.0, 0.0, 1.0, 1.0]]
    np.testing.assert_array_equal(factor.getA(), expected)
    at_zero = gtsam.VectorValues()
    at_zero.insert(1, np.zeros(3))
    at_zero.insert(2, np.zeros(2))
    assert factor.error(at_zero) == pytest.approx(0.5 * (3.0**2 + 3.0**2))
