"""Exact position of a sensor of known attitude about one rotating beacon, which paper 004 lacks."""

from dataclasses import dataclass

import numpy as np

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
