"""Prior of a calibration: the site's sigmas and their correlations."""

import numpy as np

from magfusion.model.correlation import Component
from magfusion.model.parameters import Block, prior_sigma
from magfusion.model.site import Site
from magfusion.units import Array


def parameters_of(blocks: tuple[Block, ...]) -> list[Component]:
    """Return the parameter of each column of a tangent vector."""
    return [
        Component(block.group, block.owner, block.kind, i)
        for block in blocks
        for i in range(len(block.sigma))
    ]


def prior_sqrt_covariance(site: Site, blocks: tuple[Block, ...]) -> Array:
    """Return the triangular matrix that transforms unit noise to a sample of the prior.

    `site`: the declared one, with its correlation. `blocks`: parameters not among them are
    marginalised. Returns (dimension, dimension): ``spread @ spread.T`` is the prior's covariance.
    """
    sigma = prior_sigma(blocks)
    if site.correlation is None:
        return np.diag(sigma)
    correlation = site.correlation.among(parameters_of(blocks))
    return np.asarray(sigma[:, None] * np.linalg.cholesky(correlation))


def prior_sqrt_information(site: Site, blocks: tuple[Block, ...]) -> Array:
    """Return the matrix that whitens a deviation from the prior's mean: the inverse spread."""
    if site.correlation is None:
        return np.diag(1.0 / prior_sigma(blocks))
    return np.asarray(np.linalg.inv(prior_sqrt_covariance(site, blocks)))
