"""Products of many rotations at once, and vectors turned by them, on arrays.

SciPy's `Rotation` converts fast but multiplies one by one; here the components are the first axis,
so that each operation is one over all rotations.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.units import Array


def product(a: Array, b: Array) -> Array:
    """Return the products ``a b`` of quaternions, shape (4, ...), scalar first."""
    (p, q, r, s), (w, x, y, z) = a, b
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[0] = p * w - q * x - r * y - s * z
    out[1] = p * x + q * w + r * z - s * y
    out[2] = p * y - q * z + r * w + s * x
    out[3] = p * z + q * y - r * x + s * w
    return out


def turned(quaternion: Array, vector: Array) -> Array:
    """Return vectors, shape (3, ...), turned by unit quaternions, shape (4, ...)."""
    lever = 2.0 * cross(quaternion[1:], vector)
    return np.asarray(vector + quaternion[0] * lever + cross(quaternion[1:], lever))


def cross(a: Array, b: Array) -> Array:
    """Return the cross products of vectors, shape (3, ...)."""
    (p, q, r), (x, y, z) = a, b
    return np.stack([q * z - r * y, r * x - p * z, p * y - q * x])


def components(rotation: Rotation) -> Array:
    """Return the quaternions of rotations, shape (4, n), scalar first; (4, 1) of a single one."""
    return np.ascontiguousarray(np.atleast_2d(rotation.as_quat(scalar_first=True)).T)


def inverse(quaternion: Array) -> Array:
    """Return the inverse of unit quaternions, shape (4, ...), scalar first."""
    return np.concatenate([quaternion[:1], -quaternion[1:]])


def of_vectors(rotation: Array) -> Array:
    """Return the quaternions, shape (4, ...), of rotation vectors, shape (3, ...) (rad)."""
    half = 0.5 * np.sqrt(np.sum(rotation**2, axis=0))
    return np.concatenate([np.cos(half)[None], 0.5 * np.sinc(half / np.pi) * rotation])


def matrices(quaternion: Array) -> Array:
    """Return the matrices, shape (n, 3, 3), of unit quaternions, shape (4, n), scalar first."""
    w, x, y, z = quaternion
    out = np.empty((len(w), 3, 3))
    out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = (
        1.0 - 2.0 * (y * y + z * z),
        1.0 - 2.0 * (x * x + z * z),
        1.0 - 2.0 * (x * x + y * y),
    )
    for i, j, product, turn in ((0, 1, x * y, w * z), (2, 0, x * z, w * y), (1, 2, y * z, w * x)):
        out[:, i, j], out[:, j, i] = 2.0 * (product - turn), 2.0 * (product + turn)
    return out


def of_matrices(rotation: Array) -> Array:
    """Return the quaternions, shape (4, n), scalar first, of rotation matrices, shape (n, 3, 3).

    By the largest component: of the other way to write it, none is lost in rounding.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(rotation, 0, -1)
    trace = a + e + i
    largest = np.argmax([trace, a, e, i], axis=0)
    own = np.array(
        [
            [1.0 + trace, h - f, c - g, d - b],
            [h - f, 1.0 - trace + 2.0 * a, b + d, c + g],
            [c - g, b + d, 1.0 - trace + 2.0 * e, f + h],
            [d - b, c + g, f + h, 1.0 - trace + 2.0 * i],
        ]
    )
    return unit(own[largest, :, np.arange(len(trace))].T)


def unit(quaternion: Array) -> Array:
    """Return quaternions, shape (4, ...), without what rounding adds to their length."""
    return quaternion / np.sqrt(np.sum(quaternion**2, axis=0))
