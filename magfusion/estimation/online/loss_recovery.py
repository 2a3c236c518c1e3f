"""When a state is lost, and the fixes of one epoch that replace it or its linearization point."""

from dataclasses import replace

import numpy as np

from magfusion.estimation.graph.state import POSITION, ROTATION, State
from magfusion.estimation.measurements.linearization import is_curved, relinearized
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.online.queue.epoch_measurements import EpochMeasurements
from magfusion.estimation.online_integrity.gate import Gate
from magfusion.estimation.online_integrity.recovery import (
    Attempts,
    agreed_fix,
    at_fix,
    corroborated,
    explains,
    prior_of,
    restarted,
)
from magfusion.model.parameters import Block
from magfusion.units import Array, BoolArray

WIDE_POSITION, WIDE_ROTATION = 0.3, 0.2  # m, rad; beyond, the prediction is no linearization point
LOST_POSITION = 10.0  # m; a larger sigma means that the state is lost, whatever is measured
UNDETECTED = 1.0  # s without a beacon, longer than any window, before the sigma alone decides


class LossRecovery:
    """Attempts to recover a lost or uncertain state by a fix from the beacons that agree.

    `gate`: knows whether the state explains no measurement any more. `blocks`: calibration
    parameters in the states' tangent. `lost_beyond`: as of
    `magfusion.estimation.online.navigator_settings.NavigatorSettings` (m).
    """

    detected_at: float  # when a beacon was last detected (s)
    _attempts: Attempts
    _pointing: Attempts

    def __init__(self, gate: Gate, blocks: tuple[Block, ...], lost_beyond: float) -> None:
        self._gate, self._blocks, self._lost_beyond = gate, blocks, lost_beyond
        self.detected_at = -np.inf
        self._attempts, self._pointing = Attempts(), Attempts()

    def needs_fix(self, state: State) -> bool:
        """Return whether only a fix that is independent of the state can replace it."""
        return self._gate.is_lost or not _no_wider(state.cov[POSITION, POSITION], LOST_POSITION)

    def needs_separate_beacons(self, state: State) -> bool:
        """Return whether jointly measured beacons do not suffice: each is needed separately."""
        return self.needs_fix(state) or _wide(state)

    def _is_lost(self, state: State) -> bool:
        undetected = state.time > self.detected_at + UNDETECTED
        if undetected and not _no_wider(state.cov[POSITION, POSITION], self._lost_beyond):
            return True
        return self.needs_fix(state)

    def lost_since(self, state: State) -> tuple[float | None, bool]:
        """Return since when a state is lost (s), if it is, and whether it was until now."""
        if self._is_lost(state):
            return self._attempts.lost_at(state.time), False
        return None, self._attempts.lost_since is not None

    def over(self) -> None:
        """Record that the state is recovered."""
        self._gate.counts["lost and found again"] += 1
        self._gate.refused_in_a_row = self._gate.outvoted_in_a_row = 0
        self._attempts.over()

    def restarted(self, measured: EpochMeasurements, state: State) -> State | None:
        """Return a lost state at a fix; None where none is due, or explains the measurements."""
        if not measured.is_sequential or not self._attempts.due(state.time):
            return None
        if not corroborated(measured.samples):
            return None
        fix = agreed_fix(measured.samples, state.calibration)
        if fix is None or not fix.fixes.determined[0, 0]:
            return None
        if not explains(fix, measured.samples, state.calibration):
            return None
        return restarted(state, fix)

    def linearization_point(
        self, measured: EpochMeasurements, state: State
    ) -> tuple[EpochMeasurements, State | None, BoolArray]:
        """Return fields as linearised, the fix that this needs, if any, and rejected channels."""
        samples = measured.samples
        nothing = np.zeros(len(samples.channels), dtype=bool)
        # Of a state that is near enough, or whose windows were not requested.
        if not isinstance(measured.phasors, FieldPhasors):
            return measured, None, nothing
        if not _wide(state):
            self._pointing.over()
            if not is_curved(measured.phasors, state):
                return measured, None, nothing
            phasors = self._relinearized(measured.phasors, state)
            return replace(measured, phasors=phasors), None, nothing
        if not self._pointing.due(state.time):
            return measured, None, samples.valid[0]
        fix = agreed_fix(samples, state.calibration, prior_of(state))
        if fix is None:
            return measured, None, nothing
        if not explains(fix, samples, state.calibration):
            return measured, None, samples.valid[0]
        self._gate.counts["found by a fix"] += 1
        self._pointing.over()
        return measured, at_fix(state, fix), fix.refused

    def _relinearized(self, phasors: FieldPhasors, state: State) -> FieldPhasors:
        """Return fields linearised at the most probable pose, without those of false beacons."""
        plausible = phasors.without(self._gate.beyond(phasors, state))
        at = relinearized(plausible, state, self._blocks)
        if at is None or at.world_from_body is None or at.position_world is None:
            return phasors
        return phasors.linearized_at(at.world_from_body[0], at.position_world[0])


def _wide(state: State) -> bool:
    """Return whether a state is too uncertain to linearise at."""
    wide = (POSITION, WIDE_POSITION), (ROTATION, WIDE_ROTATION)
    return not all(_no_wider(state.cov[part, part], sigma) for part, sigma in wide)


def _no_wider(cov: Array, sigma: float) -> bool:
    """Return whether no axis of a covariance (3, 3) has a larger sigma."""
    # The trace bounds the variance of every axis, and costs less.
    return bool(cov.trace() <= sigma**2 or np.linalg.eigvalsh(cov)[-1] <= sigma**2)
