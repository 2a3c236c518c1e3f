"""The field of a magnetic dipole and its gradient."""

import numpy as np

from magfusion.units import MU0_OVER_4PI, Array

_UNIT = np.eye(3)


def dipole_field(offset: Array, moment: Array) -> Array:
    """Return the flux density of a dipole, in the axes of its arguments.

    Parameters
    ----------
    offset : ndarray, shape (..., 3)
        From the dipole to the point of interest (m). Must not be zero.
    moment : ndarray, shape (..., 3)
        Dipole moment (A m^2).

    Returns
    -------
    ndarray, shape (..., 3)
        Flux density (T): ``(mu0/4pi) (3 n (n . m) - m) / r^3``, n the direction of offset (paper
        004, Eq 1).
    """
    square = np.einsum("...i,...i", offset, offset)[..., None]
    along = np.einsum("...i,...i", offset, moment)[..., None]
    return MU0_OVER_4PI * (3.0 * offset * along / square - moment) / square**1.5


def dipole_field_and_gradient(offset: Array, moment: Array) -> tuple[Array, Array]:
    """Return the dipole field and its gradient: ``[i, j] = d field_i / d offset_j``.

    `offset`, `moment` (..., 3): as in `dipole_field` (m, A m^2). Returns `field` (..., 3) (T);
    `gradient` (..., 3, 3) (T/m); symmetric and trace-free, as the field has neither curl nor
    divergence.
    """
    square = np.einsum("...i,...i", offset, offset)[..., None]
    along = np.einsum("...i,...i", offset, moment)[..., None]
    cube = square**1.5
    field = MU0_OVER_4PI * (3.0 * offset * along / square - moment) / cube
    outer = offset[..., :, None] * moment[..., None, :]
    radial = offset[..., :, None] * offset[..., None, :]
    fifth, along = (square * cube)[..., None], along[..., None]
    bracket = outer + np.swapaxes(outer, -1, -2)
    bracket += along * (_UNIT - 5.0 * radial / square[..., None])
    return field, 3.0 * MU0_OVER_4PI * bracket / fifth


def dipole_field_along(offset: Array, moment: Array, along: Array) -> Array:
    """Return the derivative of the dipole field along displacements, without its full gradient.

    `offset`, `moment` (..., 3): as in `dipole_field` (m, A m^2). `along` (..., 3): of the point, or
    its velocity (m, m/s). Returns (..., 3) (T, T/s).
    """
    square = np.einsum("...i,...i", offset, offset)[..., None]
    by_moment = np.einsum("...i,...i", offset, moment)[..., None]
    outward = np.einsum("...i,...i", offset, along)[..., None]
    across = np.einsum("...i,...i", moment, along)[..., None]
    radial = across - 5.0 * by_moment * outward / square
    bracket = along * by_moment + moment * outward + offset * radial
    return np.asarray(3.0 * MU0_OVER_4PI * bracket / square**2.5)
