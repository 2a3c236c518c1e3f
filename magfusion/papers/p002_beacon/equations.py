"""Paper 002, equation by equation: centre and attitude of a rotating beacon from magnetometers.

In the source every equation is a picture: this module follows the surrounding text, its references
by number, and paper 004 of the same authors.  Directions (..., magnetometers, 3)
point from the beacon to the magnetometers, angles (..., 3) are psi, gamma, lambda (rad).
"""

from itertools import combinations

import numpy as np

from magfusion.model.physics.dipole import dipole_field
from magfusion.model.physics.solenoid import solenoid_field
from magfusion.model.physics.winding import wound_coil
from magfusion.papers.p004_fingerprints import equations as p004
from magfusion.units import Array, IntArray

NOT_FUNCTIONS = {
    5: "defines the offset of the centre from where the beacon's shape has it",
    6: "defines the attitude: axes of the field = C_0^m axes of the shape",
    14: "states that C_0^m is orthogonal, as the C of Eq 7 is and that of Eq 19 is not",
    15: "step to Eq 17: the products of pseudo-directions by Eq 13",
    16: "step to Eq 17: the angles between them are those of the directions",
    17: "concludes that the centre does not depend on the attitude; as read, 0.2 m for each degree",
    20: "names the matrices of Eq 19, whose columns are the directions of Eq 13 and 18",
    22: "assumes pseudo-directions with errors of mean zero, as they are to first order",
    23: "step to Eq 26: the error of the matrix of Eq 19, of that of the directions",
    24: "step to Eq 26: its mean",
    25: "step to Eq 26; as read, T contains the errors of the estimated centre",
    26: "concludes that Eq 19 has no bias; as read, 7 mm of the centre at 5 % noise",
    27: "step to Eq 30: the sine of a small error is the error",
    28: "step to Eq 30: element (3, 1) of the matrix as a function of psi and its error",
    29: "step to Eq 30: names the variance of element (3, 1)",
}

eq_01_field = dipole_field
"""Unclear; by the text the field of a dipole."""

eq_02_field = solenoid_field
"""Unclear: a coil in place of rows and columns of turns; here that of Biot and Savart."""

eq_03_equivalent_coil = wound_coil
"""Unclear; here the coil with the dipole of all rows and columns, and the next term."""


eq_04_direction = p004.eq_07_direction
"""Unclear; read as Eq 7 of paper 004, of normals in the beacon's axes, z > 0."""

eq_07_attitude = p004.eq_20_attitude
"""Unclear; read as ``Rz(gamma) Ry(psi) Rx(lambda)``."""

eq_08_direction = p004.eq_02_direction
"""Unclear; read as Eq 2 of paper 004."""


def pairs(count: int) -> tuple[IntArray, IntArray]:
    """Return first and second of all pairs of magnetometers, each (pairs,)."""
    first, second = np.array(list(combinations(range(count), 2))).T
    return first, second


def eq_09_cosines(direction: Array) -> Array:
    """Return the cosines of angles between directions, shape (..., pairs).  Unclear."""
    first, second = pairs(direction.shape[-2])
    return np.einsum("...pi,...pi->...p", direction[..., first, :], direction[..., second, :])


def eq_10_lengths(position_world: Array) -> Array:
    """Return the distances between magnetometers (m), shape (pairs,).  Unclear."""
    first, second = pairs(len(position_world))
    return np.linalg.norm(position_world[first] - position_world[second], axis=-1)


def eq_11_misfit(distance: Array, cosine: Array, length: Array) -> Array:
    """Return the residual of the law of cosines (m^2), shape (..., pairs).

    Unclear; as read, up to four sets of distances (..., magnetometers) (m) fit three magnetometers.
    """
    first, second = pairs(distance.shape[-1])
    a, b = distance[..., first], distance[..., second]
    return a**2 + b**2 - 2.0 * a * b * cosine - length**2


eq_12_misfit = p004.eq_17_misfit
"""Unclear; read as least squares; magnetometers in one plane leave two mirror centres."""

eq_13_pseudo_direction = p004.eq_18_pseudo_direction_as_printed
"""Unclear; read as Eq 18 of paper 004."""


def eq_18_direction(centre_world: Array, position_world: Array) -> Array:
    """Return the directions from a centre (..., 3) to the magnetometers.  Unclear."""
    return -p004.eq_19_direction(centre_world, position_world)


eq_19_attitude = p004.eq_21_attitude_as_printed
"""Unclear; read as Eq 21 of paper 004: no rotation, and blind to rotation about the axis."""

eq_21_angles = p004.eq_23_angles
"""Unclear; read as Eq 23 of paper 004.  Eq 30-32 imply arccosines, which lose the signs."""


def eq_30_variance_of_psi(world_from_beacon: Array, variance: Array) -> Array:
    """Return the variance (rad^2) of psi.  Unclear; of the elements' (3, 3), by an arcsine."""
    return variance[..., 2, 0] / _upright(world_from_beacon)


def eq_31_variance_of_lambda(world_from_beacon: Array, variance: Array) -> Array:
    """Return the variance (rad^2) of lambda by the arccosine.

    Unclear; read as that of an arccosine, hence without bound at ``cos lambda = 1``.
    """
    lamda = eq_21_angles(world_from_beacon)[..., 2]
    return variance[..., 2, 2] / (_upright(world_from_beacon) * np.sin(lamda) ** 2)


def eq_32_variance_of_gamma(world_from_beacon: Array, variance: Array) -> Array:
    """Return the variance (rad^2) of gamma by the arccosine.  Unclear, as Eq 31."""
    gamma = eq_21_angles(world_from_beacon)[..., 1]
    return variance[..., 0, 0] / (_upright(world_from_beacon) * np.sin(gamma) ** 2)


def _upright(world_from_beacon: Array) -> Array:
    return np.cos(eq_21_angles(world_from_beacon)[..., 0]) ** 2


def eq_33_geometric_centre(corner_world: Array) -> Array:
    """Return the mean of the corners (8, 3) of the beacon's box (m).

    Unclear; by the text the centre of the shape, not of the field.
    """
    return corner_world.mean(axis=0)
