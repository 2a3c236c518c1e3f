"""Checks of the raw streams of a log, independent of the estimator."""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from magfusion.estimation.data_checks.body_iron import IRON_SPAN, calibrated, iron_on_body
from magfusion.estimation.data_checks.disturbing_lines import undeclared_lines
from magfusion.estimation.data_checks.gravity_and_field_checks import gravity_and_field_findings
from magfusion.estimation.data_checks.gyro_field_consistency import turned_otherwise
from magfusion.estimation.data_checks.inertial_noise import noisy_inertial
from magfusion.estimation.data_checks.pauses import repeated_samples
from magfusion.estimation.data_checks.range_step import range_step
from magfusion.estimation.data_checks.samples import (
    clipped_samples,
    false_samples,
    frozen_samples,
    wrapped_samples,
)
from magfusion.estimation.data_checks.signal import (
    BeaconDetection,
    Detected,
    detect_in_log,
    undetected_findings,
    with_motion_compensation,
)
from magfusion.estimation.data_checks.stamps import silent_aiding, uneven_stamps
from magfusion.estimation.data_checks.still_means import still_means
from magfusion.estimation.data_checks.truth import truth_findings
from magfusion.model.aiding import OF_MOTION
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Trust, Verdict
from magfusion.receiver.joint import long_windows
from magfusion.receiver.windows import LockinSettings

SampleTest = Callable[[Log, Site | None], Iterable[Finding]]

SAMPLE_TESTS: tuple[SampleTest, ...] = (
    uneven_stamps,
    frozen_samples,
    repeated_samples,
    clipped_samples,
    wrapped_samples,
    false_samples,
    noisy_inertial,
    range_step,
    silent_aiding,
)
MAX_DURATION = (
    1200.0  # s; of a longer log, compasses and spectrum are checked on its beginning only
)
MOUNTED = 0.1  # rad; largest sigma of a mounting that is known
# Of gyroscope and clocks: where they are wrong, the gyro-stabilized axes are wrong too.
UNSTEADY = frozenset(
    {"gyro_sign", "gyro_units", "gyro_scale", "imu_axes", "imu_clock", "stuck_axis"}
)
# Of an accelerometer that does not show the vertical, by which a truth is checked.
OF_GRAVITY = frozenset(
    {"accel_scale", "accel_units", "gravity_direction", "gravity_missing", "gravity_sign"}
)
# What estimators bridge with an honest covariance is reported and casts no doubt.
BRIDGED_CODES = frozenset({"gap", "samples_lost", "silent_beacon"})


def recorded(
    log: Log,
    site: Site | None,
    gap_bridged: Collection[str] = frozenset(),
    poses: Trajectory | None = None,
    *,
    estimated: Trajectory | None = None,
    beacons: bool = False,
    detection: BeaconDetection | None = None,
    lockin: LockinSettings | None = None,
    compensated: Detected | None = None,
) -> tuple[Finding, ...]:
    """Return the findings on a recording; without a site, on the streams alone.

    Parameters
    ----------
    gap_bridged : collection of str
        Codes of the findings that the estimator handles.
    poses : Trajectory, optional
        By the beacons: they decide which of vertical and field is wrong.
    estimated : Trajectory, optional
        By an estimator that also used gravity; decides the cause of a reversed vertical.
    beacons : bool
        Whether the result depends on the beacons: if so, their reception and undeclared lines
        are reported.
    detection : BeaconDetection, optional
        Their reception, if already known.
    lockin : LockinSettings, optional
        As requested.
    compensated : Detected, optional
        Their reception by a solution, with the motion inside the windows compensated.
    """
    result = [*log.findings, *(one for monitor in SAMPLE_TESTS for one in monitor(log, site))]
    log = beginning(log)
    # Of an unknown mounting the field and the gyroscope cannot be compared.
    mounted = site is None or is_mounted(site)
    of_turn = list(turned_otherwise(log, site)) if log.inertial and mounted else []
    if log.inertial and not any(finding.code in UNSTEADY for finding in (*result, *of_turn)):
        result += _static_findings(log, site, of_turn, poses, estimated, mounted=mounted)
        if not any(finding.code in OF_GRAVITY for finding in result):
            result += truth_findings(log)
    else:
        result += of_turn
    if beacons and site is not None and site.beacons:
        result += _of_beacons(log, site, detection, lockin, compensated)
    return tuple(
        replace(f, verdict=Verdict.TRUSTWORTHY) if f.code in gap_bridged else f for f in result
    )


def is_mounted(site: Site) -> bool:
    """Return whether the mounting of the magnetometer is known, so that iron can be tested."""
    return bool(np.max(site.platform.magnetometer.sigma.rotation_sensor) < MOUNTED)


def _static_findings(
    log: Log,
    site: Site | None,
    of_turn: Sequence[Finding],
    poses: Trajectory | None,
    estimated: Trajectory | None,
    *,
    mounted: bool,
) -> list[Finding]:
    """Return the findings on gravity and static field, without those that iron explains.

    `of_turn`: those on their rotation. `mounted`: whether the mounting of the magnetometer is
    known: only then is iron tested.
    """

    def others(known: Site | None) -> Iterator[Finding]:
        yield from of_turn if known is site else turned_otherwise(log, known)
        yield from gravity_and_field_findings(log, known, poses, estimated)

    result = list(others(site))
    if site is None or not mounted or log.vectors is None:
        return result
    means = still_means(log, site, IRON_SPAN)
    iron = list(iron_on_body(means, site))
    if not iron or not result:
        return [*result, *iron]
    remaining = {finding.code for finding in others(calibrated(means, site))}
    if remaining & {"magnetometer_axes", "mounting"}:  # with others, the iron is another, or none
        return result
    explained = tuple(sorted({finding.code for finding in result} - remaining))
    kept = [finding for finding in result if finding.code in remaining]
    return [*kept, *(replace(finding, explained=explained) for finding in iron)]


def _of_beacons(
    log: Log,
    site: Site,
    detection: BeaconDetection | None,
    lockin: LockinSettings | None,
    compensated: Detected | None,
) -> Iterator[Finding]:
    """Yield findings on each beacon's reception and on other lines; parameters as `recorded`."""
    yield from filter(_matters, undeclared_lines(log, site, lockin))
    if log.waveform is not None or log.waveforms:
        yield from long_windows(site, lockin)
    detection = detect_in_log(log, site) if detection is None else detection
    if detection is None:
        return
    if compensated is not None:
        detection = with_motion_compensation(detection, compensated)
    aided = any(samples.quantity in OF_MOTION for samples in log.aiding.values())
    yield from undetected_findings(detection, site, aided=aided)


def _matters(line: Finding) -> bool:
    return line.verdict is not Verdict.TRUSTWORTHY or line.code == "fitted_line"


def beginning(log: Log, span: float = MAX_DURATION) -> Log:
    """Return the first part of a log, of a length (s)."""
    end = float(log.imu.time[0]) + span if len(log.imu) else span
    if len(log.imu) and log.imu.time[-1] > end:
        kept = slice(0, int(np.searchsorted(log.imu.time, end)))
        imu = replace(
            log.imu,
            time=log.imu.time[kept],
            gyro_body=log.imu.gyro_body[kept],
            accel_body=log.imu.accel_body[kept],
        )
        log = replace(log, imu=imu)
    wave = log.waveform
    if wave is not None and len(wave) and wave.time[-1] > end:
        kept = slice(0, int(np.searchsorted(wave.time, end)))
        short = wave.rows(kept)
        log = replace(log, waveform=short)
    return log


def beyond(recording: Log, used: Log, site: Site) -> tuple[Finding, ...]:
    """Return the findings on a recording that do not show in the log made of it."""
    known = recorded(used, site, BRIDGED_CODES)
    return tuple(f for f in recorded(recording, site, BRIDGED_CODES) if f not in known)


def passed_on(log: Log, site: Site) -> Trust:
    """Return the findings on a log whose fields are only converted to another form.

    An estimator checks them again; what would fail its result is doubtful here.
    """
    result = recorded(log, site, BRIDGED_CODES)
    return Trust(
        tuple(
            replace(f, verdict=Verdict.DOUBTFUL) if f.verdict is Verdict.FAILED else f
            for f in result
        )
    )
