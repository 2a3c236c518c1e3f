"""Where a fix finds the platform when the prediction does not tell: by the beacons that agree."""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.stats import chi2

from magfusion.errors import EstimationError
from magfusion.fixes.fix import Fixes
from magfusion.fixes.likelihood import fix_epochs
from magfusion.fusion.state import State
from magfusion.parameters import Calibration
from magfusion.records.samples import FieldSamples
from magfusion.trajectory import Trajectory
from magfusion.units import BoolArray, ComplexArray

MOST_REFUSED = 2  # beacons
DOUBT = 1e-6  # probability of a worse agreement
SPEED_SIGMA = 1.0  # m/s; of a state that was found again


@dataclass(frozen=True, eq=False)
class AgreedFix:
    """A fix of one epoch.

    Parameters
    ----------
    fixes : Fixes
    refused : bool ndarray, shape (channels,)
        Of beacons that do not agree with the others.
    """

    fixes: Fixes
    refused: BoolArray


def prior_of(state: State) -> Trajectory:
    """Return the pose of a prediction, for a fix to hold to."""
    return Trajectory(
        time=np.array([state.time]),
        world_from_body=state.world_from_body[None],
        position_world=state.position_world[None],
        pose_cov=state.cov[None, :6, :6],
    )


def placed(state: State, fix: AgreedFix) -> State:
    """Return a state at the pose of a fix, all else as it is: a place to linearise at."""
    best = fix.fixes.best()
    return replace(
        state, world_from_body=best.world_from_body[0], position_world=best.position_world[0]
    )


def restarted(state: State, fix: AgreedFix) -> State:
    """Return a state that knows its pose from a fix alone; biases and calibration are kept."""
    best = fix.fixes.best()
    assert best.pose_cov is not None
    cov = state.cov.copy()
    cov[:9] = cov[:, :9] = 0.0
    cov[:6, :6] = 4.0 * best.pose_cov[0]
    cov[6:9, 6:9] = SPEED_SIGMA**2 * np.eye(3)
    return replace(placed(state, fix), velocity_world=np.zeros(3), cov=cov)


def agreed_fix(
    samples: FieldSamples, calibration: Calibration, prior: Trajectory | None = None
) -> AgreedFix | None:
    """Fix an epoch without the fewest beacons that keep the others from agreeing.

    Where nothing agrees (a model that is wrong everywhere), all are taken.

    Parameters
    ----------
    samples : FieldSamples
        One epoch.
    calibration : Calibration
    prior : Trajectory, optional
        With it a single beacon is enough.

    Returns
    -------
    AgreedFix or None
        None where there is no fix at all.
    """
    owner = np.array([name for name, _ in samples.channels])
    heard = list(dict.fromkeys(owner[samples.valid[0]].tolist()))
    whole = _fixed(samples, calibration, prior, np.zeros(len(owner), dtype=bool))
    least = 2 if prior is None else 1
    if whole is None or _agrees(whole, samples):
        return whole
    for count in range(1, min(MOST_REFUSED, len(heard) - least) + 1):
        tried = [
            _fixed(samples, calibration, prior, np.isin(owner, names))
            for names in combinations(heard, count)
        ]
        agreed = [fix for fix in tried if fix is not None and _agrees(fix, samples)]
        if agreed:
            return min(agreed, key=lambda fix: float(fix.fixes.cost[0, 0]))
    return whole


def _fixed(
    samples: FieldSamples, calibration: Calibration, prior: Trajectory | None, refused: BoolArray
) -> AgreedFix | None:
    silenced: ComplexArray = np.where(refused[None, :, None], np.nan, samples.phasor_sensor)
    try:
        fixes = fix_epochs(replace(samples, phasor_sensor=silenced), calibration, prior=prior)
    except (EstimationError, np.linalg.LinAlgError):
        return None
    return AgreedFix(fixes, refused)


def _agrees(fix: AgreedFix, samples: FieldSamples) -> bool:
    rows = 6 * int(np.sum(samples.valid[0] & ~fix.refused))
    cost = float(fix.fixes.cost[0, 0] - fix.fixes.prior_cost[0, 0])
    return cost <= float(chi2.isf(DOUBT, rows))
