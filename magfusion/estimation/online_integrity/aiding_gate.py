"""Innovation test of aiding sensors: slips are left out, a long contradiction is named."""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from magfusion.estimation.graph.measurement import Measurement, group_distances
from magfusion.estimation.graph.state import MOTION, State, states_of
from magfusion.estimation.integrity.aiding_causes import (
    MAX_SAMPLES,
    AidingComparison,
    aiding_diagnosis,
    compared,
    joined,
)
from magfusion.estimation.integrity.correction import Correction
from magfusion.estimation.integrity.fault_isolation import Diagnosis
from magfusion.estimation.integrity.smoothed_separation import (
    CONTRADICTS,
    FALSE_REJECTIONS,
    disagreement,
)
from magfusion.estimation.measurements.aiding import AidingMeasurement
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.model.aiding import sensor_named
from magfusion.model.parameters import Block
from magfusion.model.site import Site
from magfusion.model.trust import Finding

# The same after a rejection: a slip goes on, while the prediction becomes less certain.
FALSE_REJECTIONS_AGAIN = 0.05
SCORED_LOSS = "cauchy"  # of rejected samples in the score: slips do not name a parameter
REJECTED_LONG = 5.0  # s of nothing but rejections; slips and reflections are shorter
SUSPECTED = 0.05  # share of rejections, above which the cause is looked for
CONCLUSIVE = 10.0  # s of samples, after which a parameter of the sensor may be corrected
EVERY = 2.0  # s, between such attempts
MEMORY = 0.995  # of the share of rejections, per sample
FREEDOM = (1, 2, 3, 6)
GATE = {k: float(chdtri(k, FALSE_REJECTIONS)) for k in FREEDOM}
GATE_AGAIN = {k: float(chdtri(k, FALSE_REJECTIONS_AGAIN)) for k in FREEDOM}


class AidingGate:
    """Rejects samples of aiding sensors that the predicted state does not explain.

    `rejected_since`: of each sensor whose last sample was rejected, the time of the first such in a
    row (s). `rejected_share`: decaying mean of its rejections. `rejected`: samples of the last
    epoch that were rejected, at a state that is known better than they measure: they show what is
    wrong with their sensor. `seen`: the newest samples with what was predicted. `findings`,
    `named`: mistakes that explain contradicting sensors, and these sensors; looked for at
    `next_time` (s).
    `diagnosis`: just found; a checkpoint has none.
    """

    seen: dict[str, AidingComparison]
    findings: tuple[Finding, ...]
    named: tuple[str, ...]
    next_time: float

    rejected_since: dict[str, float]
    rejected_share: dict[str, float]
    rejected: tuple[Measurement, ...]

    def __init__(self, site: Site, blocks: Sequence[Block], counts: Counter[str]) -> None:
        self.site, self.blocks, self.counts = site, tuple(blocks), counts
        self.seen, self.findings, self.named, self.next_time = {}, (), (), -np.inf
        self.diagnosis: Diagnosis | None = None
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
        at, cov = states_of([state]), state.cov[None]
        declared = sensor_named(self.site.aiding, measurement.sensor)
        newest = compared(measurement, np.array([state.time]), at, cov, declared)
        known = self.seen.get(measurement.sensor)
        newest = newest if known is None else joined([known, newest])
        self.seen[measurement.sensor] = newest.last(MAX_SAMPLES)
        rows = measurement.linearize(at, state.calibration, self.blocks)
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
        """Return a judgement with the sensors that contradict the state, and why.

        `explained`: sensors of which a parameter is named by the score test.
        """
        contradicting = {
            sensor: share
            for sensor, share in self.rejected_share.items()
            if share > CONTRADICTS or time > self.rejected_since.get(sensor, time) + REJECTED_LONG
        }
        suspected = (s for s, share in self.rejected_share.items() if share > SUSPECTED)
        self._diagnose({*contradicting, *suspected}, time)
        known = {*explained, *self.named}
        return judgement.with_findings(
            *self.findings,
            *(disagreement(*one) for one in contradicting.items() if one[0] not in known),
        )

    def is_early(self, correction: Correction) -> bool:
        """Return whether a parameter is of a sensor with too few samples to exclude a unit."""
        blocks = () if correction.fault is None else correction.fault.blocks
        own = [self.seen[b.owner].time for b in blocks if b.owner in self.seen]
        return any(time[-1] - time[0] < CONCLUSIVE for time in own)

    def _diagnose(self, suspected: Collection[str], time: float) -> None:
        """Look for the mistakes of sensors, from time to time."""
        self.diagnosis = None
        if not suspected:
            self.findings, self.named = (), ()
        elif time >= self.next_time:
            self.next_time = time + EVERY
            known = {name: self.seen[name] for name in suspected if name in self.seen}
            self.diagnosis = one = aiding_diagnosis(self.site, known)
            self.findings = () if one is None else (one.finding,)
            right = self.site if one is None or one.site is None else one.site
            self.named = tuple(s.name for s in self.site.aiding if s not in right.aiding)
