"""Fixed-parameter test: which fixed parameter a log contradicts, and which it cannot check.

Significance is not consequence: a parameter fails if its evidence is large, and if it would move
the poses beyond their covariance, is of an IMU that is farther off than usual, or explains
residuals that would be reported without it.  The one with the most evidence is the cause; after its
step, the next is tested.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from magfusion.estimation.data_checks.statistics import sigmas
from magfusion.estimation.integrity.fault_candidates import (
    EPOCH_SHIFT,
    SAMPLE_RATE,
    STRETCH,
    TILT,
    TYPICAL_SHIFT,
    TYPICAL_TILT,
    FaultCandidate,
    fault_candidates,
)
from magfusion.estimation.integrity.released_fault import COVERED, ReleasedFault, release_fault
from magfusion.estimation.integrity.score import Score, field_residual, moved_estimate
from magfusion.estimation.integrity.test_result import NOTHING, Case, TestResult
from magfusion.model.parameters import Block, Parameter, prior_sigma
from magfusion.model.parameters.inertial import ACCEL_BIAS, GYRO_BIAS
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Unverified, Verdict
from magfusion.units import Array

MIN_EVIDENCE = 20.0  # of -2 log likelihood, above which a cause is named
MARGIN = 10.0  # of the same, by which a cause must be better than another
MAX_LINEAR_CHI_SQUARE = (
    25.0**2
)  # beyond, a linear step and its covariance do not locate the solution
MAX_CAUSES = 4  # reported causes
MIN_SHARE = 0.03  # of the first cause's evidence; less may be its nonlinear remainder
UNCHECKED = 4.3**2  # chi square below which one of fifty candidates is not detected


def check_fixed_parameters(case: Case, *, without_effect: bool = False) -> TestResult:
    """Test all fixed parameters.

    `without_effect`: whether causes are named that do not move the poses.
    """
    if case.score is None:
        return NOTHING
    score, site = case.score, case.result.declared.site
    unverified = tuple(_unverified(case, score))
    candidates = list(fault_candidates(site, score.fixed))
    causes = list(
        causes_of(
            case.pose_cov,
            score,
            lambda *_: candidates,
            lambda one, before: _exceeds_residuals(case, score, one, before),
            without_effect=without_effect,
        )
    )
    if not causes:
        return TestResult(unverified=unverified)
    spread = np.zeros_like(case.pose_cov)
    for one in causes:
        moved, known_cov = one.cause.moved, one.cause.known_cov
        spread += moved[:, :, None] * moved[:, None, :]
        spread += score.by_pose @ known_cov @ np.swapaxes(score.by_pose, 1, 2)
    return TestResult(
        tuple(finding_of(site, one.cause, one.rivals) for one in causes),
        unverified,
        spread=spread,
        named=tuple(one.total for one in causes),
        causes=(causes[0].cause, *causes[0].rivals),
        gain=sum(one.cause.gain for one in causes),
    )


class NamedCause(NamedTuple):
    """A fixed parameter that a log contradicts."""

    cause: ReleasedFault
    rivals: list[ReleasedFault]  # what explains the log as well
    total: Array  # (h,), its step with those of the causes before it


def causes_of(
    pose_cov: Array,
    score: Score,
    candidates: Callable[[Array, Array], Sequence[FaultCandidate]],
    is_cause: Callable[[ReleasedFault, Array], bool] = lambda *_: True,
    *,
    without_effect: bool = False,
) -> Iterator[NamedCause]:
    """Yield the causes, that with most evidence first; the next is of what remains after its step.

    `candidates`: candidate faults by information and gradient. `is_cause`: whether a fault is a
    cause after a total step. `without_effect`: whether those are included that are no mistakes.
    """
    information, gradient = score.with_declared(tolerance=False)
    total, first = np.zeros(len(gradient)), 0.0
    for _ in range(MAX_CAUSES):
        released = (
            release_fault(pose_cov, score, fault, information, gradient)
            for fault in candidates(information, gradient)
        )
        every = [one for one in released if one is not None and one.is_possible]
        largest = max((one.gain for one in every), default=0.0)
        if largest < max(MIN_EVIDENCE, MIN_SHARE * first):
            return
        ranked = sorted(every, key=lambda one: -one.posterior_gain)
        cause = simplest(ranked)
        if not is_cause(cause, total):
            return
        first = max(first, cause.gain)
        total = total + cause.step
        if cause.is_mistake or without_effect:
            yield NamedCause(cause, rivals_of(cause, ranked), total)
        selected = information @ cause.cov
        gradient = gradient - information @ cause.step
        information = information - selected @ information


def simplest(ranked: list[ReleasedFault]) -> ReleasedFault:
    """Return the part of the first cause with the fewest parameters that explains a log as well."""
    own = _keys(ranked[0])
    parts = (one for one in _as_likely(ranked) if _keys(one) <= own)
    return min(parts, key=lambda one: one.fault.combine.shape[1], default=ranked[0])


def rivals_of(cause: ReleasedFault, ranked: list[ReleasedFault]) -> list[ReleasedFault]:
    """Return what explains a log as well as a cause, other than as a part of it."""
    own = _keys(cause)

    def is_other(one: ReleasedFault) -> bool:
        keys = _keys(one)
        return one.fault.code != cause.fault.code or not (keys <= own or own <= keys)

    return [one for one in _as_likely(ranked) if is_other(one)]


def _as_likely(ranked: list[ReleasedFault]) -> list[ReleasedFault]:
    return [one for one in ranked if one.posterior_gain > ranked[0].posterior_gain - MARGIN]


def _keys(cause: ReleasedFault) -> set[tuple[Parameter, str]]:
    return {block.key for block in cause.fault.blocks}


def _exceeds_residuals(case: Case, score: Score, one: ReleasedFault, before: Array) -> bool:
    """Return whether the evidence for a fault is more than any residual would give.

    Every candidate fits a part of a residual that none explains.
    """
    after = moved_estimate(case.result, score, score.allowed(before + one.step))
    rest = field_residual(case.result, after)
    excess = max(1.0, float(np.nanmean(rest**2))) if np.any(np.isfinite(rest)) else 1.0
    return one.gain / excess > MIN_EVIDENCE


def finding_of(site: Site, cause: ReleasedFault, rivals: Sequence[ReleasedFault] = ()) -> Finding:
    """Return the finding on a cause, and on others that explain the log as well."""
    position = float(np.sqrt(np.mean(np.sum(cause.moved[:, 3:] ** 2, axis=1))))
    rotation = float(np.rad2deg(np.sqrt(np.mean(np.sum(cause.moved[:, :3] ** 2, axis=1)))))
    mean = float(np.mean(cause.distance))
    if cause.fault.code == STRETCH:
        stretch = -float(np.linalg.lstsq(cause.fault.combine, cause.step, rcond=None)[0][0])
        result = f"all positions are {stretch:+.2g} % too far from the origin"
        remedy = "Multiply all positions by a common factor: check the tape, or the unit"
    elif cause.fault.code == SAMPLE_RATE:
        block = cause.fault.blocks[0]
        fast = -1e6 * float((block.sigma * cause.step[block.columns])[0])
        result = f"the stamps run {fast:+.3g} ppm fast against the drives"
        remedy = "Check the sample rate with which the stamps were made"
    elif cause.fault.code == EPOCH_SHIFT:
        late = float(np.linalg.lstsq(cause.fault.combine, cause.step, rcond=None)[0][0])
        # A field that is sampled before its stamp has the phase of an earlier time.
        side = "early" if late > 0.0 else "late"
        shift_ms = 1e3 * TYPICAL_SHIFT * abs(late)
        result = f"all stamps are {shift_ms:.3g} ms {side} against it"
        remedy = "Correct epoch_ns of the log, or the delay of the magnetometer's stamps"
    elif len(cause.fault.combine.T) == 1 and len(cause.fault.blocks) > 1:
        block = cause.fault.blocks[0]
        factor = float(np.exp(block.sigma * cause.step[block.columns])[0])
        longer = 100.0 * (factor ** (1.0 / 3.0) - 1.0)  # the field falls with the cube
        result = (
            f"all are {factor:.3g} times as large, or all distances of the survey"
            f" {longer:+.2g} % too long"
        )
        remedy = (
            "Correct the moments (peak, not rms; their unit), the magnetometer's matrix or the"
            " survey's unit, which have the same effect, or declare their sigma"
        )
    elif cause.fault.code == TILT:
        size = np.linalg.lstsq(cause.fault.combine, cause.step, rcond=None)[0]
        tilt = -np.rad2deg(TYPICAL_TILT * size)  # the step takes it back
        result = f"it is tilted by {tilt[0]:+.2g} deg about x and {tilt[1]:+.2g} deg about y"
        remedy = "Rotate positions and attitudes of all beacons back: world z is the plumb line"
    elif cause.code == "gravity_missing":
        result = f"{error_in_words(site, cause)}, as where it was removed from the specific force"
        remedy = "Record the specific force as the sensor measures it: +g on z at rest, level"
    else:
        result = error_in_words(site, cause)
        remedy = "Correct it by this amount, or declare a sigma of this size to estimate it"
    return Finding(
        cause.code,
        f"The log contradicts {cause.fault.name} as declared: {result}"
        f" ({float(sigmas(cause.log_p)):.0f} sigma). This moves the poses by"
        f" {100.0 * position:.2g} cm and {rotation:.2g} deg,"
        f" {np.sqrt(mean):.1f} times their reported sigma.{_alternatives(rivals)} {remedy}.",
        # A tilt is a rotation of the frame, whatever its size.
        Verdict.FAILED
        if mean > MAX_LINEAR_CHI_SQUARE and cause.fault.code != TILT
        else Verdict.DOUBTFUL,
        float(sigmas(cause.log_p)),
    )


def _alternatives(rivals: Sequence[ReleasedFault]) -> str:
    names = " or ".join(one.fault.name for one in rivals[:2])
    return f" An error of {names} would explain it as well." if names else ""


def _largest(cause: ReleasedFault) -> list[Block]:
    """Return the blocks of a candidate that change, the largest change first."""
    size = {b.name: float(np.max(np.abs(cause.step[b.columns]))) for b in cause.fault.blocks}
    moving = sorted(cause.fault.blocks, key=lambda b: -size[b.name])
    return [b for b in moving if size[b.name] > 0.1 * size[moving[0].name]][:4]


def error_in_words(site: Site, cause: ReleasedFault) -> str:
    """Return by how much the parameters of a cause are wrong."""
    sigma = np.sqrt(np.diagonal(cause.cov))
    return "; ".join(
        amounts(site, b, b.sigma * cause.step[b.columns], b.sigma * sigma[b.columns])
        for b in _largest(cause)
    )


def amounts(site: Site, block: Block, step: Array, sigma: Array) -> str:
    """Return the changes of a block's numbers in words, the largest first."""
    unit = block.parameter.display_unit
    order = np.argsort(-np.abs(step), kind="stable")[:3]
    return ", ".join(
        f"{block.parameter.called(site, block.owner, i)}"
        f" {step[i] / unit.size:+.3g} ± {sigma[i] / unit.size:.1g} {unit.text}".rstrip()
        for i in order.tolist()
    )


def _unverified(case: Case, score: Score) -> list[Unverified]:
    """Return fixed parameters that the log does not check, with their effect on the poses."""
    out, information = [], score.within_tolerance()
    for block in score.fixed:
        if block.parameter in (GYRO_BIAS, ACCEL_BIAS):  # the states estimate them
            continue
        rows = np.arange(len(score.information))[block.columns]
        declared = score.spread[rows]
        cov = declared @ declared.T
        root = np.linalg.cholesky(cov) if np.all(np.diagonal(cov) > 1e-12) else np.eye(len(rows))
        widest = np.where(np.diagonal(root) > 1.0, np.diagonal(root), 1.0)
        value, vector = np.linalg.eigh(widest[:, None] * information[np.ix_(rows, rows)] * widest)
        free_parameters = vector[:, value < UNCHECKED]
        if not free_parameters.shape[1]:
            continue
        by_pose = score.by_pose[..., rows]
        typical = by_pose @ (widest[:, None] * free_parameters)
        solved = np.linalg.solve(case.pose_cov, typical)
        if np.mean(np.sum(typical * solved, axis=(1, 2))) < COVERED:
            continue
        moved = by_pose @ root
        unit = block.parameter.display_unit
        largest = np.max(prior_sigma(score.fixed)[block.columns] * np.diagonal(root)) / unit.size
        out.append(
            Unverified(
                block.name,
                f"{largest:.3g} {unit.text}".rstrip(),
                float(np.sqrt(np.mean(np.sum(moved[:, 3:] ** 2, axis=(1, 2))))),
                float(np.rad2deg(np.sqrt(np.mean(np.sum(moved[:, :3] ** 2, axis=(1, 2)))))),
            )
        )
    return out
