"""Consistency of an epoch's beacons: which of them contradicts the others together.

After a minute of dead reckoning a prediction is so uncertain that any field passes the gate, yet
the fields of three beacons leave a false one no room: the exclusion of receiver autonomous
integrity monitoring, with the prediction as one more measurement.
"""

import numpy as np

from magfusion.estimation.data_checks.statistics import largest_mean_square
from magfusion.estimation.graph.state import MOTION, State, states_of
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.parameters import Block
from magfusion.units import Array, BoolArray, IntArray

BY_CHANCE = 1e-6  # probability, of the innovations of an epoch, and of a wrong exclusion
MARGIN = -2.0 * float(np.log(BY_CHANCE))  # of the log likelihood ratio, times two, to any other


def contradicting(
    phasors: FieldPhasors,
    state: State,
    blocks: tuple[Block, ...],
    beacon: IntArray,
    valid: BoolArray,
    accepted: BoolArray,
    noise: float = 1.0,
) -> BoolArray:
    """Return which channels belong to beacons that contradict the others of an epoch.

    None unless it is clear which, and the others are a majority that agrees: iron near the sensor
    disturbs all, and of two beacons either may be false.

    `state`: predicted at the epoch. `beacon` (channels,): number of each channel's. `valid`,
    `accepted` (channels,): channels that the epoch contains, and those that the prediction alone
    does not exclude. `noise`: factor of the variances, up to which the innovations may be noise.
    Returns (channels,).
    """
    majority = len(np.unique(beacon[valid])) // 2 + 1
    none = np.zeros_like(accepted)
    if len(np.unique(beacon[accepted])) <= majority:
        return none
    rows = phasors.alone().linearize(states_of([state]), state.calibration, blocks)
    error, jacobian = rows.error[0], rows.jacobian(len(state.cov) - MOTION)[0]
    kept = accepted.copy()
    while len(numbers := np.unique(beacon[kept])) >= majority:
        innovations = _Innovations(error[kept], jacobian[kept], state.cov)
        if innovations.excess <= noise:
            return accepted & ~kept
        gains = np.array([innovations.gain(beacon[kept] == number) for number in numbers])
        *_, second, best = np.argsort(gains)
        if gains[best] - gains[second] < noise * MARGIN:
            break
        kept &= beacon != numbers[best]
    return none


class _Innovations:
    """Innovations of some channels, with the inverse of their covariance."""

    def __init__(self, error: Array, jacobian: Array, cov: Array) -> None:
        """Process whitened rows, (channels, 6) and (channels, 6, n)."""
        by = jacobian.reshape(error.size, -1)
        self._components = error.shape[1]
        self._information = np.linalg.inv(by @ cov @ by.T + np.eye(error.size))
        self._weighed = self._information @ error.ravel()
        expected = error.size * largest_mean_square(BY_CHANCE, float(error.size), np.inf)
        self.excess = float(error.ravel() @ self._weighed) / expected  # over the limit of chance

    def gain(self, channels: BoolArray) -> float:
        """Return by how much the squared distance decreases without some channels."""
        own = np.repeat(channels, self._components)
        part, information = self._weighed[own], self._information[np.ix_(own, own)]
        return float(part @ np.linalg.solve(information, part))
