"""The verdict on a smoothed log: every witness is heard, and the covariance made honest.

A mistake leaves traces with several witnesses.  What freeing one parameter explains is its trace
and is not said beside it; the covariance takes what all of them say.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.data_checks.recording import BRIDGED, recorded
from magfusion.estimation.data_checks.signal import detected_in
from magfusion.estimation.graph.graph import Estimate
from magfusion.estimation.integrity.close_residuals import together
from magfusion.estimation.integrity.held import held
from magfusion.estimation.integrity.midway import changed, steps_asked
from magfusion.estimation.integrity.outcome import convergence, geometry, rivals
from magfusion.estimation.integrity.place_witness import of_place
from magfusion.estimation.integrity.priors_of_log import bias_change, calibration_change
from magfusion.estimation.integrity.residual_blocks import fields, fixes, inertial
from magfusion.estimation.integrity.score import (
    Score,
    field_residual,
    moved_estimate,
    scores_of,
)
from magfusion.estimation.integrity.smoothed_compass import compass
from magfusion.estimation.integrity.testimony import NOTHING, Case, Testimony
from magfusion.estimation.posterior.tuned_noise import tuned_noise
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.model.arguments import check_arguments
from magfusion.model.samples import Log
from magfusion.model.trust import Trust, Verdict
from magfusion.model.without_imu import logged
from magfusion.units import Array

EXPLAINED = 0.3  # of the residuals, left beside a cause that explains them
FEW = 2  # causes at once
STRONGER = 1.5  # than a trace is what leaves it


R = TypeVar("R", bound=Smoothed)


class Judged(NamedTuple, Generic[R]):
    """A result with a covariance that its witnesses allow, what they say, and what is held."""

    result: R
    trust: Trust
    score: Score | None


def judged(result: R, log: Log) -> tuple[R, Trust]:
    """Return a result with a covariance that its witnesses allow, and what they say.

    Parameters
    ----------
    log : Log
        Of which the result is: its raw streams are witnesses too.

    Raises
    ------
    TypeError
        Where the arguments are not a result and a log, in this order.
    """
    check_arguments("judged", result=(result, Smoothed), log=(log, Log))
    found = judged_with_score(result, log)
    return found.result, found.trust


def judged_with_score(result: R, log: Log) -> Judged[R]:
    """Return the same, with the score of everything that the result holds."""
    log, _ = logged(log, result.declared.site)
    alone = result.earth_residual is None
    states = result.states if alone else None  # else the Earth field has had its say in them
    streams = log, result.declared.site, BRIDGED
    freed = detected_in(result.fields, result.declared.site)
    heard = recorded(*streams, estimated=states, beacons=alone, freed=freed)
    trust = Trust((*tuned_noise(result.noise), *heard))
    give_back_memory()
    pose_cov = result.states.pose_cov
    if pose_cov is None:
        return Judged(replace(result, trust=trust), trust, None)
    at = result.states
    place = of_place(result.declared.site, at.time, at.world_from_body, at.position_world, pose_cov)
    trust |= Trust(place)
    scores = scores_of(result, log.imu, steps_asked(result))
    score, wide = (None, None) if scores is None else scores
    case = Case(result, log, score, pose_cov, wide)
    factor, spread = np.ones(len(pose_cov)), np.zeros_like(pose_cov)
    for said in _heard(case):
        trust |= Trust(said.findings, said.unverified)
        factor = factor if said.factor is None else np.maximum(factor, said.factor)
        spread = spread if said.spread is None else spread + said.spread
    widened = replace(result.states, pose_cov=factor[:, None, None] * pose_cov + spread)
    return Judged(replace(result, states=widened, trust=trust), trust, score)


def _heard(case: Case) -> Iterator[Testimony]:
    """Yield what every witness says: what is held first, since it may explain the others."""
    of_held, priors, biases = held(case), calibration_change(case), bias_change(case)
    biases = biases if case.log.inertial else NOTHING
    after, causes = _explained(case, of_held.named)
    ends = [field_residual(case.result, after, raw=raw) for raw in (True, False)]
    residuals = [fields(case, *ends), inertial(case, after)]
    cause, prior, rest = (_weight(said) for said in (of_held, priors, residuals[0]))
    if causes < len(of_held.named) and rest:  # they share out what none of them explains
        of_held = replace(of_held, findings=of_held.findings[:causes])
    if causes and cause > prior:
        residuals = [_traces(said, 10.0 * cause) for said in residuals]
    if prior > STRONGER * cause:
        of_held = _traces(of_held, prior)
    yield of_held
    yield from residuals
    yield _traces(compass(case), cause)
    yield _traces(changed(case), cause)
    yield _traces(priors, cause)
    yield _traces(biases, cause)
    for witness in (fixes, together, convergence, geometry, rivals):
        yield witness(case)


def _explained(case: Case, named: tuple[Array, ...]) -> tuple[Estimate, int]:
    """Return the estimate at which residuals are judged, and how many causes lead to it.

    A cause or two explain residuals; where it takes more, the model itself is wrong.
    """
    result, score = case.result, case.score
    if score is None:
        return result.estimate, 0
    before = moved_estimate(result, score, score.allowed(np.zeros(len(score.gradient))))
    least = max(EXPLAINED * _square(result, before), 1.0)
    for number, step in enumerate(named[:FEW], 1):
        after = moved_estimate(result, score, score.allowed(step))
        if _square(result, after) < least:
            return after, len(named) if number == len(named) else number
    return before, 0


def _square(result: Smoothed, estimate: Estimate) -> float:
    rest = field_residual(result, estimate, raw=True)
    return max(float(np.nanmean(rest**2)), 1e-9) if np.any(np.isfinite(rest)) else 1.0


def _weight(said: Testimony) -> float:
    return max((finding.weight for finding in said.findings), default=0.0)


def _traces(said: Testimony, cause: float) -> Testimony:
    """Return a testimony without what is only the trace of something stronger."""
    kept = tuple(
        f for f in said.findings if STRONGER * f.weight > cause or f.verdict is Verdict.TRUSTWORTHY
    )
    return replace(said, findings=kept)
