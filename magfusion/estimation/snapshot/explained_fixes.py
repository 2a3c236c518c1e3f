"""Fixes of a log in which as little is free as explains its fields.

A beacon whose gain errs from place to place, and one that stands elsewhere than declared, both
leave residuals.  The fewest errors that explain all of them are told: none, one false beacon, and
only then gains of every beacon.
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

OF_FIELDS = ("field_residuals", "separation")  # codes of what the fields say against the site


@dataclass(frozen=True, eq=False)
class ExplainedFixes:
    """Fixes with what is to be said of them.

    Parameters
    ----------
    fixes : Fixes
        With covariances that cover what was found.
    states : StateTrust
        Of each epoch.
    trust : Trust
        Of the whole.
    gain_spread : float
        Standard deviation of the log-gains that were found beside the poses; zero where held.
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
    """Fix every epoch on its own, without false beacons, gains free where nothing less explains it.

    A spread of gains is asked for where the fixes that hold them, without the one beacon that is
    false, still contradict the fields; it is taken where with it nothing does.  Where most epochs
    hear one beacon it is not: its gain is its range, and whatever errs would pass for a place.

    Parameters
    ----------
    samples : FieldSamples
        Channels in the site's order.
    gravity, survey_error, free
        As in `magfusion.estimation.snapshot.likelihood.fix_epochs`; with ``gain`` the spread is
        asked for, and taken, in any case.
    risk : Risk, optional
        What the protection levels promise.

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
    """Of what fixes are made and by what they are judged."""

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
        """Return them without what is false, and what is to be said of them."""
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
    """Return how many beacons each epoch holds, shape (n,)."""
    site = calibration.site
    each = [np.any(samples.valid[:, site.owner == k], axis=1) for k in range(len(site.beacons))]
    return np.sum(each, axis=0)


def _said(trust: Trust) -> list[str]:
    """Return the codes of all that the fields say against the site."""
    return [
        finding.code
        for finding in trust.findings
        if finding.code == "beacon_excluded"
        or (finding.code in OF_FIELDS and finding.verdict is not Verdict.TRUSTWORTHY)
    ]


def _explained(trust: Trust) -> bool:
    """Tell whether one false beacon, or none, explains all fields."""
    return _said(trust) in ([], ["beacon_excluded"])
