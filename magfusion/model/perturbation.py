"""Building blocks of derivatives by a small rotation and by the entries of a matrix."""

from typing import overload

import numpy as np

from magfusion.units import Array, ComplexArray


@overload
def skew(vector: Array) -> Array: ...
@overload
def skew(vector: ComplexArray) -> ComplexArray: ...
def skew(vector: Array | ComplexArray) -> Array | ComplexArray:
    """Return the matrix of the cross product, shape (..., 3, 3), of vectors (..., 3)."""
    matrix = np.zeros((*vector.shape, 3), dtype=vector.dtype)
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -z, y, -x
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = z, -y, x
    return matrix


@overload
def by_matrix(field_sensor: Array) -> Array: ...
@overload
def by_matrix(field_sensor: ComplexArray) -> ComplexArray: ...
def by_matrix(field_sensor: Array | ComplexArray) -> Array | ComplexArray:
    """Return the derivative of ``matrix @ field_sensor`` by the matrix, shape (..., 3, 9)."""
    columns = np.zeros((*field_sensor.shape, 3, 3), dtype=field_sensor.dtype)
    for row in range(3):
        columns[..., row, row, :] = field_sensor
    return columns.reshape(*field_sensor.shape, 9)
