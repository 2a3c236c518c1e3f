"""Poses of a platform whose receiver has one axis, and their findings."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.data_checks.statistics import FALSE_ALARMS, log_p_chi_square
from magfusion.estimation.snapshot.coil_fix import CoilFixes
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.fix_consistency import rival_spread
from magfusion.estimation.snapshot.priors import unexplained
from magfusion.model.field import skew
from magfusion.model.one_axis import ANY_ROLL, CIRCLE, axis_of, coil_lever, least_turn
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, StateTrust, Trust, Verdict
from magfusion.model.truth_poses import truth_poses
from magfusion.units import Array, BoolArray

AMBIGUOUS = 0.05  # posterior share from which an alternative is reported
MAX_OPEN_SHARE = 0.1  # share of the epochs; a larger one casts doubt


def poses_of(result: CoilFixes, time: Array, site: Site, *, signed: bool) -> Fixes:
    """Return the poses for a coil's positions and directions, with an arbitrary, open roll.

    The smallest rotation that aligns the axis is selected, so that equal epochs have equal poses.
    `time` (n,) (s). `signed`: whether the sense of the axis is known.
    """
    sensor = site.platform.magnetometer
    lever_body, sigma = coil_lever(sensor), sensor.sigma
    gain = np.linalg.norm(result.axis_world, axis=-1)
    towards = result.axis_world / gain[..., None]
    rotation = least_turn(axis_of(sensor), towards)
    back = np.swapaxes(rotation, -1, -2)
    lever = rotation @ lever_body
    # By rotation (world axes) and position of the coil: the body moves about the coil.
    by_axis = np.zeros((*gain.shape, 6, 6))
    by_axis[..., :3, 3:] = skew(towards) / gain[..., None, None]
    by_axis[..., 3:, :3] = np.eye(3)
    by_axis[..., 3:, 3:] = skew(lever) @ by_axis[..., :3, 3:]
    cov = by_axis @ result.cov @ np.swapaxes(by_axis, -1, -2)
    cov += ANY_ROLL**2 * _outer(np.concatenate([towards, np.cross(lever, towards)], axis=-1))
    along = np.sum(lever * towards, axis=-1, keepdims=True) * towards
    cov[..., 3:, 3:] += CIRCLE * _outer(lever - along)  # about the coil on a circle, not a tangent
    if not signed:  # at twice the distance in half of the cases
        cov[..., 3:, 3:] += 2.0 * _outer(along)
    body = np.zeros_like(cov)
    body[..., :3, :3] = body[..., 3:, 3:] = back
    cov = body @ cov @ np.swapaxes(body, -1, -2)
    turn = sensor.body_from_sensor * sensor.sigma.rotation_sensor
    cov[..., :3, :3] += turn @ turn.T
    cov[..., 3:, 3:] += np.diag(sigma.position_body**2)
    shape = (*gain.shape, len(site.channels))
    freedom = np.maximum(result.freedom, 1.0)[:, None]
    return Fixes(
        time=time,
        world_from_body=rotation,
        position_world=result.position_world - lever,
        pose_cov=cov,
        cost=result.cost,
        residual_rms=np.sqrt(result.cost / freedom),
        phase=np.zeros(shape),
        determined=np.zeros(gain.shape, dtype=bool),  # the roll is never determined
        log_gain=np.broadcast_to(np.log(gain)[..., None], shape).copy(),
        gravity_cost=np.zeros(gain.shape),
        prior_cost=np.zeros(gain.shape),
    )


def _outer(vector: Array) -> Array:
    return np.asarray(vector[..., :, None] * vector[..., None, :])


def axis_sigma(result: CoilFixes) -> Array:
    """Return the standard deviation of the axis' direction, shape (n, hypotheses) (rad)."""
    gain = np.linalg.norm(result.axis_world, axis=-1)
    across = skew(result.axis_world / gain[..., None]) / gain[..., None, None]
    square = across @ result.cov[..., 3:, 3:] @ np.swapaxes(across, -1, -2)
    return np.asarray(np.sqrt(0.5 * np.trace(square, axis1=-2, axis2=-1)))


def nearest_truth(truth: Trajectory, poses: Trajectory, site: Site, *, signed: bool) -> Trajectory:
    """Return the true poses, rotated about the coil to the roll (and sign) selected by a fix.

    An error against them is one of position and direction: of five degrees of freedom.
    """
    true, there, _ = truth_poses(truth, poses.time)
    if not len(true):
        return truth
    sensor, chosen = site.platform.magnetometer, poses.world_from_body[there]
    lever, axis = coil_lever(sensor), axis_of(sensor)
    coil = true.position_world + true.world_from_body @ lever
    result, actual = chosen @ axis, true.world_from_body @ axis
    if not signed:
        actual = actual * np.where(np.sum(result * actual, axis=1) < 0.0, -1.0, 1.0)[:, None]
    rotated = least_turn(result, actual) @ chosen
    return Trajectory(true.time, rotated, coil - rotated @ lever)


def nearest_reported(fixes: Fixes, truth: Trajectory, site: Site) -> tuple[Trajectory, BoolArray]:
    """Return the hypothesis nearest to the truth at each epoch, and where it is not the first.

    `fixes`: as `JudgedPoses.alone`.
    """
    true, there, _ = truth_poses(truth, fixes.time)
    rows = np.arange(len(fixes))
    chosen = np.zeros(len(fixes), dtype=np.int64)
    lever = coil_lever(site.platform.magnetometer)
    coil = true.position_world + true.world_from_body @ lever
    result = fixes.position_world[there] + fixes.world_from_body[there] @ lever
    away = np.linalg.norm(result - coil[:, None], axis=2)
    reported = fixes.probability[there] > AMBIGUOUS
    reported[:, 0] = True
    chosen[there] = np.argmin(np.where(reported, away, np.inf), axis=1)
    nearest = Trajectory(
        fixes.time,
        fixes.world_from_body[rows, chosen],
        fixes.position_world[rows, chosen],
        pose_cov=fixes.pose_cov[rows, chosen],
    )
    return nearest, chosen > 0


@dataclass(frozen=True, eq=False)
class JudgedPoses:
    """Poses whose covariances cover alternatives and residuals, with findings."""

    fixes: Fixes
    alone: Fixes  # each with the covariance of its own hypothesis
    states: StateTrust
    trust: Trust


def judged_poses(fixes: Fixes, result: CoilFixes, left_out: int, *, signed: bool) -> JudgedPoses:
    """Return the verdict on each pose and on all.

    `left_out`: epochs with too few channels.
    """
    count = len(fixes)
    log_p = log_p_chi_square(result.cost[:, 0], np.maximum(result.freedom, 1.0))
    odd = (result.freedom >= 1.0) & (log_p < np.log(FALSE_ALARMS / count))
    share, open_ = fixes.probability, ~result.determined[:, 0]
    rival = share[:, 1] > AMBIGUOUS if share.shape[1] > 1 else np.zeros(count, dtype=bool)
    roll = (
        "A receiver of one axis does not determine the roll about it: an arbitrary roll is given,"
        " with the sigma of an unknown one. Only errors of position and direction are meaningful."
    )
    rotated = "" if signed else " Amplitudes have no sign: the axis may point the other way."
    median = float(np.median(result.cost[:, 0])), float(np.median(result.freedom))
    remedy = "Check the beacons, or if the common gain is not as declared, use --free gain."
    whole = unexplained("the median epoch", *median, remedy)
    excess = np.where(odd, result.cost[:, 0] / np.maximum(result.freedom, 1.0), 1.0)
    enlarged = fixes.pose_cov * np.maximum(excess, whole.excess)[:, None, None, None]
    cov = enlarged.copy()
    cov[:, 0] += rival_spread(fixes, rival)
    alone, fixes = replace(fixes, pose_cov=enlarged), replace(fixes, pose_cov=cov)
    findings = [Finding("roll_open", roll + rotated, Verdict.TRUSTWORTHY), *whole.findings]
    for code, rows, what in (
        (
            "ambiguous",
            rival,
            "are ambiguous: fixes.parquet has every position that explains them. Declare a"
            " hemisphere or region, or add a beacon that is off the plane of the others.",
        ),
        (
            "geometry",
            open_,
            "do not determine position or direction of the coil. Add beacons elsewhere or with"
            " other directions.",
        ),
        (
            "field_residuals",
            odd & ~bool(whole.findings),
            "have residuals larger than noise and model error; their covariance has been"
            " inflated. Look for iron, and for a beacon that is not as declared.",
        ),
    ):
        findings += _share(code, rows, what)
    if left_out:
        text = f"Omitted {left_out} epochs: too few beacons for position, direction and gain."
        findings.append(Finding("few_data", text, Verdict.TRUSTWORTHY))
    none, doubt = np.full(count, np.nan), rival | odd | open_ | bool(whole.findings)
    verdicts = tuple(Verdict.DOUBTFUL if d else Verdict.TRUSTWORTHY for d in doubt.tolist())
    states = StateTrust(verdicts, none, none.copy(), ((),) * count)
    return JudgedPoses(fixes, alone, states, Trust(tuple(findings)))


def _share(code: str, rows: BoolArray, what: str) -> list[Finding]:
    count, share = int(np.sum(rows)), float(np.mean(rows))
    if not count:
        return []
    verdict = Verdict.DOUBTFUL if share > MAX_OPEN_SHARE else Verdict.TRUSTWORTHY
    return [Finding(code, f"{count} of {len(rows)} epochs {what}", verdict, share / MAX_OPEN_SHARE)]
