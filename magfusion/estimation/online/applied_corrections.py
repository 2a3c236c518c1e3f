"""Corrections of a running estimate: mistakes of the declared site that are undone."""

import json
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from magfusion.estimation.graph.state import POSITION, ROTATION
from magfusion.estimation.integrity.correction import Correction, corrected_finding
from magfusion.estimation.online.input_history import KEPT
from magfusion.estimation.online_integrity.judgement import Judgement
from magfusion.estimation.online_integrity.score_online import OnlineScore
from magfusion.files.site import site_content
from magfusion.model.site import Site
from magfusion.model.trust import Finding
from magfusion.units import Array

Size = tuple[float, float]  # of attitude (rad) and position (m)
MAX_WAIT = 600.0  # s; between corrections, doubled each time: a hundredth of the processor
MAX_MISTAKES = 2  # undone together; with more, the site is another one


class AppliedCorrections:
    """What is undone, how uncertain that leaves the states, and when the next may be tried.

    `findings`: one a mistake, with its remedy. `content`: of the corrected site's file, as JSON.
    `last`: the last correction; its alternative is tried first where the corrected states are
    contradicted. A checkpoint has none.
    """

    findings: tuple[Finding, ...]
    content: str | None
    _spread: dict[
        str, dict[str, Size]
    ]  # by code, and by rival that is not refuted ("" of the step)
    _next: float
    _wait: float

    def __init__(self) -> None:
        self.findings, self.content, self._spread = (), None, {}
        self.last: Correction | None = None
        self._next, self._wait = -np.inf, KEPT

    def offered(self, possible: tuple[Correction, ...]) -> tuple[Correction, ...]:
        """Return what may be tried, the most likely first: before all others the alternative."""
        if self.last is None or self.last.alternative is None:
            return possible
        return self.last.alternative._replace(is_alternative=True), *possible

    def due(self, now: float) -> bool:
        """Return whether another correction may be tried at a time (s), and note that it is."""
        if now < self._next or len(self.findings) >= MAX_MISTAKES:
            return False
        self._next, self._wait = now + self._wait, min(2.0 * self._wait, MAX_WAIT)
        return True

    def further(
        self, correction: Correction, declared: Site, reasons: Iterable[Finding]
    ) -> "AppliedCorrections":
        """Return these with one more; parameters as of `corrected_finding`."""
        result = AppliedCorrections()
        finding = corrected_finding(correction, declared, reasons)
        known = self.findings[:-1]  # an alternative takes the place of the last one
        if not correction.is_alternative:
            known = tuple(f for f in self.findings if f.code != finding.code)
            earlier = next((f for f in self.findings if f.code == finding.code), finding)
            finding = replace(finding, text=earlier.text)  # that of a step has only the remainder
        result.findings, result.last = (*known, finding), correction
        result._spread = {f.code: self._spread[f.code] for f in known if f.code in self._spread}
        result.content = json.dumps(site_content(correction.site))
        result._next, result._wait = self._next, self._wait
        return result

    def widen(self, spread: Array) -> None:
        """Take over the covariance of a pose by the uncertainty of the last one, shape (6, 6)."""
        assert self.last is not None
        rivals = {rival.key: _size(rival.spread[-1]) for rival in self.last.rivals}
        self._spread[self.findings[-1].code] = {"": _size(spread)} | rivals

    def drop_refuted(self, score: OnlineScore) -> None:
        """Drop the uncertainty by rivals of the last correction that later data refute."""
        own = self._spread.get(self.findings[-1].code, {}) if self.findings else {}
        if self.last is None or len(own) < 2:
            return
        remaining = {"", *(rival.key for rival in score.open_rivals(self.last))}
        self._spread[self.findings[-1].code] = {k: v for k, v in own.items() if k in remaining}

    def doubted(self, judgement: Judgement) -> Judgement:
        """Return a judgement with the doubt that the corrections leave."""
        if not self.findings:
            return judgement
        own = (judgement.turn, judgement.shift)
        every = [size for sizes in self._spread.values() for size in sizes.values()]
        turn, shift = np.linalg.norm([own, *every], axis=0).tolist()
        judgement = judgement.with_findings(*self.findings)
        return replace(judgement, turn=turn, shift=shift)


def _size(spread: Array) -> Size:
    """Return the largest sigmas of attitude and position of a covariance."""
    largest = [np.linalg.eigvalsh(spread[part, part])[-1] for part in (ROTATION, POSITION)]
    turn, shift = np.sqrt(np.maximum(largest, 0.0)).tolist()
    return turn, shift
