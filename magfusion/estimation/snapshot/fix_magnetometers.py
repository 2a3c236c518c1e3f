"""Consistency test of several magnetometers in single epochs.

The fixes of each magnetometer alone are compared by pairs.  Errors of the site are common to all
epochs, so that many prove no more than one: the median of the squared distances is tested as one.
"""

from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from magfusion.estimation.data_checks.magnetometers import of_sensors
from magfusion.estimation.data_checks.statistics import P_CERTAIN
from magfusion.estimation.snapshot.fix import AS_LIKELY, Fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.files.fields import SAME_TIME
from magfusion.model.parameters import Calibration, seen_by
from magfusion.model.samples import FieldSamples
from magfusion.model.trust import Finding
from magfusion.units import Array

MIN_EPOCHS = 5  # common epochs needed to test a pair


def contradicting_magnetometers(
    samples: FieldSamples, calibration: Calibration
) -> tuple[Finding, ...]:
    """Return findings for magnetometers that contradict each other about the pose.

    Of three or more, one that contradicts all others while these agree is identified. `samples`:
    channels in the site's order.
    """
    sensors = calibration.site.platform.magnetometers
    if len(sensors) == 1:
        return ()
    alone = [_alone(samples, calibration, k) for k in range(len(sensors))]
    limit = float(chdtri(6, P_CERTAIN))
    false: dict[tuple[int, int], float] = {}
    for i, j in combinations(range(len(sensors)), 2):
        separate = _squared_distances(alone[i], alone[j])
        if len(separate) >= MIN_EPOCHS and float(np.median(separate)) > limit:
            false[i, j] = float(np.median(separate)) / limit
    if not false:
        return ()
    names = ", ".join(sensor.name for sensor in sensors)
    worst = max(false.values())
    faulty = [k for k in range(len(sensors)) if all(k in pair for pair in false)]
    if len(faulty) == 1:
        return (_named(sensors[faulty[0]].name, names, worst),)
    return (_open(names, worst),)


def _alone(samples: FieldSamples, calibration: Calibration, which: int) -> Fixes | None:
    own = of_sensors(samples, calibration.site, [which])
    return fix_epochs(own, seen_by(calibration, which)) if len(own) else None


def _squared_distances(one: Fixes | None, other: Fixes | None) -> Array:
    """Return the squared distances of two fixes where both are determined, of six numbers."""
    if one is None or other is None:
        return np.zeros(0)
    place = np.searchsorted(other.time, one.time - SAME_TIME)
    place = np.minimum(place, len(other) - 1)
    both = np.abs(other.time[place] - one.time) < SAME_TIME
    both &= one.determined[:, 0] & other.determined[place, 0]
    pairs = zip(np.flatnonzero(both).tolist(), place[both].tolist(), strict=True)
    return np.array([_least(one, i, other, j) for i, j in pairs])


def _least(one: Fixes, i: int, other: Fixes, j: int) -> float:
    """Return the least squared distance of any two probable hypotheses."""
    least = np.inf
    for a in np.flatnonzero(one.cost[i] < one.cost[i, 0] + AS_LIKELY):
        for b in np.flatnonzero(other.cost[j] < other.cost[j, 0] + AS_LIKELY):
            body_from_world = one.world_from_body[i, a].T
            rotated = body_from_world @ other.world_from_body[j, b]
            shift = other.position_world[j, b] - one.position_world[i, a]
            offset = np.concatenate(
                [Rotation.from_matrix(rotated).as_rotvec(), body_from_world @ shift]
            )
            into = np.kron(np.eye(2), rotated)
            cov = one.pose_cov[i, a] + into @ other.pose_cov[j, b] @ into.T
            least = min(least, float(offset @ np.linalg.solve(cov, offset)))
    return least


def _named(name: str, names: str, worst: float) -> Finding:
    text = (
        f"Magnetometer {name} contradicts the others, which agree: its fixes of single epochs are"
        f" off by {worst:.3g} times what noise and survey explain. Check its body_from_sensor,"
        f" matrix, response and clock_offset_s (of {names}), or leave it out."
    )
    return Finding("magnetometers_contradict", text, weight=worst)


def _open(names: str, worst: float) -> Finding:
    text = (
        f"The magnetometers {names} contradict each other: their fixes of single epochs differ by"
        f" {worst:.3g} times what noise and survey explain. Check body_from_sensor, matrix,"
        " response and clock_offset_s of each. The smoother may identify the faulty one."
    )
    return Finding("magnetometers_contradict", text, weight=worst)
