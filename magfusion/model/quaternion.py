"""Products of many rotations at once, and vectors turned by them, on arrays.

SciPy's `Rotation` converts fast but multiplies one by one; here the components are the first axis,
so that each operation is one over all rotations.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.units import Array


def product(a: Array, b: Array) -> Array:
    """Return the products ``a b`` of quaternions, shape (4, ...), scalar first."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[0] = a[0] * b[0] - np.sum(a[1:] * b[1:], axis=0)
    out[1:] = a[0] * b[1:] + b[0] * a[1:] + cross(a[1:], b[1:])
    return out


def turned(quaternion: Array, vector: Array) -> Array:
    """Return vectors, shape (3, ...), turned by unit quaternions, shape (4, ...)."""
    lever = 2.0 * cross(quaternion[1:], vector)
    return np.asarray(vector + quaternion[0] * lever + cross(quaternion[1:], lever))


def cross(a: Array, b: Array) -> Array:
    """Return the cross products of vectors, shape (3, ...)."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[i] = a[j] * b[k] - a[k] * b[j]
    return out


def composed(a: Rotation, b: Rotation) -> Rotation:
    """Return the rotations ``a * b``: one and many, or as many of both."""
    both = product(components(a), components(b))
    return Rotation.from_quat(both.T, scalar_first=True)


def components(rotation: Rotation) -> Array:
    """Return the quaternions of rotations, shape (4, n), scalar first; (4, 1) of a single one."""
    return np.ascontiguousarray(np.atleast_2d(rotation.as_quat(scalar_first=True)).T)
