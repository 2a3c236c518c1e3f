"""Which channels of an epoch the prediction explains, and how well each beacon's field is."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from magfusion.fusion.epoch import channel_distances, field_rows, single, without
from magfusion.fusion.factors import FieldMeasurements
from magfusion.fusion.state import State
from magfusion.parameters import Block
from magfusion.units import Array, BoolArray

GATE = 38.3  # chi square of six components, one in a million
LOST_EPOCHS = 5  # in a row, most of whose channels were refused: the state is wrong, not they
MEMORY = 0.95  # of the running mean of the distortion, an epoch


class Gate:
    """Refuses outliers, and notices when it is the state that is wrong.

    Attributes
    ----------
    counts : Counter
        Outliers by beacon.
    distortion : dict of str to float
        By beacon, running mean of the squared innovation in units of its expectation.
    refused_in_a_row : int
        Epochs most of whose channels were refused, up to now.
    """

    def __init__(self, channels: tuple[tuple[str, int], ...], blocks: Sequence[Block]) -> None:
        self.blocks = tuple(blocks)
        self.owner = np.array([name for name, _ in channels], dtype=object)
        self.counts: Counter[str] = Counter()
        self.distortion: dict[str, float] = {}
        self.refused_in_a_row = 0

    @property
    def lost(self) -> bool:
        """Whether the state is to be doubted rather than the measurements."""
        return self.refused_in_a_row >= LOST_EPOCHS

    def passed(
        self, measurements: FieldMeasurements, state: State, valid: BoolArray, refused: BoolArray
    ) -> FieldMeasurements:
        """Return the measurements without the channels that a state does not explain.

        Parameters
        ----------
        measurements : FieldMeasurements
            Of one epoch.
        state : State
        valid, refused : bool ndarray, shape (channels,)
            What the epoch holds, and what was refused before.
        """
        rows = field_rows(single(measurements, self.blocks), state)
        distance = channel_distances(rows, state.cov, len(self.owner))
        rejected: BoolArray = np.asarray((distance > GATE) | refused) & valid
        self._note(distance, valid)
        for name in self.owner[rejected]:
            self.counts[f"outlier of {name}"] += 1
        most = np.sum(rejected) > 0.5 * np.sum(valid)
        self.refused_in_a_row = self.refused_in_a_row + 1 if most else 0
        return without(measurements, rejected) if np.any(rejected) else measurements

    def _note(self, distance: Array, valid: BoolArray) -> None:
        for name in dict.fromkeys(self.owner.tolist()):
            own = (self.owner == name) & valid
            if np.any(own):
                level = float(np.mean(distance[own])) / 6.0
                before = self.distortion.get(name, level)
                self.distortion[name] = MEMORY * before + (1.0 - MEMORY) * level
