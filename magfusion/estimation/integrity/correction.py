"""Corrections: mistakes that explain a log, each with the site in which it is undone."""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.integrity.corrected_site import corrected_site
from magfusion.estimation.integrity.diagnosis import Diagnosis
from magfusion.estimation.integrity.released_fault import ReleasedFault, ReleaseGain, release_gain
from magfusion.estimation.integrity.score import Score
from magfusion.estimation.integrity.suspects import Suspect, suspects
from magfusion.files.site_changes import changed_keys
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.units import Array

LITTLE = 2.0  # chi square for each parameter, below which a correction is not continued
MOST_SOLUTIONS = 2  # beside the first: a wrong log takes three times as long as a good one
CAUSE_FIRST = 1e6  # weight
CORRECTED = " The result is corrected for it."
REFINED = " The remedy has what the corrected log then still showed of it, too."
CLEAR = 30.0  # ratio of chi square by which snapshots decide before the score, which is linear


class Correction(NamedTuple):
    """A mistake that explains a log.

    Parameters
    ----------
    finding : Finding
        What is wrong.
    site : Site
        In which it is undone.
    fault : named tuple, optional
        The candidate fault, if it is an incorrect fixed parameter.
    spread : ndarray, shape (states or 1, 6, 6), optional
        Covariance of the poses by other mistakes that would explain the log as well.
    clear : bool
        Whether snapshots of the fields alone are sure of it.
    is_estimate : bool
        Whether they estimate values of parameters, and do not choose among usual mistakes.
    rival_probability : float
        Of a mounting: probability that not it, but the IMU is turned, or the reverse.
    """

    finding: Finding
    site: Site
    fault: Suspect | None = None
    spread: Array | None = None
    clear: bool = False
    is_estimate: bool = False
    rival_probability: float = 0.5


def corrections(
    site: Site,
    findings: tuple[Finding, ...],
    causes: tuple[ReleasedFault, ...],
    diagnosis: Diagnosis | None,
) -> list[Correction]:
    """Return what may be corrected, the most likely first.

    Parameters
    ----------
    findings : tuple of Finding
        That of the first cause is among them.
    causes : tuple of ReleasedFault
        The cause by the score of fixed parameters, and what explains the log as well.
    diagnosis : Diagnosis, optional
        By snapshots of the fields and by the motion.
    """
    result: list[Correction] = []
    finding = next((f for f in findings if causes and f.code == causes[0].code), None)
    if finding is not None:
        best, *rivals = causes
        weight = np.exp([0.5 * (rival.gain - best.gain) for rival in rivals])
        spread = np.zeros((len(best.moved), 6, 6))
        for rival, share in zip(rivals, weight / (1.0 + np.sum(weight)), strict=True):
            spread += share * _outer(rival.moved - best.moved)
        new_site = corrected_site(site, best.fault, best.step)
        result.append(Correction(finding, new_site, best.fault, spread))
    clear = is_clear(diagnosis)
    by_snapshots = _by_snapshots(diagnosis, clear)
    return by_snapshots + result if clear else result + by_snapshots


def _by_snapshots(diagnosis: Diagnosis | None, clear: bool) -> list[Correction]:
    """Return what snapshots explain, and its rival."""
    if diagnosis is None or diagnosis.site is None:
        return []
    known, rival = diagnosis.rival_probability, diagnosis.rival
    both = [(diagnosis, known)] + ([] if rival is None else [(rival, 1.0 - known)])
    return [
        Correction(
            d.finding, d.site, clear=clear, is_estimate=d.is_estimate, rival_probability=probability
        )
        for d, probability in both
        if d.site is not None
    ]


def corrected_finding(
    correction: Correction, declared: Site, reasons: Iterable[Finding]
) -> Finding:
    """Return the reason of a corrected result: with its remedy, and what it explains.

    Parameters
    ----------
    declared : Site
        As given by the user.
    reasons : iterable of Finding
        Why the result without the correction is not trustworthy.
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


def is_clear(diagnosis: Diagnosis | None) -> bool:
    """Return whether snapshots decide, whatever the linear score."""
    return diagnosis is not None and diagnosis.ratio > CLEAR


def with_rival_frame(site: Site, correction: Correction) -> Array | None:
    """Return the spread of a correction, of a mounting with that of an IMU that is turned instead.

    Nothing but the frame of the result and the lever arm distinguish them.

    Parameters
    ----------
    site : Site
        As declared.
    """
    before, after = (one.platform.magnetometer for one in (site, correction.site))
    turn = Rotation.from_matrix(after.body_from_sensor @ before.body_from_sensor.T)
    intrinsics = correction.site.platform.imu_intrinsics
    if intrinsics is not None and intrinsics is not site.platform.imu_intrinsics:
        turn *= _turn_of(intrinsics.gyro_matrix, intrinsics.accel_matrix)
    turn_body = turn.as_rotvec()
    if not turn_body.any():
        return correction.spread
    # The magnetometer stays where it is found; the body moves about it.
    shift_body = after.position_body - turn.apply(before.position_body)
    step = np.concatenate([turn_body, shift_body])[None]
    spread = correction.rival_probability * _outer(step)
    return spread if correction.spread is None else spread + correction.spread


def _turn_of(gyro: Array, accel: Array) -> Rotation:
    """Return how the body would be turned whose axes are those of a turned IMU."""
    rotated = np.array_equal(gyro, accel) and np.allclose(gyro @ gyro.T, np.eye(3))
    if not rotated or np.linalg.det(gyro) < 0:
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
    name = "" if correction.fault is None else correction.fault.name
    every = [one for one in suspects(correction.site, score.fixed) if name in ("", one.name)]
    gains = [release_gain(one, *score.with_declared(tolerance=False)) for one in every]
    own = [one for one in gains if one and (name or one.code == correction.finding.code)]
    return max(own, key=lambda one: one.chi_square, default=None)


def continued(correction: Correction, score: Score | None) -> Correction | None:
    """Return a correction with the rest that the corrected result shows; None if it is small.

    Parameters
    ----------
    score : Score, optional
        Of the corrected result.
    """
    rest = _remaining(correction, score)
    if rest is None or rest.chi_square < LITTLE * rest.freedom:
        return None
    new_site = corrected_site(correction.site, rest.fault, rest.step)
    return correction._replace(site=new_site, fault=rest.fault)


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
