"""A log is smoothed again with the mistake in its site undone, where that explains everything.

A correction is accepted only if no test contradicts the corrected result: the remedy that a report
gives is the one with which this result was made.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import smooth
from magfusion.estimation.integrity.correction import (
    MOST_SOLUTIONS,
    REFINED,
    Correction,
    corrected_finding,
    with_rival_frame,
)
from magfusion.files.site_changes import changed_keys
from magfusion.jobs.smooth_result import Finished, finished
from magfusion.model.progress import Report, quiet
from magfusion.model.trust import Verdict

if TYPE_CHECKING:
    from magfusion.estimation.batch.batch import SmootherSettings
    from magfusion.model.samples import Log
    from magfusion.model.site import Site
    from magfusion.model.trust import Finding, Risk


def corrected(
    log: Log,
    site: Site,
    settings: SmootherSettings,
    risk: Risk | None,
    possible: list[Correction],
    reasons: tuple[Finding, ...],
    findings: tuple[Finding, ...] = (),
    report: Report = quiet,
) -> Finished | None:
    """Return the result with a corrected site; None where no correction explains the log.

    Parameters
    ----------
    possible : list of Correction
        The most likely first.
    reasons : tuple of Finding
        Why the result without a correction is not trustworthy.
    findings : tuple of Finding
        As of `finished`.
    """
    if site.platform.further or any(beacon.unknown is not None for beacon in site.beacons):
        return None
    # What no key of the site's file describes cannot be corrected.
    waiting = [one for one in possible if changed_keys(site, one.site)]
    best, again = None, False
    for _ in range(MOST_SOLUTIONS):
        if not waiting:
            break
        correction = waiting.pop(0)
        if not again:
            correction = correction._replace(spread=with_rival_frame(site, correction))
        finding = corrected_finding(correction, site, reasons)
        try:
            result = smooth(log, correction.site, settings, report)
        except (RuntimeError, InputError):
            continue
        trial = correction._replace(finding=finding)
        used = correction.site, settings, result, risk
        done = finished(log, *used, findings=findings, correction=trial)
        alone = len(done.trust.reasons) == 1
        if alone or ((again or best is None) and _explains_most(correction, done)):
            best = done
        again = done.continued is not None
        if done.continued is not None:
            known = correction.finding
            if correction.fault is None:
                known = replace(known, text=known.text + REFINED)
            waiting.insert(0, done.continued._replace(finding=known))
        elif best is done and (alone or not _has_rival(correction, waiting)):
            break
        else:
            waiting = [one._replace(rival_probability=0.0) for one in waiting]
    return best


def _has_rival(correction: Correction, waiting: list[Correction]) -> bool:
    """Return whether another site with the same mistake undone is still to be tried."""
    return any(one.finding.code == correction.finding.code for one in waiting)


def _explains_most(correction: Correction, done: Finished) -> bool:
    """Return whether a gross mistake is undone, with a small remainder."""
    return correction.clear and done.trust.verdict is not Verdict.FAILED
