"""Weighting of a fix's hypotheses by a declared region, or the hemisphere of a beacon."""

import numpy as np
from scipy.special import log_ndtr

from magfusion.estimation.snapshot.problem import FixProblem
from magfusion.estimation.snapshot.refine import RefinedFixes
from magfusion.estimation.solve.batched import open_inverse
from magfusion.model.site import Site
from magfusion.units import Array

SOFT_EDGE = 0.02  # of the distance from the nearest beacon; uncertainty of a declared plane
DROPPED = 25.0  # chi square of a position outside, from which a pose is excluded


def outside(problem: FixProblem, solved: RefinedFixes, count: int) -> Array:
    """Return the cost of each hypothesis for being outside, shape (epochs, count).

    Minus twice the logarithm of its probability to be inside, by its own covariance; infinite
    beyond `DROPPED`. If all poses of an epoch are outside, the one nearest to the inside keeps its
    own cost, so that the wrong declaration is reported instead of an epoch without a pose.
    """
    site = problem.calibration.site
    if site.bounds is None:
        return np.zeros((len(problem.time), count))
    rotation, position = solved.state.rotation, solved.state.position
    inverse, _ = open_inverse(solved.information)
    margin, sigma = margins(site, rotation, position, inverse[:, 3:6, 3:6])
    added = -2.0 * np.sum(log_ndtr(margin / sigma), axis=1).reshape(-1, count)
    added = added - np.min(added, axis=1, keepdims=True)
    return np.where(added > DROPPED, np.inf, added)


def margins(
    site: Site, world_from_body: Array, position_world: Array, position_cov: Array
) -> tuple[Array, Array]:
    """Return the distance of the magnetometer inside of each plane, and its standard deviation.

    `world_from_body` (n, 3, 3). `position_world` (n, 3): of the body (m). `position_cov` (n, 3, 3):
    body axes (m^2). Returns `margin`, `sigma` (n, planes) (m); includes the uncertainty of a
    declared plane.
    """
    assert site.bounds is not None
    sensor = position_world + world_from_body @ site.platform.magnetometer.position_body
    normal_body = site.bounds.normal_world @ world_from_body
    square = np.einsum("nki,nij,nkj->nk", normal_body, position_cov, normal_body)
    centres = np.array([beacon.position_world for beacon in site.beacons])
    away = np.linalg.norm(sensor[:, None] - centres, axis=2).min(axis=1)
    sigma = np.sqrt(np.maximum(square, 0.0) + (SOFT_EDGE * away[:, None]) ** 2)
    return site.bounds.margin(sensor), sigma
