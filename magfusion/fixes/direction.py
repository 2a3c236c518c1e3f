"""Direction to, and attitude among, rotating beacons: paper 004 as printed, and what is exact.

Where the attitude is unknown, `magfusion.fixes.candidates.beacon_directions` gives range and four
directions from the Gram matrix of the phasors.  Where it is known, `locate_by_tensor` is exact.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.fixes.candidates import wahba
from magfusion.site import Beacon
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray

# Symmetric matrices without trace, as many as the field of a dipole has degrees of freedom.
_BASIS = np.array(
    [
        [[1, 0, 0], [0, 0, 0], [0, 0, -1]],
        [[0, 0, 0], [0, 1, 0], [0, 0, -1]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ],
    dtype=np.float64,
)


def normal_from_direction(direction_beacon: Array) -> Array:
    """Return the normal ``3 e n - 2 z`` of the field's plane seen in direction n = (u, v, e).

    Paper 004, Eq 5, without its factor: the normal of the phasors is ``mc ms K^2 / r^6`` times it.

    Parameters
    ----------
    direction_beacon : ndarray, shape (..., 3)
        Unit vectors from the beacon, which turns about its z axis.

    Returns
    -------
    ndarray, shape (..., 3)
        Beacon axes; its square is ``4 - 3 e^2``, hence never zero.
    """
    height = direction_beacon[..., 2:]
    return np.asarray(3.0 * height * direction_beacon - [0.0, 0.0, 2.0])


def direction_from_normal(normal_beacon: Array) -> Array:
    """Return the direction whose plane has a normal (paper 004, Eq 6-7, corrected).

    Eq 6 divides by the z component, not by x; with atan2 the polar angle of the normal lies in
    0 to pi, where both branches of Eq 7 are one formula and the azimuth keeps its quadrant.

    Parameters
    ----------
    normal_beacon : ndarray, shape (..., 3)
        Of any length, beacon axes: it means nothing in a sensor's axes unless the sensor is turned
        about z alone (`attitude_as_printed`).

    Returns
    -------
    ndarray, shape (..., 3)
        Unit vectors, beacon axes, in the half-space z >= 0: the opposite direction has the same
        normal.
    """
    x, y, z = np.moveaxis(np.asarray(normal_beacon, dtype=np.float64), -1, 0)
    polar_of_normal = np.arctan2(np.hypot(x, y), z)
    polar = 0.5 * (polar_of_normal - np.arcsin(np.sin(polar_of_normal) / 3.0))
    azimuth = np.arctan2(y, x)
    flat = np.sin(polar)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(polar)], axis=-1)


def attitude_as_printed(direction_sensor: Array, direction_world: Array) -> Array:
    """Solve paper 004, Eq 18-22, as printed, to reproduce the paper; wrong for a tilted sensor.

    Eq 18 takes `direction_from_normal` of a normal in sensor axes for the direction in sensor
    axes.  That function knows the beacon's z axis, so it commutes with turns about that axis only:
    among the points of Table 1 one degree of tilt makes two to three degrees of error.

    Parameters
    ----------
    direction_sensor : ndarray, shape (..., beacons, 3)
        Pseudo-directions, at least three.
    direction_world : ndarray, shape (..., beacons, 3)
        From the beacons to the sensor.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        sensor_from_world by least squares, in general no rotation.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the directions lie exactly in one plane; close to one the matrix means little.
    """
    seen, known = np.swapaxes(direction_sensor, -1, -2), np.swapaxes(direction_world, -1, -2)
    return np.asarray(seen @ direction_world @ np.linalg.inv(known @ direction_world))


def angles_as_printed(sensor_from_world: Array) -> Array:
    """Return the angles psi, gamma, lambda of ``Rz(gamma) Ry(psi) Rx(lambda)`` (paper 004, Eq 23).

    With atan2 for arctan.  No scipy Rotation, because the matrix of Eq 21 is none.

    Parameters
    ----------
    sensor_from_world : ndarray, shape (..., 3, 3)

    Returns
    -------
    ndarray, shape (..., 3)
        (rad)
    """
    c = sensor_from_world
    psi = -np.arcsin(np.clip(c[..., 2, 0], -1.0, 1.0))
    gamma = np.arctan2(c[..., 1, 0], c[..., 0, 0])
    return np.stack([psi, gamma, np.arctan2(c[..., 2, 1], c[..., 2, 2])], axis=-1)


def attitude_from_vectors(
    vector_sensor: Array | ComplexArray, vector_world: Array | ComplexArray
) -> Array:
    """Return the rotation that fits vectors in two axes best (Wahba's problem).

    Of phasors, which both must have the same drive phase, it is the maximum of the likelihood in
    white noise and exact at any attitude; two coils of a single beacon suffice.  Of the directions
    of paper 004, Eq 18-19, it is only the rotation nearest to a wrong equation.

    Parameters
    ----------
    vector_sensor, vector_world : ndarray, real or complex, shape (..., vectors, 3)
        Of any one unit.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        world_from_sensor.
    """
    outer = vector_world[..., :, None] * np.conj(vector_sensor[..., None, :])
    return wahba(np.sum(outer.real, axis=-3))


@dataclass(frozen=True, eq=False)
class TensorFix:
    """Position relative to one beacon.

    Parameters
    ----------
    direction_beacon : ndarray, shape (..., 3)
        Unit vectors in the half-space z >= 0; the opposite direction fits as well.
    distance : ndarray, shape (...)
        (m)
    residual : ndarray, shape (...)
        Norm of what no dipole field explains (T): a test of attitude and drive that is free of
        the position.  Of a beacon of two coils it is ``Bc_y / mc - Bs_x / ms`` but for a factor.
    """

    direction_beacon: Array
    distance: Array
    residual: Array


def locate_by_tensor(beacon: Beacon, phasor_beacon: ComplexArray) -> TensorFix:
    """Locate a sensor of known attitude by completing the tensor of the dipole field.

    The field of a moment m is ``A m``, with ``A = K (3 n n^T - 1) / r^3`` symmetric and without
    trace: two coils determine all of it.  The largest eigenvalue is ``2 K / r^3``, along n.  Unlike
    paper 004, Eq 7, this stays exact near the beacon's plane (at 80 degrees from the axis the
    mean square error is 85 times less).

    Parameters
    ----------
    beacon : Beacon
        With moments along two axes at least, and its declared drive phase.
    phasor_beacon : complex ndarray, shape (..., tones, 3)
        (T), beacon axes.

    Returns
    -------
    TensorFix

    Raises
    ------
    ValueError
        Where all moments lie along one line.
    """
    drive = beacon.moments_beacon.T @ beacon.excitation  # (3, tones)
    moments = np.concatenate([drive.real, drive.imag], axis=1)
    design = np.einsum("kij,jm->mik", _BASIS, moments).reshape(-1, len(_BASIS))
    size = np.linalg.svd(design, compute_uv=False)
    if size[-1] < 1e-6 * size[0]:
        raise ValueError(f"beacon {beacon.name}: one axis does not determine a direction")
    stacked = np.concatenate([phasor_beacon.real, phasor_beacon.imag], axis=-2)
    measured = stacked.reshape(*stacked.shape[:-2], -1)
    found = measured @ np.linalg.pinv(design).T
    power, axes = np.linalg.eigh(np.einsum("...k,kij->...ij", found, _BASIS))
    direction = axes[..., -1]
    direction = np.where(direction[..., 2:] < 0.0, -direction, direction)
    return TensorFix(
        direction_beacon=direction,
        distance=np.asarray(np.cbrt(2.0 * MU0_OVER_4PI / power[..., -1])),
        residual=np.asarray(np.linalg.norm(measured - found @ design.T, axis=-1)),
    )
