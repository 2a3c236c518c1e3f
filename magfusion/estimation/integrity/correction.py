"""Corrections: mistakes that explain a log, each with the site in which it is undone."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.corrected_site import (
    corrected_site,
    released_blocks,
    with_sigmas,
    with_wide_priors,
)
from magfusion.estimation.integrity.diagnosis import CAUSE_FIRST, Diagnosis
from magfusion.estimation.integrity.fixed_parameter_test import (
    amounts,
    error_in_words,
    finding_of,
)
from magfusion.estimation.integrity.likely_cause import QUANTISED
from magfusion.estimation.integrity.released_fault import ReleasedFault, ReleaseGain, release_gain
from magfusion.estimation.integrity.score import Score
from magfusion.estimation.integrity.suspects import Suspect, suspects
from magfusion.files.site_changes import changed_keys
from magfusion.model.imu_intrinsics import ImuIntrinsics
from magfusion.model.parameters import Block, Calibration, initial_calibration
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array

T = TypeVar("T")

LITTLE = 2.0  # chi square for each parameter, below which a correction is not continued
MOST_SOLUTIONS = 2  # beside the first: a wrong log takes three times as long as a good one
CORRECTED = " The result is corrected for it."
REFINED = " The remedy is refined by the inertial data."


class Correction(NamedTuple):
    """A mistake that explains a log."""

    finding: Finding  # what is wrong
    site: Site  # in which it is undone
    fault: Suspect | None = None  # the candidate fault, if it is an incorrect fixed parameter
    # (states or 1, 6, 6), covariance of the poses by other mistakes that would explain the log as
    # well
    spread: Array | None = None
    clear: bool = False  # whether snapshots of the fields alone are sure of it
    # whether they estimate values of parameters, and do not choose among usual mistakes
    is_estimate: bool = False
    # what is tried instead where the corrected result is contradicted
    rival: "Correction | None" = None
    # (h,), by which the score moves the fixed parameters, in typical errors
    step: Array | None = None
    words: str = ""  # by how much they are wrong, as in the finding
    released: tuple[Block, ...] = ()  # parameters that the corrected solution estimates
    is_rival: bool = False  # whether it takes the place of one that was contradicted


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
    if finding is not None:
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
    spread = np.zeros((len(best.moved), 6, 6))
    for rival, share in zip(rivals, weight / (1.0 + np.sum(weight)), strict=True):
        spread += share * _outer(rival.moved - best.moved)
    known = Correction(
        finding,
        corrected_site(site, best.fault, best.step),
        best.fault,
        spread,
        rival=_by_score(site, finding_of(site, rivals[0]), rivals[0]) if rivals else None,
        step=best.step,
        words=error_in_words(site, best),
    )
    return known._replace(spread=_with_rival_frame(site, known, 0.5))


def _by_snapshots(site: Site, diagnosis: Diagnosis) -> Correction:
    """Return the correction that snapshots suggest, with its rival."""
    assert diagnosis.site is not None
    known = Correction(
        diagnosis.finding,
        diagnosis.site,
        clear=diagnosis.is_clear,
        is_estimate=diagnosis.is_estimate,
    )
    spread = _with_rival_frame(site, known, diagnosis.rival_probability)
    other = diagnosis.rival
    if other is None or other.site is None:
        return known._replace(spread=spread)
    # It is tried only where the first is contradicted: its frame is no longer in question.
    return known._replace(
        spread=spread, rival=known._replace(finding=other.finding, site=other.site)
    )


def best_trial(
    possible: Iterable[Correction], tried: Callable[[Correction], Trial[T] | None]
) -> T | None:
    """Return the result by the correction that explains a log; None where none does.

    `possible`: the most likely first; a remainder, or a rival of what is contradicted, comes before
    others. `tried`: returns the trial of a correction, None where it has no solution.
    """
    waiting, best, continues = list(possible), None, False
    for _ in range(MOST_SOLUTIONS):
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
            further = None if explains_all else correction.rival
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
        text=known.text + CORRECTED,
        verdict=Verdict.DOUBTFUL,
        weight=CAUSE_FIRST,
        remedy=changed_keys(declared, correction.site),
        explained=tuple(explained),
    )


def released(correction: Correction, groups: tuple[str, ...] | None) -> Correction:
    """Return a correction whose parameters are estimated, where their groups are (None: all)."""
    if correction.fault is None or correction.step is None:
        return correction
    blocks = released_blocks(correction.fault)
    if not blocks or (groups is not None and any(b.group not in groups for b in blocks)):
        return correction
    site = with_wide_priors(correction.site, blocks, correction.step)
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
    finding = correction.finding
    if correction.words:
        text = finding.text.replace(correction.words, "; ".join(words))
        finding = replace(finding, text=text)
    return correction._replace(finding=finding, site=with_sigmas(after, own, sigmas))


def _with_rival_frame(site: Site, correction: Correction, probability: float) -> Array | None:
    """Return the spread of a correction, with that of the other of two frames.

    A turned magnetometer and a turned IMU differ by the frame of the result and the lever arm only.
    `site`: as declared. `probability`: of the other frame.
    """
    before, after = (one.platform for one in (site, correction.site))
    one, other = before.magnetometer, after.magnetometer
    turn = Rotation.from_matrix(other.body_from_sensor @ one.body_from_sensor.T)
    turn *= _turn_of_imu(before.imu_intrinsics, after.imu_intrinsics)
    turn_body = turn.as_rotvec()
    if not turn_body.any():
        return correction.spread
    # The magnetometer stays where it is found; the body moves about it.
    shift_body = other.position_body - turn.apply(one.position_body)
    spread = probability * _outer(np.concatenate([turn_body, shift_body])[None])
    return spread if correction.spread is None else spread + correction.spread


def _turn_of_imu(before: ImuIntrinsics | None, after: ImuIntrinsics | None) -> Rotation:
    """Return the rotation to the axes of an IMU that is corrected for being turned."""
    known, result = before or ImuIntrinsics(), after or ImuIntrinsics()
    gyro = np.linalg.solve(known.gyro_matrix, result.gyro_matrix)
    accel = np.linalg.solve(known.accel_matrix, result.accel_matrix)
    is_turned = np.allclose(gyro, accel) and np.allclose(gyro @ gyro.T, np.eye(3))
    if not is_turned or np.linalg.det(gyro) < 0.0:
        return Rotation.identity()
    return Rotation.from_matrix(gyro.T)


def _outer(step: Array) -> Array:
    return np.asarray(step[:, :, None] * step[:, None, :])


def _remaining(correction: Correction, score: Score | None) -> ReleaseGain | None:
    """Return the estimate of what a corrected parameter is still wrong by.

    Snapshots determine a parameter by the fields alone, the score by the whole motion.
    """
    if score is None or not (correction.fault or correction.is_estimate):
        return None
    every = suspects(correction.site, score.fixed)
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


def spread_of(correction: Correction, score: Score | None) -> Array:
    """Return the covariance of the poses by the uncertainty of a correction, and its remainder."""
    spread = np.zeros((1, 6, 6)) if correction.spread is None else correction.spread
    rest = _remaining(correction, score)
    if rest is None or score is None:
        return spread
    by_pose = score.by_pose
    if len(spread) not in (1, len(by_pose)):  # of the states before the correction
        spread = np.mean(spread, axis=0, keepdims=True)
    spread = spread + by_pose @ rest.known_cov @ np.swapaxes(by_pose, 1, 2)
    if rest.chi_square < LITTLE * rest.freedom:
        return np.asarray(spread)
    return np.asarray(spread + _outer(by_pose @ rest.step))
