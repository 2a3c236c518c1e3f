"""Exact direction to, and attitude among, rotating beacons, which paper 004 lacks.

Where the attitude is unknown, `magfusion.estimation.snapshot.candidates.beacon_directions` gives
range and four directions from the Gram matrix of the phasors.  Where it is known,
`locate_by_tensor` is exact.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.snapshot.candidates import wahba
from magfusion.model.site import Beacon
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


def attitude_from_vectors(
    vector_sensor: Array | ComplexArray, vector_world: Array | ComplexArray
) -> Array:
    """Return the rotation that best fits vectors in two frames (Wahba's problem).

    For phasors, which both must have the same drive phase, it is the maximum of the likelihood in
    white noise and exact at any attitude; two coils of a single beacon suffice.  For the directions
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
        Norm of the residual of any dipole field (T): a position-independent test of attitude and
        drive.  For a beacon of two coils it is ``Bc_y / mc - Bs_x / ms`` up to a factor.
    """

    direction_beacon: Array
    distance: Array
    residual: Array


def locate_by_tensor(beacon: Beacon, phasor_beacon: ComplexArray) -> TensorFix:
    """Locate a sensor of known attitude by completing the tensor of the dipole field.

    The field of a moment m is ``A m``, with ``A = K (3 n n^T - 1) / r^3`` symmetric and traceless:
    two coils determine all of it.  The largest eigenvalue is ``2 K / r^3``, along n.  Unlike paper
    004, Eq 7, this stays exact near the beacon's plane (at 80 degrees from the axis the mean square
    error is 85 times less).

    Parameters
    ----------
    beacon : Beacon
        With moments along at least two axes, and its declared drive phase.
    phasor_beacon : complex ndarray, shape (..., tones, 3)
        (T), beacon axes.

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
    result = measured @ np.linalg.pinv(design).T
    power, axes = np.linalg.eigh(np.einsum("...k,kij->...ij", result, _BASIS))
    direction = axes[..., -1]
    direction = np.where(direction[..., 2:] < 0.0, -direction, direction)
    return TensorFix(
        direction_beacon=direction,
        distance=np.cbrt(2.0 * MU0_OVER_4PI / power[..., -1]),
        residual=np.linalg.norm(measured - result @ design.T, axis=-1),
    )
