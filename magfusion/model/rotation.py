"""Rotation matrices, any number at once: of and to rotation vectors and quaternions.

SciPy's `Rotation` does the same, but it lies beside Delaunay's triangles and trees of neighbours:
to import it is a twentieth of every start.
"""

import gtsam
import numpy as np

from magfusion.model.quaternion import matrices, of_matrices, of_vectors, vectors
from magfusion.units import Array


def rotations_of(vector: Array) -> Array:
    """Return the matrices, shape (..., 3, 3), of rotation vectors, shape (..., 3) (rad)."""
    return matrices(of_vectors(vector.reshape(-1, 3).T)).reshape(*vector.shape, 3)


def vectors_of(rotation: Array) -> Array:
    """Return the rotation vectors, shape (..., 3) (rad), of matrices, shape (..., 3, 3)."""
    found = vectors(of_matrices(rotation.reshape(-1, 3, 3)))
    return np.ascontiguousarray(found.T).reshape(rotation.shape[:-1])


def angles_of(rotation: Array) -> Array:
    """Return the angles, shape (...) (rad), by which matrices, shape (..., 3, 3), turn."""
    quaternion = of_matrices(rotation.reshape(-1, 3, 3))
    sine = np.sqrt(np.sum(quaternion[1:] ** 2, axis=0))
    return 2.0 * np.arctan2(sine, np.abs(quaternion[0])).reshape(rotation.shape[:-2])


def quaternions_of(rotation: Array) -> Array:
    """Return the quaternions, shape (..., 4), scalar last, of matrices, shape (..., 3, 3)."""
    found = of_matrices(rotation.reshape(-1, 3, 3))[[1, 2, 3, 0]]
    return np.ascontiguousarray(found.T).reshape(*rotation.shape[:-2], 4)


def of_quaternions(quaternion: Array) -> Array:
    """Return the matrices, shape (n, 3, 3), of quaternions of any length, (n, 4), scalar last."""
    turn = quaternion.T[[3, 0, 1, 2]]
    return matrices(turn / np.sqrt(np.sum(turn**2, axis=0)))


def mean_rotation(rotation: Array) -> Array:
    """Return the matrix to which those of shape (n, 3, 3) are nearest, element by element."""
    return np.asarray(gtsam.Rot3.ClosestTo(rotation.sum(axis=0)).matrix())


def slerp(time: Array, rotation: Array, wanted: Array) -> Array:
    """Return the matrices at other times, at a constant rate from each to the next.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s), increasing, n > 1.
    rotation : ndarray, shape (n, 3, 3)
    wanted : ndarray, shape (m,)
        (s), between the first time and the last.

    Returns
    -------
    ndarray, shape (m, 3, 3)
    """
    before = np.maximum(np.searchsorted(time, wanted) - 1, 0)
    share = (wanted - time[before]) / (time[before + 1] - time[before])
    start = rotation[before]
    turn = vectors_of(np.swapaxes(start, 1, 2) @ rotation[before + 1])
    return np.asarray(start @ rotations_of(share[:, None] * turn))
