"""Integration of each rest to one epoch, for beacons far below the noise of the raw samples."""

import itertools
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.signal import BeaconDetection
from magfusion.estimation.rests.reference_noise_cancellation import (
    CleanedPieces,
    JudgedTone,
    ReferenceHistory,
    align_reference,
    clean_pieces,
    judge_tone,
    reference_findings,
)
from magfusion.estimation.rests.rest_lengths import coherent, piece_length, walk
from magfusion.model.detection_range import tones_of
from magfusion.model.samples import FieldSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.strapdown import resting
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.hum import hum_of
from magfusion.receiver.integration import (
    MIN_LENGTHS,
    FrequencySearch,
    Integrated,
    chance_of_any,
    searched,
)
from magfusion.receiver.pieces import Pieces
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings, default_settings, sent_frequencies_hz
from magfusion.units import Array, BoolArray

TOO_SHORT = "rest too short"
MIN_RATE = 1e-3  # rad/s; a bias of the gyroscope may look like that


@dataclass(frozen=True, eq=False)
class IntegratedRests:
    """The rests of a log, one epoch each."""

    # synchronised beacons are always included; other beacons that are not detected have a NaN
    # phasor
    fields: FieldSamples
    # (n, channels), probability that noise alone reaches this amplitude, over all frequencies tried
    chance: Array
    detected: BoolArray  # (n, channels), where ``chance`` is below the requested false-alarm rate
    dropped: Mapping[str, int]  # reason to number of rests
    findings: tuple[Finding, ...] = ()  # undetected beacons, with upper bounds of their fields
    # (n, channels), ratio by which the reference sensor reduces the sigma of a phasor; NaN where it
    # is not used
    gain: Array | None = None

    def log(self, log: Log) -> Log:
        """Return the log with these epochs in place of its waveform."""
        findings = (*log.findings, *self.findings)
        return replace(
            log, waveform=None, fields=self.fields, drive=None, reference=None, findings=findings
        )

    def amplitude(self) -> Array:
        """Return the amplitudes of phasors without the bias by noise, (n, channels) (T)."""
        size = np.sum(np.abs(self.fields.phasor_sensor) ** 2, axis=-1)
        noise = 2.0 * np.trace(self.fields.phasor_cov, axis1=-2, axis2=-1)
        return np.sqrt(np.maximum(size - noise, 0.0))

    def detection(self, site: Site) -> BeaconDetection:
        """Return the detection of each beacon by its strongest tone."""
        names = tuple(b.name for b in site.beacons)
        size = self.amplitude()
        sigma = np.sqrt(np.trace(self.fields.phasor_cov, axis1=-2, axis2=-1) / 3.0)
        own = [[c for c, (b, _) in enumerate(site.channels) if b == name] for name in names]
        strongest = [np.nanmax(np.nan_to_num(size[:, c]), axis=1) for c in own]
        snr = [np.nanmax(np.nan_to_num(size[:, c] / sigma[:, c]), axis=1) for c in own]
        strong = [np.any(self.detected[:, c], axis=1) for c in own]
        return BeaconDetection(
            self.fields.time,
            names,
            np.stack(snr, axis=1),
            np.stack(strongest, axis=1),
            np.stack(strong, axis=1),
        )


def _epochs_at_rest(
    log: Log, site: Site, usual: LockinSettings, lockin: LockinSettings | None, least: int
) -> tuple[list[tuple[tuple[float, float], float]], Counter[str]]:
    """Return the span and piece length of each epoch, and the counts of rejected rests.

    `usual`: chosen by the tones of the site. `lockin`, `least`: as of `integrate_rests`.
    """
    longest, dropped = coherent(site), Counter[str]()
    spans: list[tuple[tuple[float, float], float]] = []
    result = rests(log, site)
    divided = -(-least // max(len(result), 1))
    for span in result:
        duration = span[1] - span[0]
        length, separated = piece_length(site, usual, lockin, duration / divided), divided
        if length is None:
            length, separated = piece_length(site, usual, lockin, duration), 1
        if length is None:
            dropped[TOO_SHORT] += 1
            continue
        ends = np.linspace(*span, max(int(np.ceil(duration / longest)), separated) + 1)
        spans += [((begin, end), length) for begin, end in itertools.pairwise(ends.tolist())]
    return spans, dropped


def integrate_rests(
    log: Log,
    site: Site,
    lockin: LockinSettings | None = None,
    false_alarm: float = 1e-3,
    least: int = 1,
) -> IntegratedRests:
    """Return the rests of a log with a waveform, one epoch each.

    `lockin`: length of the pieces, and the mains; by default chosen by the tones. `false_alarm`:
    probability of detecting an absent beacon in a rest. `least`: minimum number of epochs: where
    there are fewer rests, each is divided. Raises InputError where there is no waveform or no long
    rest, or coils are driven in time slots.
    """
    if log.waveform is None:
        raise InputError("has no magnetometer.parquet to integrate at rest; give the raw log")
    check_tones(site)
    usual = default_settings(site)
    mains_hz = (usual if lockin is None else lockin).mains_hz
    spans, dropped = _epochs_at_rest(log, site, usual, lockin, least)
    parts = [rest_epoch(log, span, site, length, mains_hz, false_alarm) for span, length in spans]
    if not parts:
        need = MIN_LENGTHS * usual.window
        short = f" ({dropped[TOO_SHORT]} are shorter)" if dropped else ""
        raise InputError(
            f"--at-rest: the log has no rest of {need:.3g} s{short}; keep the platform still for"
            " longer, or adapt platform.motion to its vibration"
        )
    fields = FieldSamples.joined([part.fields for part in parts])
    chance = np.stack([part.chance for part in parts])
    detected = chance < false_alarm
    findings = (*assumed_stationary(log), *undetected_in_rests(fields, detected, site, false_alarm))
    gain = None
    if log.reference is not None:
        gain = np.array([[tone.gain for tone in part.tones] for part in parts])
        findings += reference_findings([part.tones for part in parts], site)
    free_parameters = np.array([not site.beacons[k].synchronised for k in site.owner])
    elapsed = free_parameters & ~detected
    phasor = np.where(elapsed[..., None], np.nan, fields.phasor_sensor)
    fields = replace(fields, phasor_sensor=phasor)
    return IntegratedRests(fields, chance, detected, dropped, findings, gain)


def check_tones(site: Site) -> None:
    """Raise an error for tones that cannot be integrated over whole rests."""
    if has_schedule(site):
        raise InputError("--at-rest integrates tones, but a beacon has time slots; omit --at-rest")
    if tones_of(site).reused:
        raise InputError(
            "--at-rest integrates one beacon per tone, but beacons share a frequency; omit"
            " --at-rest"
        )


def rests(log: Log, site: Site) -> list[tuple[float, float]]:
    """Return beginning and end of each interval in which the platform rests (s).

    Without inertial samples the whole log is assumed to be one rest.
    """
    assert log.waveform is not None
    first, last = float(log.waveform.time[0]), float(log.waveform.time[-1])
    if not log.inertial:
        return [(first, last)]
    stamps = log.imu.time + site.platform.imu.time_offset
    gyro, motion = log.imu.gyro_body, site.platform.motion
    still = resting(stamps, gyro, log.imu.accel_body, motion=motion)
    still[1:] &= np.diff(stamps) < motion.rest_span
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    slow = max(MIN_RATE, 5.0 * site.platform.imu.gyro_bias_sigma)
    result = []
    for begin, end in edges.reshape(-1, 2):
        # An even turn has a quiet gyroscope, too.
        turns = np.linalg.norm(np.mean(gyro[begin:end], axis=0)) > slow
        span = max(float(stamps[begin]), first), min(float(stamps[end - 1]), last)
        # Half a span before the first quiet sample is at rest, too.
        ends = begin == np.argmax(still), end == len(still) - np.argmax(still[::-1])
        half = 0.5 * motion.rest_span
        span = (
            first if ends[0] and span[0] - first < 2.0 * half else span[0],
            last if ends[1] and last - span[1] < 2.0 * half else span[1],
        )
        if not turns and span[1] > span[0]:
            result.append(span)
    return result


@dataclass(frozen=True, eq=False)
class Rest:
    """One rest, or the part of it that makes one epoch."""

    fields: FieldSamples  # of one epoch
    chance: Array  # (channels,), probability that noise alone reaches this amplitude
    tones: list[JudgedTone]
    known: ReferenceHistory | None  # for later parts of the same stream


def rest_epoch(
    log: Log,
    span: tuple[float, float],
    site: Site,
    length: float,
    mains_hz: float,
    false_alarm: float,
    known: ReferenceHistory | None = None,
) -> Rest:
    """Return one rest as an epoch.

    `span`: its beginning and end (s). `length`: of the pieces (s). `known`: results of earlier
    parts of a stream for its reference.
    """
    assert log.waveform is not None
    rows = slice(*np.searchsorted(log.waveform.time, span))
    wave = Waveform(log.waveform.time[rows], log.waveform.measured_sensor[rows])
    hum = hum_of(wave, mains_hz)
    time, nominal_hz = 0.5 * (span[0] + span[1]), sent_frequencies_hz(site)
    monitor = align_reference(wave, log.reference, nominal_hz, hum, known)

    def by(sent_hz: Array) -> CleanedPieces:
        return clean_pieces(wave, span, sent_hz, length, hum, monitor, known)

    result, sent_hz = by(nominal_hz), nominal_hz.copy()
    searches = _searches(result.best(), site, nominal_hz)
    if searches:
        for c, (name, _) in enumerate(site.channels):
            if name in searches:
                sent_hz[c] *= 1.0 + searches[name].drift
        result = by(sent_hz)
    result = replace(result, raw=_at_declared_drives(result.raw, site, time))
    best = _at_declared_drives(result.best(), site, time)
    tones = [judge_tone(result, best, c, time, site, false_alarm) for c in range(len(nominal_hz))]
    single = [one.tone for one in tones]
    phase = np.exp(2j * np.pi * (sent_hz - nominal_hz) * time)
    cov = np.stack(
        [
            one.cov + _wandered(one, site, float(nominal_hz[c]), span[1] - span[0], site.owner[c])
            for c, one in enumerate(single)
        ]
    )
    fields = FieldSamples(
        time=np.array([time]),
        window=np.array([span[1] - span[0]]),
        channels=site.channels,
        phasor_sensor=(np.stack([one.phasor for one in single]) * phase[:, None])[None],
        phasor_cov=cov[None],
    )
    if known is not None and monitor is not None:
        normals = tuple(None if one is None else one.normal for one in result.relations)
        known = ReferenceHistory(monitor.clock, monitor.lag, normals)
    return Rest(fields, _chances(single, site, searches), tones, known)


def _searches(result: Pieces, site: Site, nominal_hz: Array) -> dict[str, FrequencySearch]:
    """Return the frequency search of each beacon without synchronisation."""
    searches = {}
    for beacon in site.beacons:
        if not beacon.synchronised:
            tones = [c for c, (name, _) in enumerate(site.channels) if name == beacon.name]
            searches[beacon.name] = searched(
                result, tones, nominal_hz, site.relative_clock.drift_largest
            )
    return searches


def _at_declared_drives(result: Pieces, site: Site, time: float) -> Pieces:
    """Return pieces scaled to the drive currents at the middle of a rest, where recorded."""
    if site.drives is None:
        return result
    phasor = result.phasor.copy()
    for c, (name, tone) in enumerate(site.channels):
        own = site.drives.at(name, tone, np.append(result.centre, time))
        if own is not None:
            share = np.exp(own[0] + 1j * own[1])
            phasor[:, c] *= (share[-1] / share[:-1])[:, None]
    return replace(result, phasor=phasor)


def _wandered(
    one: Integrated, site: Site, frequency_hz: float, duration: float, owner: int
) -> Array:
    """Return the covariance by drive phase drift within a rest, shape (3, 3) (T^2)."""
    variance = walk(site, frequency_hz, duration)
    square = np.real(np.outer(one.phasor, np.conj(one.phasor)))
    if not site.beacons[owner].synchronised:
        solved = np.linalg.solve(one.cov, one.phasor)
        ratio = float(np.real(np.conj(one.phasor) @ solved))
        variance += (one.centroid / one.spread) ** 2 / max(ratio, 1.0)
    return np.asarray(variance * square)


def _chances(
    single: list[Integrated], site: Site, searches: Mapping[str, FrequencySearch]
) -> Array:
    own = [one.chance for one in single]
    for name, search in searches.items():
        tones = [c for c, (beacon, _) in enumerate(site.channels) if beacon == name]
        together = chance_of_any([own[c] for c in tones], search.trials)
        for c in tones:
            own[c] = together
    return np.array(own)


def assumed_stationary(log: Log) -> tuple[Finding, ...]:
    """Return a warning where the log has no IMU to confirm that the platform rests."""
    if log.inertial:
        return ()
    text = (
        "The log has no IMU: all of it is assumed to be one rest. If the platform moved, cut the"
        " log (--start, --end), or record an IMU with it."
    )
    return (Finding("few_data", text, Verdict.TRUSTWORTHY),)


def undetected_in_rests(
    fields: FieldSamples, detected: BoolArray, site: Site, false_alarm: float
) -> tuple[Finding, ...]:
    """Return the finding of tones that are in no rest distinguished from noise."""
    below = []
    sigma = np.sqrt(np.trace(fields.phasor_cov, axis1=-2, axis2=-1) / 3.0)
    size = np.sqrt(np.sum(np.abs(fields.phasor_sensor) ** 2, axis=-1))
    for c in np.flatnonzero(~detected.any(axis=0)).tolist():
        name, tone = site.channels[c]
        maximum = float(np.min(size[:, c] + 2.0 * sigma[:, c]))
        which = f"{name}, tone {tone}" if (name, 1) in site.channels else name
        below.append(f"{which} (below {maximum:.2g} T)")
    if not below:
        return ()
    none = not np.any(detected)
    text = (
        f"Below the noise, at a false-alarm rate of {false_alarm:g} a rest: {', '.join(below)}."
        " Rest longer, reduce the distance, or increase the transmitted power."
    )
    if none:
        text = f"no beacon is detected. {text}"
    verdict = Verdict.FAILED if none else Verdict.TRUSTWORTHY
    return (Finding("low_signal", text, verdict, 1e3 if none else 1.0),)
