"""Judgement of one online state, and the state with the covariance that the judgement allows."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from magfusion.estimation.graph.state import POSITION, ROTATION, State
from magfusion.estimation.online_integrity.levels import Levels
from magfusion.model.one_axis import opened_state, roll_is_open
from magfusion.model.short_repr import short_repr
from magfusion.model.trust import Finding, Trust, Verdict, worst
from magfusion.units import Array


@dataclass(frozen=True)
class Judgement:
    """Combined result of the monitors of a state."""

    findings: tuple[Finding, ...] = ()  # a failed one means that the platform is lost
    excluded: tuple[str, ...] = ()  # beacons that the gate rejected at this epoch
    inflation: float = 1.0  # of the whole covariance, at least one
    # turn, shift: additional error of attitude (rad) and position (m), one sigma per axis
    turn: float = 0.0
    shift: float = 0.0
    levels: Levels | None = None  # None where there are none
    # beacons that are detected there, with the motion inside the window compensated
    detected: tuple[str, ...] = ()

    @property
    def protection_level_m(self) -> float | None:
        """Radius that bounds the position error (m), if there is one."""
        return None if self.levels is None else self.levels.values[0]

    @property
    def protection_level_deg(self) -> float | None:
        """Angle that bounds the attitude error (deg), if there is one."""
        return None if self.levels is None else self.levels.values[1]

    @property
    def verdict(self) -> Verdict:
        """The worst of the findings'."""
        return worst(finding.verdict for finding in self.findings)

    @property
    def reasons(self) -> tuple[Finding, ...]:
        """The findings that cast doubt, the most important first."""
        return Trust(self.findings).reasons

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings that cast no doubt: the estimator handles them."""
        return Trust(self.findings).remarks

    def with_findings(self, *findings: Finding) -> "Judgement":
        """Return the judgement with more findings."""
        return replace(self, findings=(*self.findings, *findings)) if findings else self

    def honest(self, cov: Array) -> Array:
        """Return the covariance of a state, enlarged as its judgement demands."""
        if self.inflation == 1.0 and self.turn == 0.0 and self.shift == 0.0:
            return cov
        wide = self.inflation * cov
        wide[ROTATION, ROTATION] += self.turn**2 * np.eye(3)
        wide[POSITION, POSITION] += self.shift**2 * np.eye(3)
        return wide

    def estimators(self, cov: Array) -> Array:
        """Return the covariance that the estimator itself claims: the inverse of `honest`."""
        if self.inflation == 1.0 and self.turn == 0.0 and self.shift == 0.0:
            return cov
        narrow = cov.copy()
        narrow[ROTATION, ROTATION] -= self.turn**2 * np.eye(3)
        narrow[POSITION, POSITION] -= self.shift**2 * np.eye(3)
        return narrow / self.inflation


@dataclass(frozen=True)
class TimedJudgement:
    """Judgement of the state at a time (s)."""

    time: float
    judgement: Judgement
    reset_counter: int = 0


@dataclass(frozen=True, eq=False)
class JudgedState(State):
    """A state with its judgement, and its covariance enlarged accordingly."""

    __repr__ = short_repr

    judgement: Judgement = Judgement()
    # number of pose jumps up to here, as counted by
    # `magfusion.estimation.online_integrity.discontinuity_counter`; users of pose increments must
    # restart where it rises
    reset_counter: int = 0

    @property
    def verdict(self) -> Verdict:
        """Whether the state can be trusted."""
        return self.judgement.verdict

    @property
    def is_lost(self) -> bool:
        """Whether the pose is a guess that must not be used."""
        return self.verdict is Verdict.FAILED


def reported_cov(state: State, judgement: Judgement) -> Array:
    """Return the output covariance of a state: with any roll that is undetermined."""
    cov, site = judgement.honest(state.cov), state.calibration.site
    if not roll_is_open(site):
        return cov
    rotated = state.world_from_body, state.gyro_bias_body, site.platform.imu.gyro_bias_sigma
    return opened_state(site, cov, *rotated)


def judged_state(state: State, judgement: Judgement, reset_counter: int = 0) -> JudgedState:
    """Return the output state for an estimator's state."""
    reported = {"cov": reported_cov(state, judgement), "judgement": judgement}
    own = {name: getattr(state, name) for name in _OF_STATE}
    return JudgedState(**own | reported | {"reset_counter": reset_counter})


def parts_of(state: JudgedState) -> dict[str, Any]:
    """Return the fields of a state by name, to construct another kind from them."""
    return {name: getattr(state, name) for name in _OF_JUDGED}


_OF_STATE = tuple(field.name for field in fields(State))
_OF_JUDGED = tuple(field.name for field in fields(JudgedState))
