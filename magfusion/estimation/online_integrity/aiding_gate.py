"""Innovation test of aiding sensors: slips are left out, a long contradiction is named."""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from magfusion.estimation.graph.measurement import Measurement, group_distances
from magfusion.estimation.graph.state import MOTION, State, states_of
from magfusion.estimation.integrity.smoothed_separation import (
    CONTRADICTS,
    FALSE_REJECTIONS,
    disagreement,
)
from magfusion.estimation.measurements.aiding import AidingMeasurement
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.model.parameters import Block

# The same after a rejection: a slip goes on, while the prediction becomes less certain.
FALSE_REJECTIONS_AGAIN = 0.05
SCORED_LOSS = "cauchy"  # of rejected samples in the score: slips do not name a parameter
REJECTED_LONG = 5.0  # s of nothing but rejections; slips and reflections are shorter
MEMORY = 0.995  # of the share of rejections, per sample
FREEDOM = (1, 2, 3, 6)
GATE = {k: float(chdtri(k, FALSE_REJECTIONS)) for k in FREEDOM}
GATE_AGAIN = {k: float(chdtri(k, FALSE_REJECTIONS_AGAIN)) for k in FREEDOM}


class AidingGate:
    """Rejects samples of aiding sensors that the predicted state does not explain.

    `rejected_since`: of each sensor whose last sample was rejected, the time of the first such in a
    row (s). `rejected_share`: decaying mean of its rejections. `rejected`: samples of the last
    epoch that were rejected, at a state that is known better than they measure: they show what is
    wrong with their sensor.
    """

    rejected_since: dict[str, float]
    rejected_share: dict[str, float]
    rejected: tuple[Measurement, ...]

    def __init__(self, blocks: Sequence[Block], counts: Counter[str]) -> None:
        self.blocks, self.counts = tuple(blocks), counts
        self.rejected_since, self.rejected_share, self.rejected = {}, {}, ()

    def passed(self, measurements: list[Measurement], state: State) -> list[Measurement]:
        """Return the measurements of one epoch without those that fail the test."""
        self.rejected = ()
        return [one for one in measurements if self._is_explained(one, state)]

    def _is_explained(self, measurement: Measurement, state: State) -> bool:
        if not isinstance(measurement, AidingMeasurement):
            return True
        measured = int((measurement.sigma < float("inf")).sum())
        if not measured:
            self.counts[f"interval of {measurement.sensor} without inertial samples"] += 1
            return False
        rows = measurement.linearize(states_of([state]), state.calibration, self.blocks)
        gate = GATE_AGAIN if measurement.sensor in self.rejected_since else GATE
        explained = bool(group_distances(rows, state.cov)[0, 0] <= gate[measured])
        sensor, before = measurement.sensor, self.rejected_share.get(measurement.sensor, 0.0)
        self.rejected_share[sensor] = MEMORY * before + (1.0 - MEMORY) * (not explained)
        if explained:
            self.rejected_since.pop(sensor, None)
        else:
            self.counts[f"outlier of {sensor}"] += 1
            self.rejected_since.setdefault(sensor, state.time)
            jacobian = rows.jacobian(len(state.cov) - MOTION)[0, 0]
            if np.trace(jacobian @ state.cov @ jacobian.T) < measured:
                self.rejected += (replace(measurement, robust=SCORED_LOSS),)
        return explained

    def assessed(self, judgement: Judgement, time: float, explained: Collection[str]) -> Judgement:
        """Return a judgement with the sensors that contradict the state without a known cause.

        `explained`: sensors of which a parameter is named by the score test.
        """
        contradicting = {
            sensor: share
            for sensor, share in self.rejected_share.items()
            if sensor not in explained
            if share > CONTRADICTS or time > self.rejected_since.get(sensor, time) + REJECTED_LONG
        }
        return judgement.with_findings(
            *(disagreement(sensor, share) for sensor, share in contradicting.items())
        )
