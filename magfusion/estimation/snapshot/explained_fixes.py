"""Fixes of a log with the fewest estimated parameters that explain its fields.

A beacon whose gain error varies with position, and one at another position than declared, both
cause residuals.  The hypotheses are tried in order: no error, one faulty beacon, and only then a
gain of every beacon.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.snapshot.fix import Fixes, Gravity
from magfusion.estimation.snapshot.fix_separation import separate_fixes, separation_trust
from magfusion.estimation.snapshot.fix_witness import judged_fixes
from magfusion.estimation.snapshot.gain_spread import FEWEST, gain_spread
from magfusion.estimation.snapshot.gain_witness import gains_of
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.estimation.snapshot.problem import GAIN_SIGMA
from magfusion.model.parameters import Calibration
from magfusion.model.progress import Report, quiet
from magfusion.model.samples import FieldSamples
from magfusion.model.trust import Risk, StateTrust, Trust, Verdict
from magfusion.units import IntArray

OF_FIELDS = ("field_residuals", "separation")  # codes of inconsistent fields


@dataclass(frozen=True, eq=False)
class ExplainedFixes:
    """Fixes with their findings.

    Parameters
    ----------
    fixes : Fixes
        With covariances that cover the findings.
    states : StateTrust
        Of each epoch.
    trust : Trust
        Of the whole.
    gain_spread : float
        Standard deviation of the log-gains estimated with the poses; zero if they are fixed.
    """

    fixes: Fixes
    states: StateTrust
    trust: Trust
    gain_spread: float


def explained_fixes(
    samples: FieldSamples,
    calibration: Calibration,
    *,
    gravity: Gravity | None = None,
    survey_error: bool = True,
    free: tuple[str, ...] = (),
    risk: Risk | None = None,
    report: Report = quiet,
) -> ExplainedFixes:
    """Fix every epoch independently, without faulty beacons, with estimated gains if necessary.

    A spread of gains is estimated if the fixes with fixed gains, without the one faulty beacon,
    still contradict the fields; it is used if it removes the contradiction.  If most epochs receive
    one beacon it is not: its gain and range are not separable, and any error would change position.

    Parameters
    ----------
    samples : FieldSamples
        Channels in the site's order.
    gravity, survey_error, free
        As in `magfusion.estimation.snapshot.likelihood.fix_epochs`; with ``gain`` the spread is
        always estimated and used.
    risk : Risk, optional
        Requirements for the protection levels.

    Raises
    ------
    EstimationError
        Where there is no epoch.
    """
    how = _How(samples, calibration, gravity, survey_error, Risk() if risk is None else risk)
    held = tuple(part for part in free if part != "gain")
    asked = "gain" in free
    fixes = how.fixed(held, 0.0)
    report("fixing without each beacon", 2, 3)
    found = None if asked else how.judged(fixes, held, 0.0)
    if found is not None and (
        _explained(found.trust)
        or np.sum(fixes.determined[:, 0]) < FEWEST
        or np.median(_beacons_heard(samples, calibration)) < 2
    ):
        return found
    spread = gain_spread(
        samples, calibration, fixes, gravity=gravity, survey_error=survey_error, free=held
    )
    if not spread:
        return found or how.judged(fixes, held, 0.0)
    loose = how.judged(how.fixed((*held, "gain"), spread), (*held, "gain"), spread)
    if found is None or not _said(loose.trust):
        return loose
    return found


@dataclass(frozen=True)
class _How:
    """Inputs and risk of fixes."""

    samples: FieldSamples
    calibration: Calibration
    gravity: Gravity | None
    survey_error: bool
    risk: Risk

    def fixed(self, free: tuple[str, ...], spread: float) -> Fixes:
        """Return the fixes with all beacons."""
        return fix_epochs(
            self.samples,
            self.calibration,
            gravity=self.gravity,
            survey_error=self.survey_error,
            free=free,
            gain_sigma=spread or GAIN_SIGMA,
        )

    def judged(self, fixes: Fixes, free: tuple[str, ...], spread: float) -> ExplainedFixes:
        """Exclude faulty beacons, and return the fixes with their findings."""
        separated = separate_fixes(
            self.samples,
            self.calibration,
            fixes,
            gravity=self.gravity,
            survey_error=self.survey_error,
            free=free,
            gain_sigma=spread or GAIN_SIGMA,
            risk=self.risk,
        )
        site, numbers = self.calibration.site, np.sum(self.samples.numbers, axis=1)
        final, states, trust = judged_fixes(separated.fixes, separated.states, numbers)
        names = tuple(beacon.name for beacon in site.beacons)
        trust |= separation_trust(separated, names, self.risk)
        if spread:
            trust |= Trust(tuple(gains_of(final, site, spread)))
        return ExplainedFixes(final, states, trust, spread)


def _beacons_heard(samples: FieldSamples, calibration: Calibration) -> IntArray:
    """Return how many beacons each epoch has, shape (n,)."""
    site = calibration.site
    each = [np.any(samples.valid[:, site.owner == k], axis=1) for k in range(len(site.beacons))]
    return np.sum(each, axis=0)


def _said(trust: Trust) -> list[str]:
    """Return the codes of all findings of inconsistent fields."""
    return [
        finding.code
        for finding in trust.findings
        if finding.code == "beacon_excluded"
        or (finding.code in OF_FIELDS and finding.verdict is not Verdict.TRUSTWORTHY)
    ]


def _explained(trust: Trust) -> bool:
    """Return whether one faulty beacon, or none, explains all fields."""
    return _said(trust) in ([], ["beacon_excluded"])
