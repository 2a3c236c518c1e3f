"""Tests of fixes, per epoch and over all: alternatives, open directions, residuals."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.data_checks.statistics import FALSE_ALARMS, log_p_chi_square
from magfusion.estimation.posterior.separation import POSE
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.priors import TOLERATED, unexplained
from magfusion.model.trust import Finding, StateTrust, Trust, Verdict, worst
from magfusion.units import Array, BoolArray, IntArray

RIVAL = 0.05  # posterior probability from which a second pose counts
MAX_OPEN_SHARE = 0.05  # share of epochs that may be open before the whole is in doubt


def judged_fixes(
    fixes: Fixes, states: StateTrust, numbers: IntArray
) -> tuple[Fixes, StateTrust, Trust]:
    """Inflate covariances for alternatives and residuals, and return the findings.

    The covariance of an epoch with an alternative is that of both poses with their posterior
    probabilities, about the first.  Errors of the survey are common to all epochs, so that all
    residuals are tested as one: the median's. `numbers` (n,): number of real values measured at
    each epoch.
    """
    rival = _rival(fixes)
    open_pose = ~fixes.determined[:, 0]
    chi_square, freedom = _chi_square(fixes, numbers)
    excess = np.where(freedom > 0.0, chi_square / np.maximum(freedom, 1.0), 0.0)
    unlikely = log_p_chi_square(chi_square, np.maximum(freedom, 1.0)) < np.log(
        FALSE_ALARMS / len(fixes)
    )
    odd = (excess > TOLERATED**2) & unlikely
    whole = unexplained(
        "the median epoch",
        float(np.median(chi_square)),
        float(np.median(freedom)),
        "Check positions, attitudes and drives of the beacons in the site.",
    )
    factor = np.maximum(np.where(odd, excess, 1.0), whole.excess)
    cov = fixes.pose_cov.copy()
    cov[:, 0] = factor[:, None, None] * cov[:, 0] + rival_spread(fixes, rival)
    doubtful = rival | open_pose | odd | bool(whole.findings)
    verdicts = tuple(
        worst((verdict, Verdict.DOUBTFUL)) if doubt else verdict
        for verdict, doubt in zip(states.verdict, doubtful.tolist(), strict=True)
    )
    findings = (*whole.findings, *_of_epochs(rival, open_pose, odd & ~bool(whole.findings)))
    return (replace(fixes, pose_cov=cov), replace(states, verdict=verdicts), Trust(findings))


def _rival(fixes: Fixes) -> BoolArray:
    share = fixes.probability
    return np.asarray(share[:, 1] > RIVAL) if share.shape[1] > 1 else np.zeros(len(fixes), bool)


def _chi_square(fixes: Fixes, numbers: IntArray) -> tuple[Array, Array]:
    """Return the chi square of each epoch's best pose and its degrees of freedom."""
    result = np.sum(fixes.phase[:, 0] != 0.0, axis=1) + np.sum(fixes.log_gain[:, 0] != 0.0, axis=1)
    known = 2.0 * (fixes.gravity_cost[:, 0] > 0.0)
    return fixes.cost[:, 0], np.maximum(numbers + known - POSE - result, 0.0)


def rival_spread(fixes: Fixes, rival: BoolArray) -> Array:
    """Return the contribution of alternatives to the best pose's covariance, shape (n, 6, 6)."""
    weight = np.where(rival[:, None], fixes.probability, 0.0)[:, 1:]
    best = np.swapaxes(fixes.world_from_body[:, :1], 2, 3)
    turn = Rotation.from_matrix((best @ fixes.world_from_body[:, 1:]).reshape(-1, 3, 3))
    way = fixes.position_world[:, 1:] - fixes.position_world[:, :1]
    shift = (best @ way[..., None])[..., 0]
    step = np.concatenate([turn.as_rotvec().reshape(shift.shape), shift], axis=2)
    return np.einsum("nh,nhi,nhj->nij", weight, step, step)


def _of_epochs(rival: BoolArray, open_pose: BoolArray, odd: BoolArray) -> Iterator[Finding]:
    """Yield findings for the epochs, doubtful if they are more than few."""
    for code, rows, what in (
        (
            "ambiguous",
            rival,
            "are ambiguous: fixes.parquet has every pose that explains them. Add a beacon,"
            " declare a hemisphere or region, or use smooth, which uses the motion.",
        ),
        (
            "geometry",
            open_pose,
            "do not determine a direction of the pose (undetermined in fixes.parquet). Add a beacon"
            " or a coil.",
        ),
        (
            "field_residuals",
            odd,
            "have residuals larger than noise and survey explain; there the covariance has been"
            " inflated. Look for passing iron, or a beacon with a temporary fault.",
        ),
    ):
        count, epochs = int(np.sum(rows)), len(rows)
        if count:
            verdict = Verdict.DOUBTFUL if count > MAX_OPEN_SHARE * epochs else Verdict.TRUSTWORTHY
            share = count / epochs / MAX_OPEN_SHARE
            yield Finding(code, f"{count} of {epochs} epochs {what}", verdict, share)
