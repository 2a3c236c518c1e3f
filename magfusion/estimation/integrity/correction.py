"""Corrections: mistakes that explain a log, each with the site in which it is undone."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.change_detection import CHANGED
from magfusion.estimation.integrity.corrected_site import (
    corrected_by,
    corrected_site,
    estimated_blocks,
    released_blocks,
    wide_sigmas,
    with_bias_walk,
    with_sigmas,
)
from magfusion.estimation.integrity.fault_candidates import (
    LEVER_ARM,
    TYPICAL,
    FaultCandidate,
    fault_candidates,
)
from magfusion.estimation.integrity.fault_isolation import CAUSE_FIRST, Diagnosis
from magfusion.estimation.integrity.fixed_parameter_test import (
    MIN_EVIDENCE,
    amounts,
    error_in_words,
    finding_of,
)
from magfusion.estimation.integrity.hypothesis_tests import QUANTISED
from magfusion.estimation.integrity.released_fault import ReleasedFault, ReleaseGain, release_gain
from magfusion.estimation.integrity.score import Score
from magfusion.files.site_changes import changed_keys
from magfusion.model.imu_intrinsics import turn_of_imu
from magfusion.model.parameters import SENSOR_POSITION, Block, Calibration, initial_calibration
from magfusion.model.parameters.inertial import Bias
from magfusion.model.site import Site
from magfusion.model.trust import CORRECTED, Finding, Verdict
from magfusion.units import Array

T = TypeVar("T")

LITTLE = 2.0  # chi square for each parameter, below which a correction is not continued
MAX_SOLUTIONS = 2  # beside the first: a wrong log takes three times as long as a good one
REFINED = " The remedy is refined by the inertial data."


class Rival(NamedTuple):
    """What explains a log as well as a correction: it is one or the other."""

    name: str  # of a candidate fault of the corrected site, as which the rival would appear
    size: Array  # of that fault, along its directions
    spread: Array  # (states or 1, 6, 6), covariance of the poses by it
    is_frame: bool = False  # whether only the frame of the result differs, and the lever arm

    @property
    def key(self) -> str:
        """A name of its own: a lever arm may be a rival as the other frame, and as such."""
        return f"{self.name} (frame)" if self.is_frame else self.name


class Correction(NamedTuple):
    """A mistake that explains a log."""

    finding: Finding  # what is wrong
    site: Site  # in which it is undone
    fault: FaultCandidate | None = None  # if it is of a fixed parameter
    rivals: tuple[Rival, ...] = ()
    step_spread: Array | None = None  # (states or 1, 6, 6), by the uncertainty of the step
    clear: bool = False  # whether snapshots of the fields alone are sure of it
    # whether they estimate values of parameters, and do not choose among usual mistakes
    is_estimate: bool = False
    # what is tried instead where the corrected result is contradicted
    alternative: "Correction | None" = None
    # (h,), by which the score moves the fixed parameters, in typical errors
    step: Array | None = None
    words: str = ""  # by how much they are wrong, as in the finding
    released: tuple[Block, ...] = ()  # parameters that the corrected solution estimates
    is_alternative: bool = False  # whether it takes the place of one that was contradicted

    @property
    def is_estimated(self) -> bool:
        """Whether the corrected solution estimates what was wrong."""
        fault = self.fault
        of_states = fault is not None and isinstance(fault.blocks[0].parameter, Bias)
        return of_states or bool(self.released)


class Trial(NamedTuple, Generic[T]):
    """A solution with a corrected site."""

    result: T
    explains_all: bool  # whether no test contradicts it
    explains_most: bool  # whether a gross mistake is undone, with a small rest
    remainder: Correction | None  # with the rest that it shows


def corrections(
    site: Site,
    findings: tuple[Finding, ...],
    causes: tuple[ReleasedFault, ...],
    diagnosis: Diagnosis | None,
) -> list[Correction]:
    """Return what may be corrected, the most likely first.

    `findings`: that of the first cause is among them. `causes`: the cause by the score of fixed
    parameters, and what explains the log as well. `diagnosis`: by snapshots of the fields and by
    the motion.
    """
    result: list[Correction] = []
    if diagnosis is not None and diagnosis.finding.code == QUANTISED:
        return result  # no parameter undoes what steps distort
    finding = next((f for f in findings if causes and f.code == causes[0].code), None)
    if finding is not None and finding.code == CHANGED:
        result.append(Correction(finding, with_bias_walk(site, causes[0])))
    elif finding is not None:
        result.append(_by_score(site, finding, *causes))
    if diagnosis is not None and diagnosis.site is not None:
        by_snapshots = _by_snapshots(site, diagnosis)
        result.insert(0 if by_snapshots.clear else len(result), by_snapshots)
    return result


def _by_score(
    site: Site, finding: Finding, best: ReleasedFault, *rivals: ReleasedFault
) -> Correction:
    """Return the correction of a cause by the score, with its rival."""
    weight = np.exp([0.5 * (rival.posterior_gain - best.posterior_gain) for rival in rivals])
    others = [
        Rival(one.fault.name, _along(one.fault, one.step), share * _outer(one.moved - best.moved))
        for one, share in zip(rivals, weight / (1.0 + np.sum(weight)), strict=True)
    ]
    other = next((one for one in rivals if one.code != CHANGED), None)  # no site undoes a step
    known = Correction(
        finding,
        corrected_by(site, best),
        best.fault,
        alternative=None if other is None else _by_score(site, finding_of(site, other), other),
        step=best.step,
        words=error_in_words(site, best),
    )
    return known._replace(rivals=(*others, *_other_frame(site, known.site, 0.5)))


def _along(fault: FaultCandidate, step: Array) -> Array:
    """Return a step along the directions of a candidate fault."""
    return np.asarray(np.linalg.lstsq(fault.combine, step, rcond=None)[0])


def _by_snapshots(site: Site, diagnosis: Diagnosis) -> Correction:
    """Return the correction that snapshots suggest, with its rival."""
    assert diagnosis.site is not None
    known = Correction(
        diagnosis.finding,
        diagnosis.site,
        clear=diagnosis.is_clear,
        is_estimate=diagnosis.is_estimate,
    )
    known = known._replace(rivals=_other_frame(site, known.site, diagnosis.rival_probability))
    other = diagnosis.rival
    if other is None or other.site is None:
        return known
    # It is tried only where the first is contradicted: its frame is no longer in question.
    return known._replace(
        alternative=known._replace(finding=other.finding, site=other.site, rivals=())
    )


def best_trial(
    possible: Iterable[Correction],
    tried: Callable[[Correction], Trial[T] | None],
    maximum: int = MAX_SOLUTIONS,
) -> T | None:
    """Return the result by the correction that explains a log; None where none does.

    `possible`: the most likely first; a remainder, or a rival of what is contradicted, comes before
    others. `tried`: returns the trial of a correction, None where it has no solution. `maximum`:
    number of trials.
    """
    waiting, best, continues = list(possible), None, False
    for _ in range(maximum):
        if not waiting:
            break
        correction = waiting.pop(0)
        trial = tried(correction)
        remainder = None if trial is None else trial.remainder
        explains_all = trial is not None and trial.explains_all
        explains_most = trial is not None and trial.explains_most
        replaces = best is None or (continues and not best.explains_all)
        if explains_all or (explains_most and replaces):
            best = trial
        continues = remainder is not None
        if remainder is not None:
            further: Correction | None = remainder._replace(finding=_refined(correction))
        else:
            further = None if explains_all else correction.alternative
        if further is not None:
            # By the score a rival is as likely as what the snapshots suggest, and less clear.
            is_rest = remainder is not None or correction.fault is None
            waiting.insert(0 if is_rest else len(waiting), further)
        elif best is not None and best is trial:
            break
    return None if best is None else best.result


def _refined(correction: Correction) -> Finding:
    """Return the finding of a correction that is continued: snapshots knew the value roughly."""
    finding = correction.finding
    if correction.fault is not None:
        return finding
    return replace(finding, text=finding.text + REFINED)


def corrected_finding(
    correction: Correction, declared: Site, reasons: Iterable[Finding]
) -> Finding:
    """Return the reason of a corrected result: with its remedy, and what it explains.

    `declared`: as given by the user. `reasons`: why the result without the correction is not
    trustworthy.
    """
    known = correction.finding
    codes = (code for f in reasons for code in (f.code, *f.explained))
    explained = dict.fromkeys(code for code in codes if code != known.code)
    return replace(
        known,
        text=f"{known.text} {CORRECTED}",
        verdict=Verdict.DOUBTFUL,
        weight=CAUSE_FIRST,
        remedy=changed_keys(declared, correction.site),
        explained=tuple(explained),
    )


def released(correction: Correction, declared: Site, groups: tuple[str, ...] | None) -> Correction:
    """Return a correction whose parameters are estimated, where their groups are (None: all)."""
    if correction.fault is not None and correction.step is not None:
        blocks, step = released_blocks(correction.fault), correction.step
        sizes = [float(np.linalg.norm(one.sigma * step[one.columns])) for one in blocks]
    else:
        is_estimate = correction.fault is None and correction.is_estimate
        blocks = estimated_blocks(declared, correction.site) if is_estimate else ()
        sizes = [float(one.sigma[0]) for one in blocks]
    sigmas = wide_sigmas(declared, blocks, sizes)
    if not blocks or (groups is not None and any(b.group not in groups for b in blocks)):
        return correction
    site = with_sigmas(initial_calibration(correction.site, 0.0), blocks, sigmas)
    return correction._replace(site=site, released=blocks)


def as_estimated(
    correction: Correction,
    declared: Site,
    fitted: Calibration,
    blocks: tuple[Block, ...],
    cov: Array,
) -> Correction:
    """Return a correction with the values that the corrected solution estimates.

    Parameters
    ----------
    declared : Site
        As given by the user.
    fitted, blocks, cov
        Estimated calibration, its blocks, and their covariance.
    """
    own = tuple(b for b in blocks if any(b.key == one.key for one in correction.released))
    if not own:
        return correction
    before, tried = (initial_calibration(site, 0.0) for site in (declared, correction.site))
    after = tried
    sigmas, words = [np.sqrt(np.diagonal(cov))[block.columns] for block in own], []
    for block, sigma in zip(own, sigmas, strict=True):
        parameter, owner = block.parameter, block.owner
        after = parameter.moved(after, owner, parameter.difference(tried, fitted, owner))
        change = parameter.difference(before, fitted, owner)
        words.append(amounts(declared, block, change, sigma))
    finding = correction.finding if correction.words else _refined(correction)
    if correction.words:
        text = finding.text.replace(correction.words, "; ".join(words))
        finding = replace(finding, text=text)
    # A remedy has no correlations: what is common to several beacons stays as uncertain as it is.
    kinds = Counter(block.parameter for block in own)
    wide = [np.sqrt(kinds[b.parameter]) * s for b, s in zip(own, sigmas, strict=True)]
    return correction._replace(finding=finding, site=with_sigmas(after, own, wide))


def _other_frame(declared: Site, corrected: Site, probability: float) -> tuple[Rival, ...]:
    """Return the other of two frames where a magnetometer or an IMU is corrected for a turn.

    They differ by the frame of the result and the lever arm only.
    """
    before, after = declared.platform, corrected.platform
    one, other = before.magnetometer, after.magnetometer
    turn = Rotation.from_matrix(other.body_from_sensor @ one.body_from_sensor.T)
    turn *= turn_of_imu(before.imu_intrinsics, after.imu_intrinsics)
    turn_body = turn.as_rotvec()
    if not turn_body.any():
        return ()
    # The magnetometer stays where it is found; the body moves about it.
    shift_body = other.position_body - turn.apply(one.position_body)
    spread = probability * _outer(np.concatenate([turn_body, shift_body])[None])
    size = -shift_body / TYPICAL[SENSOR_POSITION]
    return (Rival(LEVER_ARM, size, spread, is_frame=True),)


def _outer(step: Array) -> Array:
    return np.asarray(step[:, :, None] * step[:, None, :])


def _remaining(correction: Correction, score: Score | None) -> ReleaseGain | None:
    """Return the estimate of what a corrected parameter is still wrong by.

    Snapshots determine a parameter by the fields alone, the score by the whole motion.
    """
    is_open = correction.is_estimate and not correction.released
    if score is None or not (correction.fault or is_open):
        return None
    every = fault_candidates(correction.site, score.fixed)
    if correction.fault is not None:
        own = [one for one in every if one.name == correction.fault.name]
    else:
        own = [one for one in every if one.finding_code == correction.finding.code]
    gains = (release_gain(one, *score.with_declared(tolerance=False)) for one in own)
    return max(filter(None, gains), key=lambda one: one.chi_square, default=None)


def continued(correction: Correction, score: Score | None) -> Correction | None:
    """Return a correction with the rest that the corrected result shows; None if it is small.

    `score`: of the corrected result.
    """
    rest = _remaining(correction, score)
    if rest is None or rest.chi_square < LITTLE * rest.freedom:
        return None
    new_site = corrected_site(correction.site, rest.fault, rest.step)
    return correction._replace(site=new_site, fault=rest.fault, step=rest.step, released=())


def open_rivals(
    correction: Correction,
    candidates: Sequence[FaultCandidate],
    information: Array,
    gradient: Array,
) -> list[Rival]:
    """Return the rivals of a correction that the corrected data do not refute.

    Where the corrected solution estimates what was wrong, a rival appears as an error of its size
    in another parameter. `information`, `gradient`: of all fixed parameters, and others after them.
    """

    def is_refuted(rival: Rival) -> bool:
        candidate = next((one for one in candidates if one.name == rival.name), None)
        if candidate is None or not (rival.is_frame or correction.is_estimated):
            return False
        combine = np.zeros((len(gradient), candidate.combine.shape[1]))
        combine[: len(candidate.combine)] = candidate.combine
        known = combine.T @ information @ combine
        rest = combine.T @ gradient - known @ rival.size
        # Twice the increase of the cost from the estimate to that size.
        return float(rest @ np.linalg.pinv(known) @ rest) > MIN_EVIDENCE

    return [rival for rival in correction.rivals if not is_refuted(rival)]


def _of_states(spread: Array, count: int) -> Array:
    """Return a covariance of some states for a number of others."""
    return spread if len(spread) in (1, count) else np.mean(spread, axis=0, keepdims=True)


def spread_with_rivals(correction: Correction, score: Score | None) -> Array:
    """Return the covariance as `spread_of`, and by what explains the log as well."""
    spread, rivals = spread_of(correction, score), list(correction.rivals)
    if score is not None:
        candidates = list(fault_candidates(correction.site, score.fixed))
        rivals = open_rivals(correction, candidates, *score.with_declared(tolerance=False))
    for rival in rivals:
        spread = spread + _of_states(rival.spread, 1 if score is None else len(score.by_pose))
    return spread


def spread_of(correction: Correction, score: Score | None) -> Array:
    """Return the covariance of the poses by the uncertainty of a correction, and its remainder.

    Without that by its rivals.
    """
    spread = np.zeros((1, 6, 6))
    if correction.step_spread is not None and not correction.is_estimated:
        spread = correction.step_spread
    rest = _remaining(correction, score)
    if rest is None or score is None:
        return spread
    by_pose = score.by_pose
    spread = _of_states(spread, len(by_pose)) + by_pose @ rest.known_cov @ np.swapaxes(
        by_pose, 1, 2
    )
    if rest.chi_square < LITTLE * rest.freedom:
        return np.asarray(spread)
    return np.asarray(spread + _outer(by_pose @ rest.step))
