"""Input and result of the integrity tests of an estimate."""

from dataclasses import dataclass, field
from typing import NamedTuple

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.integrity.released_fault import ReleasedFault
from magfusion.estimation.integrity.score import Score
from magfusion.model.samples import Log
from magfusion.model.trust import Finding, Unverified
from magfusion.units import Array


class Case(NamedTuple):
    """A result to be tested.

    Parameters
    ----------
    log : Log
        Of the result.
    score : Score, optional
        Of all fixed parameters; None if there is none.
    pose_cov : ndarray, shape (states, 6, 6)
        As claimed by the estimator.
    wide : Score, optional
        Including possible steps of parameters, as of `scores_of`.
    in_region : Score, optional
        Including steel in the site's region instead of near the path.
    """

    result: Smoothed
    log: Log
    score: Score | None
    pose_cov: Array
    wide: Score | None = None
    in_region: Score | None = None


@dataclass(frozen=True, eq=False)
class TestResult:
    """Result of one test.

    Parameters
    ----------
    factor : ndarray, shape (states,), optional
        Factor for the claimed covariance of the poses.
    spread : ndarray, shape (states, 6, 6), optional
        Covariance to add to it.
    named : tuple of ndarray, shape (h,)
        Steps of the fixed parameters: by the first cause, by the first two, and so on.
    causes : tuple of ReleasedFault
        The first cause, and what explains the log as well.
    gain : float
        Decrease of -2 log likelihood by what the findings name.
    """

    findings: tuple[Finding, ...] = ()
    unverified: tuple[Unverified, ...] = ()
    factor: Array | None = field(default=None)
    spread: Array | None = field(default=None)
    named: tuple[Array, ...] = ()
    causes: tuple[ReleasedFault, ...] = ()
    gain: float = 0.0


NOTHING = TestResult()
