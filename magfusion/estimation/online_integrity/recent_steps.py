"""Steps of what the state estimates at recent times, in the online score test.

A beacon that is moved contradicts no fixed parameter where its pose is estimated, nor does a bias
that jumps.  From the step on, the estimate errs by it: the response to a unit step begins as minus
one there, and is then propagated as that of any other error.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby

import numpy as np

from magfusion.estimation.graph import state
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.integrity.change_detection import (
    CHANGED,
    MAX_BEACONS,
    changed_name,
    step_of,
    step_time,
)
from magfusion.estimation.integrity.fault_candidates import FaultCandidate
from magfusion.estimation.integrity.fixed_parameter_test import MIN_EVIDENCE
from magfusion.estimation.integrity.released_fault import gains
from magfusion.estimation.online_integrity.score_epochs import Sums
from magfusion.model.parameters import BEACON_POSITION, BEACON_ROTATION, Block
from magfusion.model.parameters.inertial import ACCEL_BIAS, GYRO_BIAS
from magfusion.model.site import Site
from magfusion.units import Array

ONSET_INTERVAL = 2.0  # s; a step between two is tested as at the next one
BIASES = {ACCEL_BIAS: state.ACCEL_BIAS, GYRO_BIAS: state.GYRO_BIAS}  # their rows of the tangent
MAX_ONSETS = 6  # times of tested steps; the older ones are farther apart


class RecentSteps:
    """The tested steps: of each beacon's estimated pose, and of the biases.

    `estimated`: calibration parameters in the state's tangent.
    """

    def __init__(self, site: Site, estimated: tuple[Block, ...]) -> None:
        kinds = (BEACON_POSITION, BEACON_ROTATION)
        poses = [b for b in estimated if b.parameter in kinds]
        poses = poses if 1 < len(site.beacons) <= MAX_BEACONS else []
        biases = BIASES if site.platform.inertial else {}
        self._steps = (*((b.parameter, b.owner) for b in poses), *((b, "imu") for b in biases))
        columns = [slice(MOTION + b.columns.start, MOTION + b.columns.stop) for b in poses]
        rows = [np.arange(s.start, s.stop) for s in (*columns, *biases.values())]
        self._rows = np.concatenate([np.zeros(0, dtype=np.int64), *rows])
        self._unit = np.concatenate([np.zeros(0), *(b.sigma for b in self._blocks(0.0))])

    def is_due(self, sums: Sums | None, time: float) -> bool:
        """Return whether a new onset is to be tested from a time (s) on."""
        if sums is None or not self._steps:
            return False
        return len(sums.onsets) == 0 or time >= sums.onsets[-1] + ONSET_INTERVAL

    def with_onset(self, sums: Sums) -> Sums:
        """Return sums with a step at their time; of too many, the one closest to others ends."""
        size = len(self._rows)
        response = np.zeros((len(sums.response), size))
        response[self._rows, np.arange(size)] = -self._unit
        new = replace(
            sums,
            information=np.pad(sums.information, (0, size)),
            gradient=np.pad(sums.gradient, (0, size)),
            response=np.concatenate([sums.response, response], axis=1),
            exact_response=np.concatenate([sums.exact_response, response], axis=1),
            onsets=(*sums.onsets, sums.time),
        )
        return new if len(new.onsets) <= MAX_ONSETS else self._without_one(new)

    def _without_one(self, sums: Sums) -> Sums:
        age = sums.time - np.array(sums.onsets)
        # Ages in even ratios: a step is tested to a constant share of its age.
        dropped = int(np.argmin((age[:-2] - age[2:]) / age[1:-1])) + 1
        begin = len(sums.gradient) - len(self._rows) * (len(sums.onsets) - dropped)
        kept = np.delete(np.arange(len(sums.gradient)), np.arange(begin, begin + len(self._rows)))
        return replace(
            sums,
            information=sums.information[np.ix_(kept, kept)],
            gradient=sums.gradient[kept],
            response=sums.response[:, kept],
            exact_response=sums.exact_response[:, kept],
            onsets=sums.onsets[:dropped] + sums.onsets[dropped + 1 :],
        )

    def blocks(self, onsets: tuple[float, ...], first: int) -> list[Block]:
        """Return the steps as parameters, with their columns from the first on."""
        result = []
        for block in (block for onset in onsets for block in self._blocks(onset)):
            own = slice(first, first + len(block.sigma))
            result.append(block._replace(columns=own))
            first = own.stop
        return result

    def _blocks(self, onset: float) -> list[Block]:
        return [step_of(kind, owner, onset) for kind, owner in self._steps]

    def candidates(
        self, steps: list[Block], information: Array, gradient: Array
    ) -> list[FaultCandidate]:
        """Return what one event may have moved, where there is evidence for one of so many."""
        events = list(self._events(steps))
        result, price = [], 2.0 * np.log(max(len(events), 1))
        for moved in events:
            rows = np.concatenate([np.arange(b.columns.start, b.columns.stop) for b in moved])
            own = information[np.ix_(rows, rows)]
            gain = gains(np.eye(len(rows))[None], own, gradient[rows])
            if gain[0] > MIN_EVIDENCE + price:
                combine = np.eye(len(gradient))[:, rows]
                result.append(FaultCandidate(changed_name(moved), moved, combine, CHANGED))
        return result

    def _events(self, steps: list[Block]) -> Iterator[tuple[Block, ...]]:
        """Yield a bias, the position of a beacon, its attitude, and both, at each onset."""
        for (_, owner), blocks in groupby(steps, lambda b: (step_time(b), b.owner)):
            own = tuple(blocks)
            yield from ((block,) for block in own)
            if len(own) > 1 and owner != "imu":
                yield own
