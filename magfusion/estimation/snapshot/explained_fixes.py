"""Fixes of a log with the fewest estimated parameters that explain its fields.

A beacon whose gain error varies with position, and one at another position than declared, both
cause residuals.  The hypotheses are tried in order: no error, one faulty beacon, and only then a
gain of every beacon.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.snapshot.fix import Fixes, Gravity
from magfusion.estimation.snapshot.fix_consistency import judged_fixes
from magfusion.estimation.snapshot.fix_separation import separate_fixes, separation_trust
from magfusion.estimation.snapshot.gain_consistency import gains_of
from magfusion.estimation.snapshot.gain_spread import MIN_EPOCHS, gain_spread
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
    """Fixes with their findings."""

    fixes: Fixes  # with covariances that cover the findings
    states: StateTrust  # of each epoch
    trust: Trust  # of the whole
    # standard deviation of the log-gains estimated with the poses; zero if they are fixed
    gain_spread: float


def explained_fixes(
    samples: FieldSamples,
    calibration: Calibration,
    *,
    gravity: Gravity | None = None,
    survey_error: bool = True,
    free_parameters: tuple[str, ...] = (),
    risk: Risk | None = None,
    report: Report = quiet,
) -> ExplainedFixes:
    """Fix every epoch independently, without faulty beacons, with estimated gains if necessary.

    A spread of gains is estimated if the fixes with fixed gains, without the one faulty beacon,
    still contradict the fields; it is used if it removes the contradiction.  If most epochs receive
    one beacon it is not: its gain and range are not separable, and any error would change position.
    `samples`: channels in the site's order. `gravity`, `survey_error`, `free_parameters`: as in
    `magfusion.estimation.snapshot.likelihood.fix_epochs`; with ``gain`` the spread is always
    estimated and used. `risk`: requirements for the protection levels. Raises EstimationError where
    there is no epoch.
    """
    how = _How(samples, calibration, gravity, survey_error, Risk() if risk is None else risk)
    fixed = tuple(part for part in free_parameters if part != "gain")
    requested = "gain" in free_parameters
    fixes = how.fixed(fixed, 0.0)
    report("fixing without each beacon", 2, 3)
    result = None if requested else how.judge(fixes, fixed, 0.0)
    if result is not None and (
        _explained(result.trust)
        or np.sum(fixes.determined[:, 0]) < MIN_EPOCHS
        or np.median(_beacon_counts(samples, calibration)) < 2
    ):
        return result
    spread = gain_spread(
        samples,
        calibration,
        fixes,
        gravity=gravity,
        survey_error=survey_error,
        free_parameters=fixed,
    )
    if not spread:
        return result or how.judge(fixes, fixed, 0.0)
    loose = how.judge(how.fixed((*fixed, "gain"), spread), (*fixed, "gain"), spread)
    if result is None or not _codes(loose.trust):
        return loose
    return result


@dataclass(frozen=True)
class _How:
    """Inputs and risk of fixes."""

    samples: FieldSamples
    calibration: Calibration
    gravity: Gravity | None
    survey_error: bool
    risk: Risk

    def fixed(self, free_parameters: tuple[str, ...], spread: float) -> Fixes:
        """Return the fixes with all beacons."""
        return fix_epochs(
            self.samples,
            self.calibration,
            gravity=self.gravity,
            survey_error=self.survey_error,
            free_parameters=free_parameters,
            gain_sigma=spread or GAIN_SIGMA,
        )

    def judge(
        self, fixes: Fixes, free_parameters: tuple[str, ...], spread: float
    ) -> ExplainedFixes:
        """Exclude faulty beacons, and return the fixes with their findings."""
        separated = separate_fixes(
            self.samples,
            self.calibration,
            fixes,
            gravity=self.gravity,
            survey_error=self.survey_error,
            free_parameters=free_parameters,
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


def _beacon_counts(samples: FieldSamples, calibration: Calibration) -> IntArray:
    """Return how many beacons each epoch has, shape (n,)."""
    site = calibration.site
    each = [np.any(samples.valid[:, site.owner == k], axis=1) for k in range(len(site.beacons))]
    return np.sum(each, axis=0)


def _codes(trust: Trust) -> list[str]:
    """Return the codes of all findings of inconsistent fields."""
    return [
        finding.code
        for finding in trust.findings
        if finding.code == "beacon_excluded"
        or (finding.code in OF_FIELDS and finding.verdict is not Verdict.TRUSTWORTHY)
    ]


def _explained(trust: Trust) -> bool:
    """Return whether one faulty beacon, or none, explains all fields."""
    return _codes(trust) in ([], ["beacon_excluded"])
