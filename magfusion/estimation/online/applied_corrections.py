"""Corrections of a running estimate: mistakes of the declared site that are undone."""

import json
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from magfusion.estimation.graph.state import POSITION, ROTATION
from magfusion.estimation.integrity.correction import Correction, corrected_finding
from magfusion.estimation.online.input_history import KEPT
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.files.site import site_content
from magfusion.model.site import Site
from magfusion.model.trust import Finding
from magfusion.units import Array

LONGEST_WAIT = 600.0  # s; between corrections, doubled each time: a hundredth of the processor
MOST_MISTAKES = 2  # undone together; with more, the site is another one


class AppliedCorrections:
    """What is undone, how uncertain that leaves the states, and when the next may be tried.

    `findings`: one a mistake, with its remedy. `content`: of the corrected site's file, as JSON.
    """

    findings: tuple[Finding, ...]
    content: str | None
    _turn: float
    _shift: float
    _next: float
    _wait: float

    def __init__(self) -> None:
        self.findings, self.content = (), None
        self._turn, self._shift = 0.0, 0.0
        self._next, self._wait = -np.inf, KEPT

    def due(self, now: float) -> bool:
        """Return whether another correction may be tried at a time (s), and note that it is."""
        if now < self._next or len(self.findings) >= MOST_MISTAKES:
            return False
        self._next, self._wait = now + self._wait, min(2.0 * self._wait, LONGEST_WAIT)
        return True

    def further(
        self, correction: Correction, declared: Site, reasons: Iterable[Finding]
    ) -> "AppliedCorrections":
        """Return these with one more; parameters as of `corrected_finding`."""
        result = AppliedCorrections()
        finding = corrected_finding(correction, declared, reasons)
        for earlier in self.findings:
            if earlier.code == finding.code:  # the text of a further step has only the remainder
                finding = replace(finding, text=earlier.text)
        known = (f for f in self.findings if f.code != finding.code)
        result.findings = (*known, finding)
        result.content = json.dumps(site_content(correction.site))
        result._next, result._wait = self._next, self._wait
        return result

    def widen(self, spread: Array) -> None:
        """Take over the covariance of a pose by the uncertainty of a correction, shape (6, 6)."""
        largest = [np.linalg.eigvalsh(spread[part, part])[-1] for part in (ROTATION, POSITION)]
        self._turn, self._shift = np.sqrt(np.maximum(largest, 0.0)).tolist()

    def doubted(self, judgement: Judgement) -> Judgement:
        """Return a judgement with the doubt that the corrections leave."""
        if not self.findings:
            return judgement
        turn, shift = np.hypot(judgement.turn, self._turn), np.hypot(judgement.shift, self._shift)
        judgement = judgement.with_findings(*self.findings)
        return replace(judgement, turn=float(turn), shift=float(shift))
