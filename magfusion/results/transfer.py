"""Whether the calibrations by two logs agree."""

from typing import NamedTuple

import numpy as np

from magfusion.model.parameters import PHASE, Block, Calibration, difference, prior_sigma
from magfusion.results.figures import DETERMINED_RATIO
from magfusion.units import Array


class Estimated(NamedTuple):
    """A calibration with its posterior."""

    declared: Calibration
    calibration: Calibration
    blocks: tuple[Block, ...]
    cov: Array


def agreement(first: Estimated, second: Estimated) -> Array:
    """Compare the calibrations of one installation by two logs.

    Both start at the same survey, and keep it where a log adds no information: such directions, the
    gauge among them, agree without proof and are omitted.  In the others the pull of the survey is
    removed from the sigma of the difference: with ``K = I - P P0^-1`` it has the covariance ``(K1 -
    K2) P0 (K1 - K2)^T + sum(P - P P0^-1 P)``, which is less than the sum of the posteriors.
    `first`, `second`: with the same parameters and priors. Returns (determined,), difference along
    each direction that both logs determine, in its own sigmas.
    """
    # A log has its own phases: they refer to its own middle.
    kept = np.array([b.parameter != PHASE for b in first.blocks for _ in b.sigma], dtype=bool)
    prior = prior_sigma(first.blocks)[kept]
    step = difference(first.calibration, second.calibration, first.blocks)[kept] / prior
    scaled = [part.cov[np.ix_(kept, kept)] / prior[:, None] / prior for part in (first, second)]
    both = scaled[0] + scaled[1]
    pulled = scaled[1] - scaled[0]
    own = pulled @ pulled + sum(p - p @ p for p in scaled)
    value, vector = np.linalg.eigh(0.5 * both)
    determined = vector[:, np.sqrt(np.maximum(value, 0.0)) < DETERMINED_RATIO]
    variance = np.einsum("ik,ij,jk->k", determined, own, determined)
    return np.asarray(determined.T @ step / np.sqrt(variance))
