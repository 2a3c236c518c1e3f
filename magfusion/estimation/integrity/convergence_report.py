"""Tests of the estimator's result: convergence, ambiguity and observability."""

from dataclasses import replace

import numpy as np
from scipy.spatial.distance import cdist

from magfusion.estimation.batch.hypothesis_selection import AMBIGUOUS_CHI_SQUARE
from magfusion.estimation.integrity.test_result import NOTHING, Case, TestResult
from magfusion.estimation.posterior.convergence import pose_steps
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.units import DEGREE, Array

DIVERGED = 3.0  # whitened residual, one where noise and model are as declared
MAX_FINAL_STEP_SIGMAS = (
    10.0  # sigmas of the last step of the poses, beyond which the result is arbitrary
)
ANY_ATTITUDE = np.pi / np.sqrt(3.0)  # rad; sigma of an angle of which nothing is known
OPEN_DEG, OPEN_SHARE = 20.0, 0.25  # sigma of attitude, and of position over the distance of the
# nearest beacon, beyond which a covariance does not describe where the platform may be


def convergence(case: Case) -> TestResult:
    """Test whether the iterations converged to a minimum of the cost."""
    result = case.result
    if result.converged:
        return NOTHING
    known, move = result.residual[np.isfinite(result.residual)], result.last_move
    residual = float(np.sqrt(np.mean(known**2))) if len(known) else 0.0
    moved = f"its last iteration moved the poses by {move:.2g} of their sigmas"
    if residual > DIVERGED:
        finding = Finding(
            "diverged",
            f"The smoother did not converge: {moved}, and its residual is {residual:.3g} (1 is"
            " expected). The log does not match the site: check positions, frequencies and drives"
            " of the beacons, the mounting, and the stamps.",
            Verdict.FAILED,
            residual / DIVERGED,
        )
    elif not result.start.determined.any():
        # The start was arbitrary, and so is the result.
        finding = Finding(
            "geometry",
            "The pose is unobservable, per epoch and over the log: the smoother did not converge."
            " Add a beacon or a coil, or record more motion.",
            Verdict.FAILED,
            10.0,
        )
    else:
        finding = Finding(
            "not_converged",
            f"The smoother did not converge: {moved}. Use a better survey, or a shorter part of"
            " the log (--start, --end).",
            Verdict.FAILED if move > MAX_FINAL_STEP_SIGMAS else Verdict.DOUBTFUL,
            1.0,
        )
    factor = np.full(len(case.pose_cov), 1.0 + min(move, MAX_FINAL_STEP_SIGMAS) ** 2)
    return TestResult((finding,), factor=factor)


def rivals(case: Case) -> TestResult:
    """Test whether another trajectory explains the log nearly as well."""
    result = case.result
    chi_square = result.rival_chi_square
    if chi_square is None or chi_square >= AMBIGUOUS_CHI_SQUARE:
        return NOTHING
    finding = Finding(
        "ambiguous",
        "Another trajectory, from a mirrored start, explains the log nearly as well (its chi square"
        f" is only {chi_square:.3g} larger). Add a beacon, or record more motion.",
        Verdict.DOUBTFUL,
        AMBIGUOUS_CHI_SQUARE / max(chi_square, 0.1),
    )
    if result.rival is None:
        return TestResult((finding,))
    away = pose_steps(result.states, result.rival)
    likely = 1.0 / (1.0 + np.exp(0.5 * max(chi_square, 0.0)))
    return TestResult((finding,), spread=likely * away[:, :, None] * away[:, None, :])


def geometry(case: Case) -> TestResult:
    """Test whether the pose is too poorly determined for its covariance to be meaningful."""
    site, states = case.result.declared.site, case.result.states
    if not site.beacons:
        return NOTHING
    widest = [
        np.sqrt(np.linalg.eigvalsh(case.pose_cov[:, k : k + 3, k : k + 3])[:, -1]) for k in (0, 3)
    ]
    places = np.array([beacon.position_world for beacon in site.beacons])
    away = np.linalg.norm(states.position_world[:, None] - places, axis=2).min(axis=1)
    share, turn = float(np.median(widest[1] / away)), float(np.rad2deg(np.median(widest[0])))
    if share < OPEN_SHARE and turn < OPEN_DEG:
        return NOTHING
    text = (
        f"The log barely determines the pose: its sigma is {np.median(widest[1]):.2g} m at"
        f" {np.median(away):.2g} m from the nearest beacon, and {turn:.2g} deg, along the worst"
        " direction. Add a beacon, reduce the distance, or record a longer log."
    )
    lost_epochs = share > 4.0 * OPEN_SHARE or turn > 4.0 * OPEN_DEG
    verdict = Verdict.FAILED if lost_epochs else Verdict.DOUBTFUL
    weight = max(share / OPEN_SHARE, turn / OPEN_DEG)
    return TestResult((Finding("geometry", text, verdict, weight),))


def with_width(trust: Trust, site: Site, position_world: Array, pose_cov: Array) -> Trust:
    """Return the findings, of which the first fails a result as uncertain as the site is large.

    Parameters
    ----------
    position_world : ndarray, shape (n, 3)
        Far from all beacons, their distance counts (m).
    pose_cov : ndarray, shape (n, 6, 6)
        Final, of rotation and position, body axes (rad^2, rad m, m^2).
    """
    if not trust.reasons or not site.beacons:
        return trust
    rotation, position = (
        float(np.sqrt(np.median(np.trace(pose_cov[:, part, part], axis1=1, axis2=2)) / 3.0))
        for part in (slice(0, 3), slice(3, 6))
    )
    places = np.array([beacon.position_world for beacon in site.beacons])
    away = float(np.median(np.min(cdist(position_world, places), axis=1)))
    if position < max(float(np.max(cdist(places, places))), away) and rotation < ANY_ATTITUDE:
        return trust
    first = trust.reasons[0]
    text = (
        f"{first.text} The result has a sigma of {position:.2g} m and {rotation / DEGREE:.2g} deg"
        " an axis, which is none."
    )
    failed = replace(first, text=text, verdict=Verdict.FAILED)
    findings = (failed if finding is first else finding for finding in trust.findings)
    return replace(trust, findings=tuple(findings))
