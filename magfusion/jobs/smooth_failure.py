"""What is saved of a log that cannot be smoothed: the single-epoch fixes, and the likely cause."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from magfusion.errors import UNOBSERVABLE
from magfusion.estimation.batch.batch import SmootherSettings
from magfusion.estimation.data_checks.data_quality import BRIDGED_CODES, recorded
from magfusion.estimation.demodulation.demodulation import first_fixes, phasors
from magfusion.estimation.integrity.fault_isolation import (
    OF_CATCH_ALL,
    Diagnosis,
    diagnosed,
    with_explaining_cause,
)
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.jobs.fix import write_fix_result
from magfusion.jobs.result_directory import found_in
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.results.figures import Figure, Figures, Section, heading
from magfusion.results.report import dropped_figures, fix_figures
from magfusion.results.verdict import trust_figures

CONTRADICTION = "the inconsistency of fields and inertial data is too large for a solution"


class Failure(NamedTuple):
    """A log without a trajectory.

    `reason`: the cause, where it is known. `dropped`: windows that were left out, by reason.
    """

    reason: str
    trust: Trust
    cause: Diagnosis | None
    fixes: Fixes
    dropped: Mapping[str, int]


def failure_of(log: Log, site: Site, settings: SmootherSettings, reason: str) -> Failure:
    """Return why there is no trajectory, with the fixes of single epochs."""
    samples, dropped = phasors(log, site, settings.lockin)
    fixes = first_fixes(samples, log, initial_calibration(site, float(np.mean(samples.time))))
    code = "no_solution"
    if reason.startswith(UNOBSERVABLE):
        code = "geometry" if np.mean(fixes.determined[:, 0]) < 0.5 else "diverged"
        what = f"{UNOBSERVABLE}: add a beacon or a coil"
        reason = what if code == "geometry" else CONTRADICTION
    text = f"There is no trajectory: {reason}."
    none = Finding(code, text, Verdict.FAILED, weight=0.0)
    trust = Trust((none, *recorded(log, site, BRIDGED_CODES, beacons=True)))
    cause = None
    if code != "geometry":  # of poses that no epoch determines nothing can be tried
        cause = diagnosed(log, site, trust, settings.lockin)
        trust = with_explaining_cause(trust, cause)
    if trust.ordered[0].weight >= OF_CATCH_ALL:
        reason = trust.ordered[0].text.rstrip(".")
    return Failure(reason, trust, cause, fixes, dropped)


def save_failure(whole: Path, failure: Failure, log: Log, site: Site) -> None:
    """Write the fixes to the failed directory, and the report."""
    figures = heading("smooth", log.name) | trust_figures(failure.trust)
    figures |= Figures(Figure("failed", failure.reason, section=Section.REPORT))
    figures |= fix_figures(failure.fixes, site) | dropped_figures(failure.dropped)
    directory = found_in(whole, failure.trust)
    write_fix_result(directory, log, site, failure.fixes, figures)
    (directory / "report.json").rename(whole / "report.json")
