"""Quick check of a log in seconds: all tests that need no solution."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.data_checks.data_quality import recorded
from magfusion.estimation.data_checks.disturbing_lines import judged_lines, with_disturbing_lines
from magfusion.estimation.data_checks.signal import BeaconDetection, detect_in_log, within_reach
from magfusion.estimation.data_checks.spectrum import SpectralLine, Spectrum, named_lines, spectrum
from magfusion.estimation.data_checks.stamps import Timing, timings
from magfusion.estimation.data_checks.still_means import StillMeans, still_means
from magfusion.estimation.demodulation.beacon_selection import select_detected
from magfusion.estimation.demodulation.burial_depth import depths_of
from magfusion.estimation.demodulation.demodulation import phasors
from magfusion.estimation.integrity.fault_isolation import (
    Diagnosis,
    diagnosed,
    with_explaining_cause,
)
from magfusion.estimation.integrity.hypothesis_tests import (
    QUANTISED,
    coarse_steps,
    distorted_by,
    of_steps,
)
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.detection_range import are_many
from magfusion.model.parameters import initial_calibration
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import SYMPTOMS, Finding, Trust, Verdict
from magfusion.receiver.cycles import whole_cycles
from magfusion.receiver.receivers import usual_lockin
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array

EPOCHS = 24  # number of fixes
TOLERATED_CODES = frozenset({"samples_lost"})  # handled by every estimator
# Causes of a log without any usable window.
CORRUPTING_CODES = frozenset({"saturated", "jitter", "gap", "samples_lost", "frozen_magnetometer"})
DOUBT = Verdict.DOUBTFUL
MIN_UNEXPLAINED = 3  # unexplained epochs
NOTHING_EXPLAINED = 30.0  # residual from which the fixes are useless
FIX_PROBABILITY = 0.95  # probability of a fix that is compared with gravity and static field
UNEXPLAINED = 3.0  # residual of the fixes, one where noise, model and survey are as declared


@dataclass(frozen=True, eq=False)
class Look:
    """Results of a quick check."""

    trust: Trust
    timings: tuple[Timing, ...]
    means: StillMeans
    # None without a site, or where no window can be demodulated
    detected: BeaconDetection | None = None
    spectrum: Spectrum | None = None
    lines: tuple[SpectralLine, ...] | None = None  # all its significant lines, including tones
    fixes: Fixes | None = None  # of a few epochs
    # range (m) and skin depths of each detected beacon; empty without a conductor
    depths: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    cause: Diagnosis | None = None  # the mistake that explains the log

    @property
    def fix_residual(self) -> float:
        """Median residual of the fixes; NaN without any."""
        if self.fixes is None or len(self.fixes) == 0:
            return float("nan")
        return float(np.median(self.fixes.residual_rms[:, 0]))

    def detection_rows(self) -> list[tuple[str, float, float]]:
        """Return name, median signal-to-noise ratio and share of detected epochs per beacon."""
        if self.detected is None or len(self.detected.time) == 0:
            return []
        snr = np.nan_to_num(self.detected.snr)
        shares = np.mean(self.detected.strong, axis=0)
        return [
            (name, float(np.median(snr[:, k])), float(shares[k]))
            for k, name in enumerate(self.detected.beacons)
        ]


def quick_check(log: Log, site: Site | None, lockin: LockinSettings | None = None) -> Look:
    """Check a log; without a site only the recording."""
    result = spectrum(log, site)
    seen = None if result is None else named_lines(result, site)
    look = timings(log, site), still_means(log, site)
    if site is None or not site.beacons:
        return Look(Trust(recorded(log, site)), *look, None, result, seen)
    findings: list[Finding] = []
    many = are_many(site)
    with suppress(InputError):  # later checks report why nothing is detected
        log, site = select_detected(log, site, lockin)
    try:
        samples = phasors(log, site, lockin)[0]
    except InputError as error:
        findings.append(Finding("no_window", f"{error}.", Verdict.FAILED, 10.0))
        samples = FieldSamples.empty(site.channels)
    detection = detect_in_log(log, site, lockin)
    if result is not None and not has_schedule(site):
        findings += _harmless_lines(result, log, site, lockin)
    fixes = _fixed(log, site, samples, look[1].time)
    poses = None
    if fixes is not None:
        findings += findings_of_fit(fixes)
        poses = _sure_poses(fixes)
    if many and detection is not None:
        detection = within_reach(detection, site, poses)
    findings += recorded(log, site, TOLERATED_CODES, poses, beacons=True, detection=detection)
    trust = Trust(tuple(_promoted(findings)))
    cause = None
    if trust.reasons and trust.reasons[0].code in SYMPTOMS:
        cause = diagnosed(log, site, trust, lockin)
        trust = with_explaining_cause(trust, cause)
    if cause is None:
        trust |= Trust(tuple(_coarse(log, samples, site)))
    depths = depths_of(samples, site)
    return Look(trust, *look, detection, result, seen, fixes, depths, cause)


def _coarse(log: Log, samples: FieldSamples, site: Site) -> Iterator[Finding]:
    """Yield that steps may distort the fields by more than the model's error explains."""
    step = coarse_steps(log, site) if len(samples) else None
    share = 0.0 if step is None else distorted_by(step, samples)
    if step is not None and share > UNEXPLAINED * site.model_error:
        text = of_steps(step, share, about="up to")
        yield Finding(QUANTISED, text, Verdict.TRUSTWORTHY, share)


def _harmless_lines(
    result: Spectrum, log: Log, site: Site, lockin: LockinSettings | None
) -> list[Finding]:
    """Return the harmless lines; `recorded` reports the others."""
    settings = with_disturbing_lines(log, site, lockin) or usual_lockin(site)
    return [
        line
        for line in judged_lines(result, site, settings)
        if line.verdict is Verdict.TRUSTWORTHY and line.code != "fitted_line"
    ]


def _sure_poses(fixes: Fixes) -> Trajectory | None:
    """Return the unambiguous fixes, if all of them fit."""
    certain = (fixes.probability[:, 0] > FIX_PROBABILITY) & fixes.determined[:, 0]
    if not np.any(certain) or findings_of_fit(fixes):
        return None
    best = fixes.best()
    return Trajectory(
        best.time[certain], best.world_from_body[certain], best.position_world[certain]
    )


def _promoted(findings: list[Finding]) -> list[Finding]:
    """Promote a defect of every window to the cause where no window is usable."""
    if not any(finding.code == "no_window" for finding in findings):
        return findings
    return [
        replace(f, verdict=Verdict.FAILED)
        if f.code in CORRUPTING_CODES and f.verdict is DOUBT
        else f
        for f in findings
    ]


def _fixed(log: Log, site: Site, samples: FieldSamples, near: Array) -> Fixes | None:
    """Fix a few epochs, at times with known gravity and static field, without using gravity."""
    if len(samples) == 0 or any(beacon.unknown is not None for beacon in site.beacons):
        return None
    strong = samples.valid.any(axis=1)
    if has_schedule(site):
        samples = whole_cycles(samples, log.imu, site)
        strong = np.ones(len(samples), dtype=bool)
    if not np.any(strong) or len(samples) == 0:
        return None
    usable = np.flatnonzero(strong)
    wanted = near if len(near) else samples.time[usable]
    wanted = wanted[np.unique(np.linspace(0, len(wanted) - 1, EPOCHS).astype(np.int64))]
    at = np.clip(np.searchsorted(samples.time[usable], wanted), 0, len(usable) - 1)
    chosen = np.zeros(len(samples), dtype=bool)
    chosen[usable[at]] = True
    some = samples.rows(chosen)
    try:
        return fix_epochs(some, initial_calibration(site, float(np.mean(samples.time))))
    except EstimationError:
        return None


def findings_of_fit(fixes: Fixes) -> list[Finding]:
    """Return the findings on fixes that do not explain the fields."""
    residual = fixes.residual_rms[:, 0]
    median, bad = float(np.median(residual)), residual > UNEXPLAINED
    if median > UNEXPLAINED:
        return [
            Finding(
                "field_residuals",
                f"no pose explains the beacons' fields: at {len(fixes)} epochs the median residual"
                f" is {median:.3g} (1 is expected). Positions, attitudes, frequencies, moments or"
                " phases of the beacons, or the epoch of the log, are not as declared.",
                Verdict.FAILED if median > NOTHING_EXPLAINED else DOUBT,
                20.0 + median,
            )
        ]
    if np.sum(bad) < MIN_UNEXPLAINED:
        return []
    time = fixes.time[bad]
    return [
        Finding(
            "field_residuals",
            f"no pose explains the beacons' fields at {int(np.sum(bad))} of {len(fixes)} epochs"
            f" between {time[0]:.1f} and {time[-1]:.1f} s: their median residual is"
            f" {float(np.median(residual[bad])):.3g} (1 is expected). The field of a beacon is"
            " wrong there, or iron is near.",
            DOUBT,
            20.0 + float(np.median(residual[bad])),
        )
    ]
