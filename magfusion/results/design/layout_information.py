"""Information of layouts as a sum over beacons, for a search with many thousands of layouts.

Coverage marginalises all parameters at once.  Here the parameters of a beacon alone are
marginalised once per beacon, and the shared ones (the magnetometer, its position on the platform,
the ground) remain with the pose until the beacons are chosen: the same bound, up to rounding.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from magfusion.estimation.posterior.protection_levels import protection_levels
from magfusion.estimation.posterior.separation import POSE, Separation
from magfusion.model.parameters import (
    BeaconParameter,
    Block,
    choose_blocks,
    initial_calibration,
    placed,
    prior_sigma,
)
from magfusion.model.prior import prior_sqrt_information
from magfusion.model.site import Beacon, Site
from magfusion.model.trust import Risk
from magfusion.results.pose_information import (
    SURVEY_GROUPS,
    PoseRows,
    is_free,
    phasor_variance,
    root_information,
    whitened,
)
from magfusion.units import Array

NOTHING = 1e-24  # information (1/m^2, 1/rad^2) below which there is none
FLOOR = 1e-14  # of each number's own information: keeps what is open finite, and very large


@dataclass(frozen=True, eq=False)
class LayoutInformation:
    """Information of beacons at places on the pose at points."""

    site: Site  # with the beacons that stay
    template: Beacon  # beacon of which copies are added
    points: Array  # (n, 3), positions of the platform (m), level and along the world's axes
    window: float  # averaging time of the tones (s)
    risk: Risk  # specification of the protection levels

    def at(self, points: Array) -> "LayoutInformation":
        """Return the same at other points."""
        return replace(self, points=points)

    def root(self, beacon: Beacon) -> Array:
        """Return a root of one new beacon's information, shape (n, rows, size)."""
        site = replace(self.site, beacons=(beacon,), correlation=None)
        blocks = choose_blocks(site, SURVEY_GROUPS)
        shared, allowed = _shared(blocks), is_free(blocks)
        sigma = np.where(allowed, 1.0, prior_sigma(blocks))
        own = len(sigma) - shared
        prior = np.eye(len(sigma))[:own][~allowed[:own]]
        seen = self._seen(site, blocks)
        rows = seen.by_pose.shape[1] + len(prior) - own
        return root_information(seen, np.diag(sigma), prior, shared)[:, : max(rows, 1)]

    @cached_property
    def standing(self) -> Array:
        """Information of the prior and of the beacons that stay, (1 + stay, n, size, size).

        With all of these, then without each.
        """
        if self.site.beacons:
            blocks = choose_blocks(self.site, SURVEY_GROUPS)
        else:
            alone = replace(self.site, beacons=(self.template,))
            every = choose_blocks(alone, SURVEY_GROUPS)
            blocks = placed(b for b in every if not isinstance(b.parameter, BeaconParameter))
        shared, allowed = _shared(blocks), is_free(blocks)
        sigma = np.where(allowed, 1.0, prior_sigma(blocks))
        prior = (prior_sqrt_information(self.site, blocks) * prior_sigma(blocks))[~allowed]
        if not self.site.beacons:
            count = len(self.points)
            empty = np.zeros((count, 0, POSE)), np.zeros((count, 0, len(sigma)))
            none = np.zeros(0, dtype=np.int64)
            seen = PoseRows(*empty, none, np.zeros(count, dtype=np.int64))
        else:
            seen = self._seen(self.site, blocks)
        parts = [seen, *(seen.without(beacon) for beacon in range(len(self.site.beacons)))]
        roots = [root_information(part, np.diag(sigma), prior, shared) for part in parts]
        return added(np.stack(roots))

    def _seen(self, site: Site, blocks: tuple[Block, ...]) -> PoseRows:
        variance, calibration = phasor_variance(site, self.window), initial_calibration(site, 0.0)
        return whitened(calibration, blocks, variance, np.eye(3), self.points)

    def levels_of(self, cov: Array, subset: Array) -> Array:
        """Return protection levels of the position, shape (m,) (m), by covariances of the pose."""
        shape = subset.shape[:2]
        separation = Separation(
            step=np.zeros((*shape, POSE)),
            cov=cov,
            subset_cov=subset,
            separation_cov=subset - cov[:, None],
            determined=np.ones(shape, dtype=bool),
            cost=np.zeros(shape),
            rows=np.ones(shape),
        )
        level = protection_levels(separation, self.risk)[0]
        return np.where(np.isnan(level), np.inf, level)


def added(roots: Array) -> Array:
    """Return the information of roots, shape (..., size, size)."""
    return np.asarray(np.swapaxes(roots, -1, -2) @ roots)


def _shared(blocks: tuple[Block, ...]) -> int:
    """Return the number of nuisances of no beacon; they are the last."""
    return sum(len(b.sigma) for b in blocks if not isinstance(b.parameter, BeaconParameter))


def pose_covariance(information: Array) -> Array:
    """Return the pose's covariance, shared parameters marginalised, shape (..., 6, 6)."""
    size = np.diagonal(information, axis1=-2, axis2=-1)
    scale = 1.0 / np.sqrt(np.maximum(size, NOTHING))
    shared = information * scale[..., :, None] * scale[..., None, :]
    factor = np.linalg.cholesky(shared + FLOOR * np.eye(shared.shape[-1]))[..., -POSE:, -POSE:]
    inverse = np.linalg.inv(factor) * scale[..., None, -POSE:]
    return np.asarray(np.swapaxes(inverse, -1, -2) @ inverse)
