"""Innovation gate: rejects channels that the prediction does not explain; tracks distortion."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from magfusion.estimation.data_checks.statistics import largest_mean_square
from magfusion.estimation.graph.state import State
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.online_integrity.beacon_consistency import contradicting
from magfusion.estimation.online_integrity.magnetometer_watch import MagnetometerWatch
from magfusion.model.parameters import Block
from magfusion.units import Array, BoolArray

COMPONENTS = 6.0  # of a phasor
FALSE_REJECTIONS = 1e-6  # of the channels of an epoch
NOISE_FACTOR = 2.0  # within which declared noise is right, however few data estimate it
LOST_EPOCHS = 5  # consecutive epochs with most channels rejected: the state is wrong, not they
Phasors = FieldPhasors | JointPhasors
MEMORY = 0.95  # of the running mean of the distortion, per epoch


class Gate:
    """Rejects outliers, and detects a wrong state."""

    counts: Counter[str]  # outliers by beacon
    # by beacon, running mean of the squared innovation in units of its expectation
    distortion: dict[str, float]
    refused_in_a_row: int  # consecutive epochs with most channels rejected, up to now
    outvoted_in_a_row: int  # consecutive epochs in which no majority of the beacons was accepted
    # accepted, refused: of the last epoch, by beacon, the mean squared innovation of the accepted
    # and of the rejected channels, in the same units
    accepted: dict[str, float]
    refused: dict[str, float]
    _limit: Array
    _noise: float  # factor of the variances that the limits allow

    def __init__(
        self,
        channels: tuple[tuple[str, int], ...],
        blocks: Sequence[Block],
        watch: MagnetometerWatch,
    ) -> None:
        self.blocks, self.watch = tuple(blocks), watch
        self.owner = np.array([name for name, _ in channels], dtype=object)
        self._names = tuple(dict.fromkeys(name for name, _ in channels))
        self._number = np.array([self._names.index(name) for name, _ in channels], dtype=np.int64)
        self.counts = Counter()
        self.distortion = {}
        self.refused_in_a_row = self.outvoted_in_a_row = 0
        self.accepted, self.refused = {}, {}
        self.begin({})

    def begin(self, noise_freedom: Mapping[str, float]) -> None:
        """Set the limits by the degrees of freedom of each beacon's estimated noise.

        `noise_freedom`: by beacon; the noise of one without is known.
        """
        freedom = [noise_freedom.get(name, np.inf) for name in self._names]
        limit = [COMPONENTS * largest_mean_square(FALSE_REJECTIONS, COMPONENTS, f) for f in freedom]
        known = COMPONENTS * largest_mean_square(FALSE_REJECTIONS, COMPONENTS, np.inf)
        self._limit = np.minimum(limit, NOISE_FACTOR**2 * known)[self._number]
        self._noise = float(np.max(self._limit)) / known

    @property
    def is_lost(self) -> bool:
        """Whether the state is probably wrong rather than the measurements."""
        return self.refused_in_a_row >= LOST_EPOCHS

    @property
    def has_no_majority(self) -> bool:
        """Whether the accepted beacons are long outnumbered: they may be the false ones."""
        return self.outvoted_in_a_row >= LOST_EPOCHS

    def passed(
        self, measurements: Phasors, state: State, valid: BoolArray, refused: BoolArray
    ) -> Phasors:
        """Return the measurements without the channels that a state does not explain.

        `measurements`: of one epoch. `valid`, `refused` (channels,): channels that the epoch
        contains, and those that are already rejected.
        """
        distance = self._distance(measurements, state)
        beyond: BoolArray = np.asarray(distance > self._limit)
        false = self.watch.update(beyond, valid)
        rejected: BoolArray = np.asarray(beyond | refused | false) & valid
        if isinstance(measurements, FieldPhasors):
            of_beacons = self.blocks, self._number, valid, valid & ~rejected, self._noise
            rejected |= contradicting(measurements, state, *of_beacons)
        self._note(distance, valid)
        self.accepted = self._by_beacon(distance, valid & ~rejected)
        self.refused = self._by_beacon(distance, rejected)
        for name in self.owner[rejected]:
            self.counts[f"outlier of {name}"] += 1
        maximum = np.sum(rejected & ~false) > 0.5 * np.sum(valid & ~false)
        self.refused_in_a_row = self.refused_in_a_row + 1 if maximum else 0
        outvoted = len(self.refused.keys() - self.accepted.keys()) >= max(1, len(self.accepted))
        self.outvoted_in_a_row = self.outvoted_in_a_row + 1 if outvoted else 0
        return measurements.without(rejected) if np.any(rejected) else measurements

    def beyond(self, phasors: FieldPhasors, state: State) -> BoolArray:
        """Return which channels a state does not explain, (channels,)."""
        return np.asarray(self._distance(phasors, state) > self._limit)

    def _distance(self, measurements: Phasors, state: State) -> Array:
        return measurements.alone().distances(state, self.blocks, self._limit)

    def nothing_measured(self) -> None:
        """Record an epoch without field."""
        self.accepted, self.refused = {}, {}

    def _by_beacon(self, distance: Array, chosen: BoolArray) -> dict[str, float]:
        own = self._number[chosen]
        count = np.bincount(own, minlength=len(self._names)).tolist()
        total = np.bincount(own, distance[chosen], len(self._names)).tolist()
        each = zip(self._names, total, count, strict=True)
        return {name: whole / number / COMPONENTS for name, whole, number in each if number}

    def _note(self, distance: Array, valid: BoolArray) -> None:
        for name, level in self._by_beacon(distance, valid).items():
            before = self.distortion.get(name, level)
            self.distortion[name] = MEMORY * before + (1.0 - MEMORY) * level
