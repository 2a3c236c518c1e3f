"""Recovery of a lost platform by a fix from the beacons that agree.

A fix without any agreeing subset of beacons is not used for a restart: it would be trusted.
"""

from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from magfusion.errors import EstimationError
from magfusion.estimation.graph.state import ACCEL_BIAS, GYRO_BIAS, State
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import Calibration, predict_channels
from magfusion.model.samples import FieldSamples
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, ComplexArray

MAX_REFUSED = 2  # beacons
DOUBT = 1e-6  # probability of a worse agreement
EXPLAINED = 0.25  # of the field; a larger residual is no explanation, whatever its covariance
FIRST_WAIT, MAX_WAIT = 0.1, 2.0  # s; between attempts at a fix, doubled each time
BIAS_LIMIT = 6.0  # prior sigmas; a larger bias is the result of a wrong pose


class AgreedFix(NamedTuple):
    """A fix of one epoch."""

    fixes: Fixes
    refused: BoolArray  # (channels,), of beacons that disagree with the others

    @property
    def excess(self) -> float:
        """Mean squared residual, at least one."""
        return max(1.0, float(self.fixes.residual_rms[0, 0]) ** 2)


class Attempts:
    """Times of attempts at a fix: at once, then after waits that double up to `MAX_WAIT`.

    `lost_since`: when the platform was lost (s); None where it is not.
    """

    lost_since: float | None
    _next: float
    _wait: float

    def __init__(self) -> None:
        self.lost_since = None
        self._next, self._wait = -np.inf, FIRST_WAIT

    def lost_at(self, time: float) -> float:
        """Record that the platform is lost at a time (s); return since when it is."""
        if self.lost_since is None:
            self.lost_since, self._next, self._wait = time, time, FIRST_WAIT
        return self.lost_since

    def due(self, time: float) -> bool:
        """Record that the platform is lost at a time (s); return whether to try a fix."""
        self.lost_at(time)
        if time < self._next:
            return False
        self._next, self._wait = time + self._wait, min(2.0 * self._wait, MAX_WAIT)
        return True

    def over(self) -> None:
        """Record that the platform is recovered."""
        self.lost_since = None


def prior_of(state: State) -> Trajectory:
    """Return the pose of a prediction as the prior of a fix."""
    return Trajectory(
        time=np.array([state.time]),
        world_from_body=state.world_from_body[None],
        position_world=state.position_world[None],
        pose_cov=state.cov[None, :6, :6],
    )


def at_fix(state: State, fix: AgreedFix) -> State:
    """Return a state at the pose of a fix, otherwise unchanged, as a linearization point."""
    best = fix.fixes.best()
    return replace(
        state, world_from_body=best.world_from_body[0], position_world=best.position_world[0]
    )


def restarted(state: State, fix: AgreedFix) -> State:
    """Return a state with the pose of a fix alone; calibration is kept.

    So are the biases that are plausible for the instrument, as uncertain as declared: one that
    jumped may be why the platform was lost.
    """
    best, site = fix.fixes.best(), state.calibration.site
    assert best.pose_cov is not None
    cov = state.cov.copy()
    cov[:9] = cov[:, :9] = 0.0
    cov[:6, :6] = 4.0 * fix.excess * best.pose_cov[0]
    cov[6:9, 6:9] = site.platform.motion.speed_sigma**2 * np.eye(3)
    result = replace(at_fix(state, fix), velocity_world=np.zeros(3), cov=cov)
    imu = site.platform.imu
    accel = _plausible(state.accel_bias_body, cov, ACCEL_BIAS, imu.accel_bias_sigma)
    gyro = _plausible(state.gyro_bias_body, cov, GYRO_BIAS, imu.gyro_bias_sigma)
    return replace(result, accel_bias_body=accel, gyro_bias_body=gyro)


def _plausible(bias: Array, cov: Array, columns: slice, sigma: float) -> Array:
    """Return a bias, or zero where it is implausible; its covariance becomes the declared one."""
    cov[columns] = cov[:, columns] = 0.0
    cov[columns, columns] = sigma**2 * np.eye(3)
    return np.zeros(3) if np.max(np.abs(bias)) > BIAS_LIMIT * sigma else bias


def explains(fix: AgreedFix, samples: FieldSamples, calibration: Calibration) -> bool:
    """Return whether a fix explains the field up to noise, or at least most of it."""
    if _agrees(fix, samples):
        return True
    best, kept = fix.fixes.best(), samples.valid[0] & ~fix.refused
    if not np.any(kept):
        return False
    phasor = predict_channels(calibration, best.time, best.world_from_body, best.position_world)
    measured = np.nan_to_num(samples.phasor_sensor[0, kept])
    there = samples.there[0, kept]
    remaining = np.linalg.norm(np.where(there, measured - phasor[0, kept], 0.0), axis=1)
    share = remaining / np.linalg.norm(measured, axis=1)
    return bool(np.sqrt(np.mean(share**2)) < EXPLAINED)


def corroborated(samples: FieldSamples) -> bool:
    """Return whether an epoch has more than one beacon for a restart, if the site has more.

    A contradicting beacon loses a state: alone, it may be the Earth's field in a rotation.
    """
    beacons = {name for name, _ in samples.channels}
    detected = {
        name for (name, _), on in zip(samples.channels, samples.valid[0], strict=True) if on
    }
    return len(detected) > 1 or len(beacons) == 1


def agreed_fix(
    samples: FieldSamples, calibration: Calibration, prior: Trajectory | None = None
) -> AgreedFix | None:
    """Fix an epoch without the smallest set of beacons that prevents agreement.

    If no subset agrees (a model that is wrong everywhere), all are used. `samples`: one epoch.
    `prior`: with it a single beacon suffices. Returns None where there is no fix at all.
    """
    owner = np.array([name for name, _ in samples.channels])
    detected = list(dict.fromkeys(owner[samples.valid[0]].tolist()))
    (whole,) = _fixed(samples, calibration, prior, [np.zeros(len(owner), dtype=bool)])
    least = 2 if prior is None else 1
    if whole is None or _agrees(whole, samples):
        return whole
    for count in range(1, min(MAX_REFUSED, len(detected) - least) + 1):
        refused = [np.isin(owner, names) for names in combinations(detected, count)]
        tried = _fixed(samples, calibration, prior, refused)
        agreed = [fix for fix in tried if fix is not None and _agrees(fix, samples)]
        if agreed:
            return min(agreed, key=lambda fix: float(fix.fixes.cost[0, 0]))
    return whole


def _fixed(
    samples: FieldSamples,
    calibration: Calibration,
    prior: Trajectory | None,
    refused: list[BoolArray],
) -> list[AgreedFix | None]:
    """Fix one epoch without each choice of channels, all at once."""
    count = len(refused)
    every = samples.rows(np.zeros(count, dtype=int))
    silenced: ComplexArray = np.where(np.array(refused)[:, :, None], np.nan, every.phasor_sensor)
    known = None if prior is None else _repeated(prior, count)
    try:
        fixes = fix_epochs(replace(every, phasor_sensor=silenced), calibration, prior=known)
    except (EstimationError, np.linalg.LinAlgError):
        if count == 1:
            return [None]
        return [_fixed(samples, calibration, prior, [one])[0] for one in refused]
    return [AgreedFix(fixes.rows(slice(k, k + 1)), one) for k, one in enumerate(refused)]


def _repeated(prior: Trajectory, count: int) -> Trajectory:
    """Return the pose of a prediction, repeated."""
    assert prior.pose_cov is not None
    # Times must increase; they do not matter for a prior pose.
    separate = np.spacing(prior.time[0]) * np.arange(count)
    return Trajectory(
        time=prior.time[0] + separate,
        world_from_body=np.repeat(prior.world_from_body, count, axis=0),
        position_world=np.repeat(prior.position_world, count, axis=0),
        pose_cov=np.repeat(prior.pose_cov, count, axis=0),
    )


def _agrees(fix: AgreedFix, samples: FieldSamples) -> bool:
    rows = int(np.sum(samples.numbers[0] * ~fix.refused))
    cost = float(fix.fixes.cost[0, 0] - fix.fixes.prior_cost[0, 0])
    return cost <= float(chdtri(rows, DOUBT))
