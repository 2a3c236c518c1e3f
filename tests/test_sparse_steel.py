"""Steel in few voxels, sought by the evidence of the modes."""

import numpy as np
import pytest

from magfusion.estimation.measurements.sparse_steel import voxel_variances, with_variances
from magfusion.estimation.measurements.steel import SteelBasis, SteelModes, steel_modes
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.simulation.demo_site import demo_site
from magfusion.units import Array

SIGMA = 0.5  # of all modes, from which the search starts
NOISE = 0.01  # of an amplitude
BODIES = 4


@pytest.fixture(scope="module")
def known() -> tuple[Site, SteelBasis, Array]:
    """Site, all modes of a short path, and places of the sensor on it (m)."""
    site, rng = demo_site(coil_radius=None), np.random.default_rng(5)
    place = rng.uniform([2.0, 1.5, 0.8], [4.0, 3.5, 1.6], (12, 3))
    poses = Trajectory(np.arange(12.0), np.broadcast_to(np.eye(3), (12, 3, 3)), place)
    (block,) = steel_modes(site, poses.time, poses, (1000, 2), 12)
    assert isinstance(block.parameter, SteelModes)
    basis = block.parameter.basis
    return site, basis, place + site.platform.magnetometer.position_body


def _orthonormal(basis: SteelBasis) -> Array:
    return basis.tensor / basis.unit


def test_bodies_in_few_voxels_are_sought_where_they_are(
    known: tuple[Site, SteelBasis, Array],
) -> None:
    """The amplitudes are those of four voxels: these, or their neighbours, keep a variance."""
    _, basis, place = known
    rng, voxels = np.random.default_rng(6), basis.voxels
    near = np.linalg.norm(voxels.centre_world[:, None] - place, axis=2).min(axis=1) < 1.0
    bodies = rng.choice(np.flatnonzero(near), BODIES, replace=False)
    tensor = np.zeros((len(near), 6))
    tensor[bodies] = 3.0 * rng.normal(size=(BODIES, 6))
    amplitude = np.tensordot(tensor, _orthonormal(basis), axes=2)
    measured = amplitude + NOISE * rng.normal(size=amplitude.shape)
    information = np.eye(len(amplitude)) / NOISE**2
    variance = voxel_variances(basis, information, information @ measured, SIGMA)
    strongest = np.argsort(variance)[::-1][:BODIES]
    away = voxels.centre_world[strongest][:, None] - voxels.centre_world[bodies]
    assert np.all(np.linalg.norm(away, axis=2).min(axis=1) < 0.6)  # m, of voxels of 0.5 m
    assert np.sum(np.sort(variance)[::-1][:BODIES]) > 0.9 * np.sum(variance)


def test_noise_alone_leaves_no_variance(known: tuple[Site, SteelBasis, Array]) -> None:
    """What the variances add to the amplitudes is less than their noise."""
    _, basis, _ = known
    rng, size = np.random.default_rng(7), basis.shared
    information = np.eye(size) / NOISE**2
    gradient = information @ (NOISE * rng.normal(size=size))
    variance = voxel_variances(basis, information, gradient, SIGMA)
    added = np.einsum("v,vjk,vjk->k", variance, _orthonormal(basis), _orthonormal(basis))
    assert np.sqrt(np.mean(added)) < NOISE


def test_modes_of_other_variances_have_the_fields_of_these_voxels(
    known: tuple[Site, SteelBasis, Array],
) -> None:
    """The covariance of the fields on the path is that of the voxels, and that of the old modes."""
    site, basis, place = known
    variance = np.random.default_rng(8).exponential(size=len(basis.tensor)) ** 3
    new, old_by_new = with_variances(basis, site, variance)
    flat = _orthonormal(basis).reshape(-1, basis.shared)
    within = flat.T @ (np.repeat(variance, 6)[:, None] * flat)
    fields = basis.fields(place)[..., : basis.shared].reshape(-1, basis.shared)
    cov = fields @ within @ fields.conj().T
    scale = np.sqrt(np.diagonal(cov).real)
    of_new = new.fields(place)[..., : new.shared].reshape(-1, new.shared)
    of_old = fields @ old_by_new
    for found in (of_new, of_old):
        np.testing.assert_allclose(
            found @ found.conj().T / scale / scale[:, None],
            cov / scale / scale[:, None],
            rtol=0.0,
            atol=1e-6,
        )
    np.testing.assert_array_equal(new.moment[..., new.shared :], basis.moment[..., basis.shared :])
