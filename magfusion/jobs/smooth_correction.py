"""A log is smoothed again with the mistake in its site undone, where that explains everything.

A correction is accepted only if no test contradicts the corrected result: the remedy that a report
gives is the one with which this result was made.
"""

from magfusion.errors import InputError
from magfusion.estimation.batch.batch import SmootherSettings, smooth
from magfusion.estimation.integrity.correction import (
    MAX_SOLUTIONS,
    Correction,
    Trial,
    as_estimated,
    best_trial,
    corrected_finding,
    released,
)
from magfusion.files.site_changes import changed_keys
from magfusion.jobs.smooth_result import Finished, finished
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Risk, Verdict


def corrected(
    log: Log,
    site: Site,
    settings: SmootherSettings,
    risk: Risk | None,
    possible: list[Correction],
    reasons: tuple[Finding, ...],
    findings: tuple[Finding, ...] = (),
    report: Report = quiet,
    *,
    mapping: bool = False,
) -> Finished | None:
    """Return the result with a corrected site; None where no correction explains the log.

    Parameters
    ----------
    possible : list of Correction
        The most likely first.
    reasons : tuple of Finding
        Why the result without a correction is not trustworthy.
    findings, mapping
        As of `finished`.
    """
    if site.platform.further or any(beacon.unknown is not None for beacon in site.beacons):
        return None

    def tried(one: Correction) -> Trial[Finished] | None:
        correction = released(one, site, settings.estimate)
        used = log, correction.site, settings
        try:
            result = smooth(*used, report)
        except (RuntimeError, InputError):
            return None
        estimate = result.calibration, result.blocks, result.calibration_cov
        finding = corrected_finding(as_estimated(correction, site, *estimate), site, reasons)
        trial = correction._replace(finding=finding)
        done = finished(*used, result, risk, findings=findings, correction=trial, mapping=mapping)
        nearly = correction.clear and done.trust.verdict is not Verdict.FAILED
        return Trial(done, len(done.trust.reasons) == 1, nearly, done.continued)

    # What no key of the site's file describes cannot be corrected.
    known = [one for one in possible if changed_keys(site, one.site)]
    # A whole log decides between a correction that is refined and its rival.
    has_rival = any(one.alternative is not None for one in known)
    return best_trial(known, tried, MAX_SOLUTIONS + has_rival)
