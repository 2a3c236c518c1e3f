"""Rotation matrices of many at once against SciPy's, one by one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from magfusion.model.rotation import (
    angles_of,
    mean_rotation,
    of_quaternions,
    quaternions_of,
    rotations_of,
    slerp,
    vectors_of,
)

CLOSE = 1e-14


def turns(count: int = 200) -> Rotation:
    """Return turns of every size, a few of them none, tiny, and half a turn."""
    rng = np.random.default_rng(5)
    axis = rng.standard_normal((count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = rng.uniform(0.0, np.pi, count)
    angle[:4] = 0.0, 1e-9, 1e-200, np.pi - 1e-7
    return Rotation.from_rotvec(axis * angle[:, None])


@pytest.mark.parametrize("shape", [(3,), (1, 3), (200, 3), (4, 50, 3)])
def test_vectors_and_matrices_are_made_of_each_other(shape: tuple[int, ...]) -> None:
    vector = turns().as_rotvec().reshape(-1)[-int(np.prod(shape)) :].reshape(shape)
    matrix = rotations_of(vector)
    expected = Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix()
    assert matrix.shape == (*shape, 3)
    np.testing.assert_allclose(matrix.reshape(-1, 3, 3), expected, rtol=0, atol=CLOSE)
    np.testing.assert_allclose(vectors_of(matrix), vector, rtol=0, atol=1e-8 * np.pi)
    size = np.linalg.norm(vector, axis=-1)
    np.testing.assert_allclose(angles_of(matrix), size, rtol=0, atol=1e-8 * np.pi)


def test_what_is_left_of_a_rotation_is_as_scipy_says() -> None:
    matrix = turns().as_matrix()
    expected = Rotation.from_matrix(matrix)
    np.testing.assert_allclose(vectors_of(matrix), expected.as_rotvec(), rtol=0, atol=CLOSE)
    np.testing.assert_allclose(angles_of(matrix), expected.magnitude(), rtol=0, atol=CLOSE)
    quaternion = quaternions_of(matrix)
    back = Rotation.from_quat(quaternion).as_matrix()
    np.testing.assert_allclose(back, matrix, rtol=0, atol=CLOSE)
    np.testing.assert_allclose(of_quaternions(-3.0 * quaternion), matrix, rtol=0, atol=CLOSE)
    assert quaternions_of(matrix[7]) == pytest.approx(quaternion[7], abs=0.0)


def test_between_two_rotations_is_a_share_of_their_turn() -> None:
    known, time = turns(20), np.arange(20.0)
    wanted = np.array([0.0, 0.3, 1.0, 7.9, 18.5, 19.0])
    expected = Slerp(time, known)(wanted).as_matrix()
    np.testing.assert_allclose(slerp(time, known.as_matrix(), wanted), expected, atol=CLOSE)


def test_the_mean_is_the_one_by_quaternions() -> None:
    about = Rotation.from_rotvec(0.4 * turns(30).as_rotvec()) * turns(40)[9]
    found = mean_rotation(about.as_matrix())
    np.testing.assert_allclose(found, about.mean().as_matrix(), rtol=0, atol=1e-13)
