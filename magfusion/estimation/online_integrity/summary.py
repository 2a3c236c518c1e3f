"""Summary of a run's judgements."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.model.trust import Finding, Trust, Unverified, Verdict

# Of residuals against noise, which an impact or a motor nearby exceeds for a moment.  A mistake
# of the site or the sensors does not pass.
PASSING_CODES = frozenset(
    {"field_innovations", "field_residuals", "inertial_residuals", "noise_tuned"}
)
PASSING_S = 1.0  # from the first to the last state that has such a finding
QUIET_FACTOR = 10.0  # times as long without it


@dataclass(frozen=True)
class Noted:
    """The strongest finding of a code, and the states that have it."""

    finding: Finding
    # first, last: of those states (s)
    first: float
    last: float
    states: int = 1


class Summary:
    """Summary of all states up to now.

    `unverified`: parameters that the beginning could not check. `lost_states`, `lost_time`,
    `longest_loss`: number of lost states, their total and their longest duration until recovery
    (s).
    """

    unverified: tuple[Unverified, ...]
    lost_states: int
    lost_time: float
    longest_loss: float
    _noted: dict[str, Noted]
    _states: int
    _lost_since: float | None
    _last: float

    def __init__(self) -> None:
        self.unverified = ()
        self.lost_states, self.lost_time, self.longest_loss = 0, 0.0, 0.0
        self._noted, self._states, self._lost_since, self._last = {}, 0, None, -np.inf

    def note(self, time: float, judgement: Judgement) -> None:
        """Add the judgement of a state (s)."""
        self._states += 1
        if self._lost_since is not None:
            self.lost_time += time - self._last
            self.longest_loss = max(self.longest_loss, time - self._lost_since)
        if judgement.verdict is Verdict.FAILED:
            self.lost_states += 1
            self._lost_since = time if self._lost_since is None else self._lost_since
        else:
            self._lost_since = None
        self._last = time
        for finding in judgement.findings:
            self._add(time, finding)

    def _add(self, time: float, finding: Finding) -> None:
        before = self._noted.get(finding.code)
        if before is None:
            self._noted[finding.code] = Noted(finding, time, time)
            return
        strength = (finding.verdict.rank, finding.weight)
        known = (before.finding.verdict.rank, before.finding.weight)
        strongest = finding if strength > known else before.finding
        states = before.states + (time > before.last)
        self._noted[finding.code] = Noted(strongest, before.first, time, states)

    def _has_passed(self, noted: Noted) -> bool:
        """Return whether a finding was momentary, and long ago."""
        lasting = noted.last - noted.first
        return (
            noted.finding.code in PASSING_CODES
            and lasting <= PASSING_S
            and self._last - noted.last >= QUIET_FACTOR * PASSING_S
        )

    @property
    def trust(self) -> Trust:
        """The worst findings of all states.

        A loss that was recovered only leaves a doubt, and residuals of one second long ago a
        remark: the states of that second have their own verdicts.
        """
        result = []
        for noted in self._noted.values():
            finding = noted.finding
            if finding.verdict is Verdict.FAILED and self._lost_since is None:
                finding = replace(finding, verdict=Verdict.DOUBTFUL)
            if self._has_passed(noted) and finding.verdict is Verdict.DOUBTFUL:
                finding = replace(finding, verdict=Verdict.TRUSTWORTHY)
            share = f" ({noted.states} of {self._states} states,"
            share += f" {noted.first:.1f} to {noted.last:.1f} s)"
            result.append(replace(finding, text=finding.text + share))
        return Trust(tuple(result), self.unverified)
