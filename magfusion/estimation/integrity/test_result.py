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
    """A result to be tested."""

    result: Smoothed
    log: Log  # of the result
    score: Score | None  # of all fixed parameters; None if there is none
    pose_cov: Array  # (states, 6, 6), as claimed by the estimator
    wide: Score | None = None  # including possible steps of parameters, as of `scores_of`
    in_region: Score | None = None  # including steel in the site's region instead of near the path


@dataclass(frozen=True, eq=False)
class TestResult:
    """Result of one test."""

    findings: tuple[Finding, ...] = ()
    unverified: tuple[Unverified, ...] = ()
    # (states,), factor for the claimed covariance of the poses
    factor: Array | None = field(default=None)
    spread: Array | None = field(default=None)  # (states, 6, 6), covariance to add to it
    # (h,) each, steps of the fixed parameters: by the first cause, by the first two, and so on
    named: tuple[Array, ...] = ()
    causes: tuple[ReleasedFault, ...] = ()  # the first cause, and what explains the log as well
    gain: float = 0.0  # decrease of -2 log likelihood by what the findings name


NOTHING = TestResult()
