"""Quaternion products and rotation of vectors, vectorised on arrays.

SciPy's `Rotation` converts fast but multiplies one by one.  Here the components are the first axis,
so that each operation applies to all rotations: 25 to 400 times as fast from fifty on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from magfusion.units import Array

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_NO_TURN = np.finfo(np.float64).eps  # rad; equal to its sine
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def product(a: Array, b: Array) -> Array:
    """Return the products ``a b`` of quaternions, shape (4, ...), scalar first."""
    (p, q, r, s), (w, x, y, z) = a, b
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[0] = p * w - q * x - r * y - s * z
    out[1] = p * x + q * w + r * z - s * y
    out[2] = p * y - q * z + r * w + s * x
    out[3] = p * z + q * y - r * x + s * w
    return out


def rotate(quaternion: Array, vector: Array) -> Array:
    """Return vectors, shape (3, ...), rotated by unit quaternions, shape (4, ...)."""
    lever = 2.0 * cross(quaternion[1:], vector)
    return np.asarray(vector + quaternion[0] * lever + cross(quaternion[1:], lever))


def cross(a: Array, b: Array) -> Array:
    """Return the cross products of vectors, shape (3, ...)."""
    result = a.take(_NEXT, axis=0) * b.take(_LAST, axis=0)
    return np.asarray(result - a.take(_LAST, axis=0) * b.take(_NEXT, axis=0))


def components(rotation: Rotation) -> Array:
    """Return the quaternions of rotations, shape (4, n), scalar first; (4, 1) of a single one."""
    return np.ascontiguousarray(np.atleast_2d(rotation.as_quat(scalar_first=True)).T)


def inverse(quaternion: Array) -> Array:
    """Return the inverse of unit quaternions, shape (4, ...), scalar first."""
    return np.concatenate([quaternion[:1], -quaternion[1:]])


def of_vectors(rotation: Array) -> Array:
    """Return the quaternions, shape (4, ...), of rotation vectors, shape (3, ...) (rad)."""
    half = 0.5 * np.sqrt(_square(rotation))
    out = np.empty((4, *half.shape))
    np.cos(half, out=out[0])
    angle = np.pi * (half / np.pi)
    angle[angle == 0.0] = _NO_TURN
    np.multiply(0.5 * (np.sin(angle) / angle), rotation, out=out[1:])
    return out


def vectors(quaternion: Array) -> Array:
    """Return the rotation vectors, shape (3, ...) (rad), of unit quaternions, shape (4, ...)."""
    size = np.sqrt(np.sum(quaternion[1:] ** 2, axis=0))
    # Of the two equivalent quaternions, that of the smaller rotation.
    half = np.arctan2(np.where(quaternion[0] < 0.0, -size, size), np.abs(quaternion[0]))
    return 2.0 * np.where(size > 0.0, half / np.where(size > 0.0, size, 1.0), 1.0) * quaternion[1:]


def matrices(quaternion: Array) -> Array:
    """Return the matrices, shape (n, 3, 3), of unit quaternions, shape (4, n), scalar first."""
    w, x, y, z = quaternion
    out = np.empty((9, len(w)))
    twice_x, twice_y, twice_z = x + x, y + y, z + z
    square_x, square_y, square_z = x * twice_x, y * twice_y, z * twice_z
    np.add(square_y, square_z, out=out[0])
    np.add(square_x, square_z, out=out[4])
    np.add(square_x, square_y, out=out[8])
    np.subtract(1.0, out[::4], out=out[::4])
    for i, j, product, turn in (
        (1, 3, x * twice_y, w * twice_z),
        (6, 2, x * twice_z, w * twice_y),
        (5, 7, y * twice_z, w * twice_x),
    ):
        np.subtract(product, turn, out=out[i])
        np.add(product, turn, out=out[j])
    return np.ascontiguousarray(out.T).reshape(-1, 3, 3)


def of_matrices(rotation: Array) -> Array:
    """Return the quaternions, shape (4, n), scalar first, of rotation matrices, shape (n, 3, 3).

    By the largest component, which avoids loss by rounding.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.transpose(1, 2, 0)
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
    """Normalise quaternions, shape (4, ...)."""
    return quaternion / np.sqrt(_square(quaternion))


def _square(vectors: Array) -> Array:
    """Return the squared lengths of vectors, shape (k, ...)."""
    return np.asarray(np.add.reduce(vectors**2, axis=0))
