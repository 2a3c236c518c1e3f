"""Integrity of a smoothed log: all tests, and a covariance that accounts for them.

A fault shows in several tests.  What a single parameter explains is not reported again by the
others; the covariance accounts for all of them.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.estimation.data_checks.signal import detected_in
from magfusion.estimation.graph.graph import GraphEstimate
from magfusion.estimation.integrity.change_detection import candidate_steps, changed
from magfusion.estimation.integrity.convergence_report import (
    convergence,
    geometry,
    rivals,
    with_width,
)
from magfusion.estimation.integrity.fixed_parameter_test import check_fixed_parameters
from magfusion.estimation.integrity.priors_of_log import bias_change, calibration_change
from magfusion.estimation.integrity.released_fault import ReleasedFault
from magfusion.estimation.integrity.residual_blocks import (
    compass,
    fields,
    fixes,
    inertial,
    together,
)
from magfusion.estimation.integrity.score import Score, field_residual, moved_estimate, scores_of
from magfusion.estimation.integrity.smoothed_separation import contradicting_sensors
from magfusion.estimation.integrity.steel_test import score_with_steel, steel
from magfusion.estimation.integrity.test_result import NOTHING, Case, TestResult
from magfusion.estimation.posterior.tuned_noise import covered_beacons, tuned_noise
from magfusion.estimation.snapshot.region_test import of_place
from magfusion.estimation.solve.memory import give_back_memory
from magfusion.model.arguments import check_arguments
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Trust, Verdict
from magfusion.model.without_imu import logged
from magfusion.units import Array

EXPLAINED = 0.3  # of the residuals; remaining share with a cause that explains them
MAX_CAUSES = 2  # simultaneous causes
STRONGER = 1.5  # ratio above which a finding is no side effect of another


R = TypeVar("R", bound=Smoothed)


class JudgedResult(NamedTuple, Generic[R]):
    """A result with an honest covariance, its findings, and the score of fixed parameters."""

    result: R
    trust: Trust
    score: Score | None
    # the fixed parameter that is wrong, and what explains the log as well
    causes: tuple[ReleasedFault, ...] = ()


def judge_result(result: R, log: Log) -> tuple[R, Trust]:
    """Return a result with the covariance that its tests allow, and their findings.

    Parameters
    ----------
    result : Smoothed
        As of `smooth`; not changed.
    log : Log
        Of the result; its raw streams are tested too.

    Returns
    -------
    result : Smoothed
        Of the same type, with ``trust``, and ``states.pose_cov`` enlarged where a test requires it.
    trust : Trust
        Verdict, reasons, remarks and unverified parameters.

    Raises
    ------
    TypeError
        If the arguments are not a result and a log, in this order.
    """
    check_arguments("judged", result=(result, Smoothed), log=(log, Log))
    estimate = judged_with_score(result, log)
    return estimate.result, estimate.trust


def judged_with_score(result: R, log: Log, online: Site | None = None) -> JudgedResult[R]:
    """Return the same, with the score of all fixed parameters of the result.

    `online`: of an estimate that continues the result: its region's steel is tested, and in the
    score.
    """
    log, _ = logged(log, result.declared.site)
    alone = result.earth_residual is None
    states = result.states if alone else None  # else they depend on the Earth field
    streams = log, result.declared.site, BRIDGED_CODES
    released = detected_in(result.fields, result.declared.site)
    detected = recorded(*streams, estimated=states, beacons=alone, compensated=released)
    covered = covered_beacons(result.noise, result.fields, result.declared.site)
    trust = Trust((*tuned_noise(result.noise, covered), *detected))
    give_back_memory()
    pose_cov = result.states.pose_cov
    if pose_cov is None:
        return JudgedResult(replace(result, trust=trust), trust, None)
    at = result.states
    place = of_place(result.declared.site, at.time, at.world_from_body, at.position_world, pose_cov)
    trust |= Trust(place)
    scores = scores_of(result, log.imu, candidate_steps(result))
    score, wide = (None, None) if scores is None else scores
    in_region = None if online is None else score_with_steel(score, result, log, online)
    case = Case(result, log, score, pose_cov, wide, in_region)
    factor, spread = np.ones(len(pose_cov)), np.zeros_like(pose_cov)
    causes: tuple[ReleasedFault, ...] = ()
    for findings in _run_tests(case):
        causes = causes or (findings.causes if findings.findings else ())
        trust |= Trust(findings.findings, findings.unverified)
        factor = factor if findings.factor is None else np.maximum(factor, findings.factor)
        spread = spread if findings.spread is None else spread + findings.spread
    final_cov = factor[:, None, None] * pose_cov + spread
    widened = replace(result.states, pose_cov=final_cov)
    if online is None:
        trust = with_width(trust, result.declared.site, at.position_world, final_cov)
    score = score if in_region is None else in_region
    return JudgedResult(replace(result, states=widened, trust=trust), trust, score, causes)


def _run_tests(case: Case) -> Iterator[TestResult]:
    """Yield all test results; that of fixed parameters first, as it may explain the others."""
    of_fixed, priors, biases = (
        check_fixed_parameters(case),
        calibration_change(case),
        bias_change(case),
    )
    biases = biases if case.log.inertial else NOTHING
    change = changed(case)
    if (
        bent := steel(case, max(of_fixed.gain, change.gain), doubted=bool(priors.findings))
    ) is not None:
        yield from _with_steel(case, bent, of_fixed, priors, biases)
        return
    if change.findings:  # it explains more than whatever is wrong throughout
        of_fixed = TestResult(unverified=of_fixed.unverified)
    of_fixed, causes, residuals = _with_residuals(case, of_fixed)
    cause, prior, rest = (_weight(findings) for findings in (of_fixed, priors, residuals[0]))
    cause = max(cause, _weight(change))
    if causes < len(of_fixed.named) and rest:  # residuals that none of them explains
        of_fixed = replace(of_fixed, findings=of_fixed.findings[:causes])
    if (causes or change.findings) and cause > prior:
        residuals = [_traces(findings, 10.0 * cause) for findings in residuals]
    if prior > STRONGER * cause:
        of_fixed = _traces(of_fixed, prior)
    yield of_fixed
    yield from residuals
    yield _traces(compass(case), cause)
    yield change
    yield _traces(priors, cause)
    yield _traces(biases, cause)
    yield _sensors(case, of_fixed)
    for monitor in (fixes, together, convergence, geometry, rivals):
        yield monitor(case)


def _sensors(case: Case, of_fixed: TestResult) -> TestResult:
    """Return the test of aiding sensors without a named cause."""
    explained = {block.owner for one in of_fixed.causes for block in one.fault.blocks}
    return TestResult(contradicting_sensors(case.result, explained))


def _with_steel(case: Case, bent: TestResult, *others: TestResult) -> Iterator[TestResult]:
    """Yield all test results where steel explains those of fields and parameters."""
    of_fixed, priors, biases = others
    cause = _weight(bent)
    yield replace(bent, unverified=of_fixed.unverified)
    for findings in (*_residuals(case, *_explained(case, ())[0]), priors):
        yield _traces(findings, 10.0 * cause)
    yield _traces(compass(case), cause)
    yield _traces(biases, cause)
    yield _sensors(case, of_fixed)
    for monitor in (fixes, together, convergence, geometry, rivals):
        yield monitor(case)


def _with_residuals(case: Case, of_fixed: TestResult) -> tuple[TestResult, int, list[TestResult]]:
    """Return the test of fixed parameters, and the residuals that it does not explain.

    With the number of its causes that explain them. One that explains the residuals of the fields
    is named for them, though it moves no pose.
    """
    after, causes = _explained(case, of_fixed.named)
    residuals = _residuals(case, *after)
    if causes or not residuals[0].findings:
        return of_fixed, causes, residuals
    other = check_fixed_parameters(case, without_effect=True)
    after, causes = _explained(case, other.named)
    explained = _residuals(case, *after) if causes else residuals
    if not causes or explained[0].findings:
        return of_fixed, 0, residuals
    return other, causes, explained


def _residuals(case: Case, after: GraphEstimate, step: Array) -> list[TestResult]:
    """Return the tests of residuals at an estimate after a step of the fixed parameters."""
    ends = [field_residual(case.result, after, raw=raw) for raw in (True, False)]
    return [fields(case, *ends), inertial(case, after, step)]


def _explained(case: Case, named: tuple[Array, ...]) -> tuple[tuple[GraphEstimate, Array], int]:
    """Return the estimate at which residuals are tested, and the number of causes it includes.

    With the estimate, the step of the fixed parameters that leads to it. One or two causes may
    explain residuals; if more are needed, the model itself is wrong.
    """
    result, score = case.result, case.score
    if score is None:
        return (result.estimate, np.zeros(0)), 0

    def moved(step: Array) -> tuple[GraphEstimate, Array]:
        whole = score.allowed(step)
        return moved_estimate(result, score, whole), whole

    before = moved(np.zeros(len(score.gradient)))
    least = max(EXPLAINED * _square(result, before[0]), 1.0)
    for number, step in enumerate(named[:MAX_CAUSES], 1):
        after = moved(step)
        if _square(result, after[0]) < least:
            return after, len(named) if number == len(named) else number
    return before, 0


def _square(result: Smoothed, estimate: GraphEstimate) -> float:
    rest = field_residual(result, estimate, raw=True)
    return max(float(np.nanmean(rest**2)), 1e-9) if np.any(np.isfinite(rest)) else 1.0


def _weight(tests: TestResult) -> float:
    return max((finding.weight for finding in tests.findings), default=0.0)


def _traces(tests: TestResult, cause: float) -> TestResult:
    """Return a test result without side effects of a stronger cause."""
    kept = tuple(
        f for f in tests.findings if STRONGER * f.weight > cause or f.verdict is Verdict.TRUSTWORTHY
    )
    return replace(tests, findings=kept)
