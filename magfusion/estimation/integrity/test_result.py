"""What the witnesses of one result have before them, and what each of them says."""

from dataclasses import dataclass, field
from typing import NamedTuple

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.integrity.score import Score
from magfusion.model.samples import Log
from magfusion.model.trust import Finding, Unverified
from magfusion.units import Array


class Case(NamedTuple):
    """A result that is judged.

    Parameters
    ----------
    log : Log
        Of which it is.
    score : Score, optional
        Of everything held; None where there is none.
    pose_cov : ndarray, shape (states, 6, 6)
        As the estimator claims it.
    wide : Score, optional
        With the steps that parameters may have made, as of `scores_of`.
    """

    result: Smoothed
    log: Log
    score: Score | None
    pose_cov: Array
    wide: Score | None = None


@dataclass(frozen=True, eq=False)
class TestResult:
    """What one witness says.

    Parameters
    ----------
    factor : ndarray, shape (states,), optional
        What the claimed covariance of the poses is to be multiplied by.
    spread : ndarray, shape (states, 6, 6), optional
        What is to be added to it.
    named : tuple of ndarray, shape (h,)
        Steps of what is held: by the first cause that is named, by the first two, and so on.
    """

    findings: tuple[Finding, ...] = ()
    unverified: tuple[Unverified, ...] = ()
    factor: Array | None = field(default=None)
    spread: Array | None = field(default=None)
    named: tuple[Array, ...] = ()


NOTHING = TestResult()
