"""The verdict on a result, as figures: first on the screen and in ``report.json``."""

from dataclasses import replace
from typing import Any

import numpy as np

from magfusion.model.trust import Finding, StateTrust, Trust, Unverified, Verdict
from magfusion.results.figures import Figure, Figures, Section

# Answers of jobs that judge no estimate, in the colours of those that do.
_LOOKS = {
    "stable": Verdict.TRUSTWORTHY,
    "inconclusive": Verdict.DOUBTFUL,
    "unstable": Verdict.FAILED,
    "reached": Verdict.TRUSTWORTHY,
    "not reached": Verdict.FAILED,
    "pass": Verdict.TRUSTWORTHY,
    "not proven": Verdict.DOUBTFUL,
}
MAX_TEXTS = 3  # of findings of one code; more are counted


def look_of(answer: str) -> Verdict:
    """Return the verdict in whose colours an answer is shown."""
    return _LOOKS[answer] if answer in _LOOKS else Verdict(answer)


def trust_figures(trust: Trust, answer: str | None = None) -> Figures:
    """Return verdict, reasons, remarks and unverified parameters, for the head of a report.

    `answer`: in place of the verdict, of a job that does not judge an estimate.
    """
    verdict = str(trust.verdict) if answer is None else answer
    return Figures(
        Figure("verdict", verdict, section=Section.VERDICT),
        Figure("reasons", finding_rows(_one_of_each(trust.reasons)), section=Section.VERDICT),
        Figure("remarks", finding_rows(trust.remarks), section=Section.VERDICT),
        Figure("unverified", [_unverified(u) for u in trust.unverified], section=Section.VERDICT),
    )


def notes_of(trust: Trust) -> Figures:
    """Return all findings as the key ``notes``, which these reports have always had.

    The screen shows them with the verdict.
    """
    sentences = [finding.text for finding in trust.ordered]
    return Figures(Figure("notes", sentences, section=Section.REPORT))


def _one_of_each(findings: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Return one finding of each code, as of several axes or beacons, with all their remedies."""
    of_code: dict[str, list[Finding]] = {}
    for finding in findings:
        of_code.setdefault(finding.code, []).append(finding)
    result = []
    for every in of_code.values():
        texts = list(dict.fromkeys(one.text for one in every))
        more = len(texts) - MAX_TEXTS
        text = " ".join([*texts[:MAX_TEXTS], *([f"{more} more of this kind."] * (more > 0))])
        # That of the most important one, where two are of one key.
        remedy = {k: v for one in reversed(every) for k, v in (one.remedy or {}).items()}
        explained = tuple(dict.fromkeys(code for one in every for code in one.explained))
        result.append(replace(every[0], text=text, remedy=remedy or None, explained=explained))
    return tuple(result)


def finding_rows(findings: tuple[Finding, ...]) -> list[dict[str, Any]]:
    """Return findings as a report has them, with a remedy and what they explain."""
    rows = []
    for finding in findings:
        row: dict[str, Any] = {"code": finding.code, "text": finding.text}
        if finding.remedy is not None:
            row["remedy"] = dict(finding.remedy)
        if finding.explained:
            row["explains"] = list(finding.explained)
        rows.append(row)
    return rows


def _unverified(one: Unverified) -> dict[str, Any]:
    return {
        "parameter": one.name,
        "sigma": one.sigma,
        "position_m": one.position_m,
        "rotation_deg": one.rotation_deg,
    }


def level_figures(states: StateTrust, beacons: int | None = None) -> Figures:
    """Return the median protection levels, and in how many states beacons were excluded.

    `beacons`: number of beacons of the site, for the cause of the level.
    """
    known = np.isfinite(states.protection_level_m)
    deg = states.protection_level_deg[np.isfinite(states.protection_level_deg)]
    left_out = sum(1 for names in states.excluded if names)
    return Figures(
        Figure(
            "protection_level_median_m",
            float(np.median(states.protection_level_m[known])) if np.any(known) else None,
            "m",
            label="protection level, position",
        ),
        Figure(
            "protection_level_median_deg",
            float(np.median(deg)) if len(deg) else None,
            "deg",
            label="protection level, attitude",
        ),
        *(
            ()
            if beacons is None
            else (
                Figure(
                    "protection_level_cause",
                    _level_cause(states, beacons, bool(np.any(known))),
                    section=Section.REPORT,
                ),
            )
        ),
        Figure("states_without_level", int(np.sum(~known)), section=Section.REPORT),
        Figure("states_with_exclusion", left_out, section=Section.REPORT),
    )


def _level_cause(states: StateTrust, beacons: int, known: bool) -> str:
    """Return how many beacons bound the error where one of them is faulty, and a remedy."""
    if not known:
        few = "a single beacon has no other to be compared with; add two"
        return few if beacons == 1 else "see the reasons of the verdict"
    excluded = int(np.median([len(names) for names in states.excluded])) if states.excluded else 0
    count = beacons - excluded
    of = f"{count} of {beacons}" if excluded else f"{count}"
    if count <= 2:
        return f"{of} beacons: if one is faulty, the other alone bounds the error; add one"
    return f"bounds the error if any one of {of} beacons is faulty"
