"""The calibration that several logs share: what they say together, and what all but one say.

Each log is solved with what the survey and the other logs say as its prior, which makes its
solution the joint one as soon as the others were condensed where that is; no log is ever held in
memory with another.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.posterior.condensed import Condensed, summed, taken_at
from magfusion.model.correlation import Correlation, joined
from magfusion.model.parameters import Block, Calibration, difference, prior_sigma, retract
from magfusion.model.prior import parameters_of, prior_sqrt_information
from magfusion.model.site import Site
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Shared:
    """What logs share, as the site declares it.

    Parameters
    ----------
    declared : Calibration
    blocks : tuple of Block
    """

    declared: Calibration
    blocks: tuple[Block, ...]

    @property
    def information(self) -> Array:
        """Of the survey alone, shape (s, s)."""
        whitening = prior_sqrt_information(self.declared.site, self.blocks)
        return whitening.T @ whitening

    def moved(self, step: Array) -> Calibration:
        """Return the calibration that a step leads to."""
        return retract(self.declared, self.blocks, step)


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of the shared calibration.

    Parameters
    ----------
    step : ndarray, shape (s,)
        From the declared calibration.
    cov : ndarray, shape (s, s)
        As estimators weigh it: of what is white.
    by_common : ndarray, shape (s, c)
        What one sigma of each parameter that is considered in every log does to it.
    apart : ndarray, shape (s, s)
        Covariance of what else is considered does to it, log by log.
    """

    step: Array
    cov: Array
    by_common: Array
    apart: Array

    @property
    def honest(self) -> Array:
        """Its covariance with what is considered, shape (s, s)."""
        return self.cov + self.by_common @ self.by_common.T + self.apart


@dataclass(frozen=True, eq=False)
class Said:
    """What one log says, and the shared calibration where it was condensed.

    Parameters
    ----------
    step : ndarray, shape (s,)
        From the declared calibration to there.
    """

    step: Array
    part: Condensed


def known_by(shared: Shared, logs: Sequence[Said], at: Array) -> Known:
    """Return what survey and logs say of the shared calibration: a step of Gauss and Newton.

    Parameters
    ----------
    logs : sequence of Said
        Any number.
    at : ndarray, shape (s,)
        From the declared calibration to where the step is taken.
    """
    here, prior = shared.moved(at), shared.information
    unit = prior_sigma(shared.blocks)
    information = prior.copy()
    gradient = -prior @ difference(shared.declared, here, shared.blocks)
    by_common, apart = np.zeros((len(at), 0)), np.zeros_like(prior)
    if logs:
        parts = [taken_at(s.part, shared.moved(s.step), here, shared.blocks) for s in logs]
        total = summed(parts)
        information += total.information
        gradient += total.gradient
        by_common = total.by_common
        # Logs of one place may have met the same iron: as if all had met the same.
        apart = len(logs) * total.by_place + total.by_log
    cov = np.linalg.inv(unit[:, None] * information * unit)
    cov = unit[:, None] * (0.5 * (cov + cov.T)) * unit
    after = retract(here, shared.blocks, cov @ gradient)
    step = difference(shared.declared, after, shared.blocks)
    return Known(step, cov, cov @ by_common, cov @ apart @ cov)


def between(shared: Shared, old: Said, new: Said, share: float) -> Said:
    """Return what a log says, changed by a share of its change only, taken where it is new."""
    if share == 1.0:
        return new
    here, there = shared.moved(new.step), shared.moved(old.step)
    before = vars(taken_at(old.part, there, here, shared.blocks))
    part = {k: share * v + (1.0 - share) * before[k] for k, v in vars(new.part).items()}
    return Said(new.step, Condensed(**part))


def apart_in_sigmas(one: Array, other: Array, cov: Array) -> float:
    """Return the root mean square of a difference, over all directions, in sigmas of each."""
    scale = np.sqrt(np.diagonal(cov))
    step = (one - other) / scale
    solved = np.linalg.solve(cov / scale[:, None] / scale, step)
    return float(np.sqrt(max(float(step @ solved), 0.0) / len(step)))


def as_prior(known: Known, shared: Shared, blocks: tuple[Block, ...]) -> tuple[Block, ...]:
    """Return the blocks of a log whose prior is what is known of those that are shared."""
    sigma, at = np.sqrt(np.diagonal(known.cov)), {b.key: b.columns for b in shared.blocks}
    return tuple(b._replace(sigma=sigma[at[b.key]]) if b.key in at else b for b in blocks)


def with_prior(known: Known, shared: Shared, declared: Calibration) -> Calibration:
    """Return what a log declares, with the mean and the correlation of what is known beside it."""
    sigma, own = np.sqrt(np.diagonal(known.cov)), parameters_of(shared.blocks)
    fresh = Correlation(tuple(own), known.cov / sigma[:, None] / sigma)
    moved = retract(declared, shared.blocks, known.step)
    before = declared.site.correlation
    rest = before and before.kept(lambda p: p not in own)
    return replace(moved, site=replace(moved.site, correlation=joined([fresh, rest])))


def uncoupled(site: Site, shared: tuple[Block, ...]) -> Site:
    """Return a site in which what is shared, and what each log has of its own, are independent."""
    if site.correlation is None:
        return site
    own = set(parameters_of(shared))
    parts = [
        site.correlation.kept(lambda p: p in own),
        site.correlation.kept(lambda p: p not in own),
    ]
    return replace(site, correlation=joined(parts))
