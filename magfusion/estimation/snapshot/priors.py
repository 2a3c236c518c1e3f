"""Tests of a calibration against the declared values of the site, singly and jointly.

A change ``d`` from the declared values has the covariance ``C = P0 - P`` where the declared values
are part of the fit (prior ``P0``, posterior ``P``), and ``C = P0 + P`` where they are not.  Then
``d^T C^+ d`` is a chi square of as many degrees of freedom as the data determined directions, and
each component is normal.  All tests share a false-alarm budget (S. Holm, Scandinavian Journal of
Statistics 6, 1979).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

from magfusion.estimation.data_checks.statistics import (
    FALSE_ALARMS,
    P_CERTAIN,
    holm,
    log_p_chi_square,
)
from magfusion.model.trust import LISTED, Finding, Trust, Verdict
from magfusion.units import Array

MOVED = 0.01  # of the prior's variance; below, the data do not determine a direction


class Contradiction(NamedTuple):
    """Result of a test of a calibration against the declared values."""

    findings: tuple[Finding, ...]  # None, or one
    excess: float  # factor by which variances are too small, one if nothing is contradicted


def contradiction(
    names: Sequence[str],
    change: Array,
    change_cov: Array,
    prior_cov: Array,
    remedy: str,
    of: str = "The calibration",
) -> Contradiction:
    """Test whether parameters deviate from their declared values by more than declared.

    Parameters
    ----------
    names : sequence of str
        As the report has them.
    change : ndarray, shape (n,)
        Estimated less declared.
    change_cov, prior_cov : ndarray, shape (n, n)
        Of the change, if the declared sigmas are right, and of the declared values; parameters
        with zero prior variance are ignored.
    remedy : str
        Sentence that ends the reason.
    """
    prior = np.sqrt(np.diagonal(prior_cov))
    kept = np.flatnonzero(prior > 0.0)
    scaled = change[kept] / prior[kept]
    cov = change_cov[np.ix_(kept, kept)] / prior[kept, None] / prior[kept]
    value, vector = np.linalg.eigh(0.5 * (cov + cov.T))
    findings = value > MOVED
    square = float(np.sum((vector[:, findings].T @ scaled) ** 2 / value[findings]))
    freedom = int(np.sum(findings))
    if freedom == 0:
        return Contradiction((), 1.0)
    sigma = np.sqrt(np.maximum(np.diagonal(cov), 0.0))
    reported = sigma**2 > MOVED
    deviation = np.where(reported, np.abs(scaled) / np.where(reported, sigma, 1.0), 0.0)
    single = np.where(reported, np.log(2.0) + log_ndtr(-deviation), 0.0)
    chance = np.append(single, log_p_chi_square(square, freedom))
    informative, least = holm(chance), float(np.min(chance))
    if not np.any(informative):
        return Contradiction((), 1.0)
    order = np.argsort(single)[: max(1, min(LISTED, int(np.sum(informative[:-1]))))]
    maximum = ", ".join(f"{names[kept[i]]} by {deviation[i]:.1f}" for i in order)
    text = (
        f"{of} contradicts the site: largest deviations {maximum} sigmas; joint chi square"
        f" {square:.3g} where {freedom} is expected. {remedy}"
    )
    verdict = Verdict.FAILED if least < np.log(2.0 * P_CERTAIN) else Verdict.DOUBTFUL
    weight = least / np.log(FALSE_ALARMS / len(chance))
    result = Finding("prior", text, verdict, float(weight))
    return Contradiction((result,), max(1.0, square / freedom, float(np.max(deviation)) ** 2))


TOLERATED = 1.5  # root mean square of whitened residuals, up to which sigmas are acceptable
NOTHING_EXPLAINED = 10.0  # from which the model does not describe the measurements


def unexplained(
    what: str, chi_square: float, freedom: float, remedy: str, limit: float = FALSE_ALARMS
) -> Contradiction:
    """Test whether residuals are significantly larger than declared.

    Parameters
    ----------
    what : str
        Source of the residuals: "beacon A".
    chi_square : float
        Sum of the squared whitened residuals.
    freedom : float
        Independent values, less fitted parameters.
    limit : float
        Share of the false alarms of this test.
    """
    if freedom <= 0.0:
        return Contradiction((), 1.0)
    excess = chi_square / freedom
    rms, chance = float(np.sqrt(excess)), float(log_p_chi_square(chi_square, freedom))
    if rms <= TOLERATED or chance > np.log(limit):
        return Contradiction((), 1.0)
    verdict = Verdict.FAILED if rms > NOTHING_EXPLAINED else Verdict.DOUBTFUL
    text = (
        f"The residual of {what} is {rms:.3g} where about 1 is expected, over {freedom:.0f}"
        f" numbers. {remedy}"
    )
    return Contradiction((Finding("field_residuals", text, verdict, rms / TOLERATED),), excess)


def trust_of(*parts: Contradiction) -> tuple[Trust, float]:
    """Return the findings of several tests, and the joint factor on a covariance."""
    findings = tuple(finding for part in parts for finding in part.findings)
    return Trust(findings), max((part.excess for part in parts), default=1.0)
