"""Steel in few places: the variances of voxels, estimated from the amplitudes of their modes.

Each voxel has a variance of its own, besides one that all share, of largest evidence: most vanish
(sparse Bayesian learning, M. E. Tipping, J. Mach. Learn. Res. 1, 2001; the fixed point is that of
D. J. C. MacKay, Neural Comput. 4, 1992).  With the same variance for all, what explains the fields
of one beacon spreads over voxels where it has no part in those of the others.  All that the data
determine of voxels they determine of the modes, so that no other derivatives are needed.
"""

import numpy as np
from scipy.linalg import cho_solve, eigh, solve_triangular

from magfusion.estimation.measurements.steel import SteelBasis, beacon_fields, unit_moments
from magfusion.model.site import Site
from magfusion.units import Array

ROUNDS = 10  # of the fixed point; more change the evidence by less than one
NEGLIGIBLE = 1e-9  # of the largest variance, and of the strongest mode


def voxel_variances(basis: SteelBasis, information: Array, gradient: Array, sigma: float) -> Array:
    """Return the most probable variance of each voxel, of unit amplitudes of the modes, (v,).

    `information`, `gradient` (shared, shared), (shared,): of the amplitudes of the shared modes,
    all others eliminated. `sigma`: of these amplitudes, from which it is sought: all voxels have
    the same variance.
    """
    by_mode = basis.tensor / basis.unit
    value, vector = eigh(information)
    root = vector * np.sqrt(np.maximum(value, 0.0))
    common, own = 0.5 * sigma**2, np.full(len(by_mode), 0.5 * sigma**2)
    for _ in range(ROUNDS):
        kept = np.flatnonzero(own > NEGLIGIBLE * np.max(own))
        flat = by_mode[kept].reshape(-1, basis.shared)
        prior = common * np.eye(basis.shared) + flat.T @ (np.repeat(own[kept], 6)[:, None] * flat)
        chol = np.linalg.cholesky(np.eye(basis.shared) + root.T @ prior @ root)
        step = gradient - root @ cho_solve((chol, True), root.T @ (prior @ gradient))
        by_root = solve_triangular(chol, root.T, lower=True)
        # Of the gradient by each voxel: its square, over that which these variances make expected.
        measured = np.sum((flat @ step).reshape(-1, 6) ** 2, axis=1)
        own[kept] *= measured / np.sum((flat @ by_root.T).reshape(len(kept), -1) ** 2, axis=1)
        common *= float(step @ step / np.sum(by_root**2))
    return common + own


def with_variances(basis: SteelBasis, site: Site, variance: Array) -> tuple[SteelBasis, Array]:
    """Return a basis whose shared modes have other variances of the voxels.

    `variance` (v,): as of `voxel_variances`. Returns the basis of amplitudes of unit variance,
    without modes that the basis did not know; `old_by_new` (shared, fewer): amplitudes of the
    shared modes by a unit of each.
    """
    by_mode = basis.tensor / basis.unit
    of_all = variance[:, None, None] * by_mode
    value, vector = eigh(np.tensordot(by_mode, of_all, axes=((0, 1), (0, 1))))
    known = value > NEGLIGIBLE * value[-1]
    strength, vector = np.sqrt(value[known]), vector[:, known]
    tensor = basis.unit * of_all @ (vector / strength)
    at_voxels = beacon_fields(site, basis.voxels.centre_world)
    shared = unit_moments(basis.voxels, at_voxels) @ tensor[:, None]
    moment = np.concatenate([shared, basis.moment[..., basis.shared :]], axis=-1)
    strength_there = np.linalg.norm(at_voxels, axis=2)[..., None, None]
    new = basis._replace(moment=moment, polarisability=moment / strength_there, tensor=tensor)
    return new, vector * strength
