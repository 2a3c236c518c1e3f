"""Isolate the fault of a doubtful or failed result, among usual mistakes.

Where a test contradicts a result, and the streams do not show a cause themselves, the usual
mistakes are tried; see `hypothesis_tests`.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.body_iron import EXPLAINED, IRON_SPAN, fitted_magnet
from magfusion.estimation.data_checks.magnetometers import first_magnetometer
from magfusion.estimation.data_checks.still_means import still_means
from magfusion.estimation.integrity.explanation import Explanation
from magfusion.estimation.integrity.hypothesis_tests import OF_MOTION, cause_of
from magfusion.estimation.integrity.steel_test import STEEL
from magfusion.files.site_changes import changed_keys
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.receiver.windows import LockinSettings

# What the raw streams show themselves needs no other cause.
OF_SAMPLES = {
    "false_samples",
    "frozen_imu",
    "frozen_magnetometer",
    "imu_spikes",
    "range_switched",
    "repeated_samples",
    "saturated",
    "streams_apart",
    "stuck_axis",
}
# What the streams show themselves, which comes before what follows of it.
# What gravity, static field and gyroscope show clearly where they fail a log, with any effect.
OF_GRAVITY_AND_FIELD = {"accel_units", "gravity_missing", "gravity_sign", "gyro_sign", "gyro_units"}
# Of these a sensor measures nothing, or in another unit, and whatever follows is of that.
NOT_MEASURED = {"frozen_imu", "frozen_magnetometer", "range_switched", "saturated", "stuck_axis"}
# What follows of a field that is not as declared, wherever it comes from.
OF_FIELDS = {
    "beacon_excluded",
    "field_innovations",
    "field_residuals",
    "found_again",
    "restarts",
    "separation",
}
SEEN = OF_SAMPLES | {
    "changed",
    "low_signal",
    "mains",
    "samples_lost",
    "silent_beacon",
    "undeclared_line",
}
# Codes as which gravity, field and gyroscope show a mistake, besides its own.
SHOWN_BY = {"accel_units": ("gravity_missing",), "imu_axes": ("gyro_sign", "gravity_sign")}
CLEAR = 30.0  # ratio of chi square
CAUSE_FIRST = 1e6  # weight: a cause comes before what it causes
OF_SEEN = CAUSE_FIRST / 2.0  # and before what the streams show, which may be another fault
# A finding that only localises a fault may be an effect of what they show.
OF_CATCH_ALL = CAUSE_FIRST / 4.0


MATRIX_OFF = "magnetometer_matrix"  # code


class Diagnosis(NamedTuple):
    """The mistake that explains a log."""

    finding: Finding
    site: Site | None  # in which it is corrected, where it can be
    ratio: float  # of chi square before to that after
    is_estimate: bool = False  # whether it has estimated values of parameters
    rival: "Diagnosis | None" = None  # as of `Explanation`, with its probability
    rival_probability: float = 0.5

    @property
    def is_clear(self) -> bool:
        """Whether snapshots decide, whatever the score, which is linear, or a change explains."""
        return self.ratio > CLEAR


def diagnosed(
    log: Log, site: Site, trust: Trust, settings: LockinSettings | None = None
) -> Diagnosis | None:
    """Return the cause of what the tests contradict, where one explains the log.

    `trust`: their findings; where it is trustworthy, nothing is tried, and only what is clear
    outweighs steel. Of what the streams show themselves only the correction is sought. `settings`:
    of the estimator.
    """
    if trust.verdict is Verdict.TRUSTWORTHY:
        return None
    shown = shown_by_gravity_and_field(trust)
    if seen_in_streams(trust) and not shown:
        return None
    if not site.beacons or any(beacon.unknown is not None for beacon in site.beacons):
        return None
    is_steel = any(finding.code == STEEL for finding in trust.reasons)
    if is_steel and site.without_steel() is not site:
        return None  # its map is not of what is there
    several = bool(site.platform.further)
    log, site = first_magnetometer(log, site)
    # Of all that can be wrong nothing is needed where nothing is.
    try:
        explained = cause_of(log, site, settings)
    except (EstimationError, InputError, np.linalg.LinAlgError):
        return None  # a log of which nothing can be tried
    if explained is None:
        return None
    one, text = explained
    if shown and not shown & {one.code, *SHOWN_BY.get(one.code, ())}:
        return None
    parts = trust.verdict, log, site
    known = _diagnosis(one, text, *parts, several=several)
    explains_all = one.after < one.expected and not one.catch_all
    if is_steel and not (known.is_clear or explains_all):
        return None
    if one.rival is None:
        return known
    of = OF_MOTION if text == one.text(OF_MOTION) else "the fields"
    rival = _diagnosis(one.rival, one.rival.text(of), *parts, several=several)
    return known._replace(rival=rival, rival_probability=one.rival_probability)


def _with_offset(log: Log, site: Site) -> Site:
    """Return a site whose magnetometer has the offset that its static field shows.

    Iron on the body adds to the matrix, which the beacons' fields determine, a field of its own.
    """
    magnet = fitted_magnet(still_means(log, site, IRON_SPAN), site)
    if magnet is None or magnet.explained < EXPLAINED:
        return site
    return magnet.compensated_in(site, soft=False)


def _diagnosis(
    one: Explanation, text: str, verdict: Verdict, log: Log, declared: Site, *, several: bool
) -> Diagnosis:
    """Return an explanation as a finding; what several magnetometers share is not corrected."""
    weight = OF_CATCH_ALL if one.catch_all else CAUSE_FIRST
    corrected = None if several else one.site
    if corrected is not None and one.code == MATRIX_OFF:
        corrected = _with_offset(log, corrected)
    remedy = None if corrected is None else changed_keys(declared, corrected)
    finding = Finding(one.code, text, verdict, weight, remedy=remedy or None)
    ratio = one.before / max(one.after, 1e-9)
    return Diagnosis(finding, corrected, ratio, one.parameter_count > 0)


def seen_in_streams(trust: Trust) -> bool:
    """Return whether the raw streams show a cause themselves, so that no other is looked for."""
    return bool(shown_by_gravity_and_field(trust)) or any(
        f.code in OF_SAMPLES and f.verdict is not Verdict.TRUSTWORTHY for f in trust.findings
    )


def shown_by_gravity_and_field(trust: Trust) -> set[str]:
    """Return the codes by which gravity, field and gyroscope fail a log."""
    failed = (f.code for f in trust.findings if f.verdict is Verdict.FAILED)
    return OF_GRAVITY_AND_FIELD.intersection(failed)


def _is_wrong_throughout(trust: Trust) -> bool:
    """Return whether a sensor measures nothing, or gravity, field and gyroscope fail a log.

    No parameter changed meanwhile: a step explains a part of anything.
    """
    codes = {*OF_GRAVITY_AND_FIELD, "magnetometer_axes", "mounting"}
    return any(
        f.code in NOT_MEASURED or (f.code in codes and f.verdict is Verdict.FAILED)
        for f in trust.reasons
    )


def with_cause(trust: Trust, cause: Diagnosis | None) -> Trust:
    """Return the findings on a result, the cause first where it is known."""
    diverged = any(finding.code == "diverged" for finding in trust.findings)
    wrong = _is_wrong_throughout(trust)

    def placed(finding: Finding) -> Finding:
        if finding.code == "changed" and wrong:
            return replace(finding, weight=min(finding.weight, 1.0))
        if finding.code in SEEN and finding.verdict is not Verdict.TRUSTWORTHY:
            return replace(finding, verdict=trust.verdict, weight=OF_SEEN + finding.weight)
        if diverged and finding.code not in ("diverged", "geometry"):
            # What is derived of a result that is none is no cause of it.
            return replace(finding, weight=min(finding.weight, 1.0))
        return finding

    findings = tuple(placed(finding) for finding in trust.findings)
    return Trust(findings if cause is None else (*findings, cause.finding), trust.unverified)


def with_explaining_cause(trust: Trust, cause: Diagnosis | None) -> Trust:
    """Return the findings on a result that is not solved again with its cause corrected.

    Reasons that a mistake explains are listed under it.
    """
    trust = with_cause(trust, cause)
    if cause is None:
        before = NOT_MEASURED if _is_wrong_throughout(trust) else {*NOT_MEASURED, "changed"}
        known = (f for f in trust.reasons if f.code in before)
        first = min(known, key=lambda f: f.code not in NOT_MEASURED, default=None)
    else:
        first = cause.finding
    if first is None:
        return trust
    # A finding that only localises a fault explains no more than its effects there.
    every = first.code in NOT_MEASURED or (cause is not None and first.weight >= CAUSE_FIRST)

    # Where little misfit remains, or one instrument's range, no parameter has changed in the log.
    is_clear = first.code == "range_switched" or (cause is not None and cause.is_clear)
    seen = SEEN - {"changed"} if is_clear else SEEN

    def is_explained(finding: Finding) -> bool:
        doubts = finding.verdict is not Verdict.TRUSTWORTHY and finding is not first
        return doubts and finding.code not in seen and (every or finding.code in OF_FIELDS)

    codes = (f.code for f in trust.ordered if is_explained(f) and f.code != first.code)
    kept = tuple(f for f in trust.findings if f is not first and not is_explained(f))
    explained = tuple(dict.fromkeys((*first.explained, *codes)))
    return Trust((*kept, replace(first, explained=explained)), trust.unverified)


def with_changed_beacons(trust: Trust, changes: Mapping[str, Finding]) -> Trust:
    """Return findings in which the changes of beacons precede, and explain, all others.

    `changes`: by name of a beacon that is excluded since then, which its change explains.
    """
    if not changes:
        return trust
    own = tuple(f"Beacon {name} contradicts" for name in changes)
    kept = [f for f in trust.findings if not f.text.startswith(own)]
    traces = {
        f.code for f in kept if f.verdict is Verdict.DOUBTFUL and f.code not in SEEN - {"changed"}
    }
    kept = [f for f in kept if f.verdict is not Verdict.DOUBTFUL or f.code not in traces]
    explained = tuple(sorted(traces - {"changed"}))
    # Samples that are late throughout look like any change.
    late = any(f.code == "repeated_samples" for f in trust.reasons)
    weight = 0.0 if late else CAUSE_FIRST
    first = (replace(f, weight=weight, explained=explained) for f in changes.values())
    return replace(trust, findings=(*kept, *first))


def with_corrected(trust: Trust, corrected: tuple[Finding, ...]) -> Trust:
    """Return the findings on a result of a corrected site, without others of the same codes."""
    codes = {finding.code for finding in corrected}
    kept = tuple(f for f in trust.findings if f.remedy or f.code not in codes)
    return replace(trust, findings=kept)
