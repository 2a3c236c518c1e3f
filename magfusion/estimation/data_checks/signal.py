"""Reception of each beacon along a log: never, with interruptions, or barely detected."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.detection import DETECTION_CHI_SQUARE
from magfusion.estimation.data_checks.samples import runs
from magfusion.model.detection_range import largest_fields, phasor_sigma, tones_of
from magfusion.model.noise import sensor_positions, whitening
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import LISTED, Finding, Verdict
from magfusion.receiver.receivers import received, usual_lockin
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray

HARDLY = 0.05  # share of the epochs; a beacon detected in fewer counts as silent
MAX_UNDETECTED_SHARE = 0.1  # share of the epochs without any beacon, from which it casts doubt
SILENCE = 1.0  # s; shorter silence is not reported
FALLEN = 0.2  # of the neighbouring amplitude; below, a beacon is switched off
NEAR = 10  # epochs beside a silence that it is compared with
EDGE = 3  # epochs in which the field of a beacon that is switched off falls
MIN_SNR = (DETECTION_CHI_SQUARE / 6.0) ** 0.5  # that is detected
CERTAIN_DETECTION_RATIO = (
    3.0  # times the weakest detectable field: beyond, one of many beacons must be detected
)
SAME_WINDOW = 1e-6  # s; between the centres of identical windows


@dataclass(frozen=True, eq=False)
class BeaconDetection:
    """Reception of the beacons."""

    time: Array  # (n,) (s)
    beacons: tuple[str, ...]
    # (n, beacons), amplitude of the strongest tone over its noise, a component each; NaN where it
    # is missing
    snr: Array
    amplitude: Array  # (n, beacons), of all its tones (T), including noise
    strong: BoolArray  # (n, beacons), whether it is detected
    # whether components are missing: a field perpendicular to the others looks like silence
    across: bool = False
    # whether there are so many beacons that each is out of range for a while, so that the end of
    # its signal need not be a fault
    passed_by: bool = False


class Detected(NamedTuple):
    """Which beacons are detected in phasors that are compensated for motion."""

    time: Array  # (n,) (s)
    beacons: tuple[str, ...]
    strong: BoolArray  # (n, beacons)


def detect_beacons(samples: FieldSamples, site: Site) -> BeaconDetection:
    """Return the reception of each beacon from phasors.

    A missing phasor is one that was not detected; where coils are driven in turn it may only be
    another's slot, and where beacons share frequencies another's phasor.
    """
    names = tuple(dict.fromkeys(name for name, _ in samples.channels))
    sqrt_information = whitening(samples.phasor_cov, samples.there)
    phasor = np.nan_to_num(samples.phasor_sensor)[..., None]
    square = np.sum(np.abs(sqrt_information @ phasor) ** 2, axis=(-1, -2))
    square = np.where(samples.valid, square, -np.inf)
    best = np.stack(
        [np.max(square[:, [n == name for n, _ in samples.channels]], axis=1) for name in names],
        axis=1,
    )
    power = np.nansum(
        np.abs(np.where(samples.valid[..., None], samples.phasor_sensor, 0.0)) ** 2, 2
    )
    amplitude = np.stack(
        [
            np.sqrt(np.sum(power[:, [n == name for n, _ in samples.channels]], axis=1))
            for name in names
        ],
        axis=1,
    )
    there = np.isfinite(best)
    if not (has_schedule(site) or tones_of(site).reused):
        best, there = np.maximum(best, 0.0), np.ones_like(there)
    snr = np.where(there, np.sqrt(np.maximum(best, 0.0) / 6.0), np.nan)
    strong = there & (best > DETECTION_CHI_SQUARE)
    across = bool(np.any(samples.partial))
    return BeaconDetection(samples.time, names, snr, amplitude, strong, across)


def detect_in_log(
    log: Log, site: Site, lockin: LockinSettings | None = None
) -> BeaconDetection | None:
    """Return the reception of each beacon in a log; None where no window is usable."""
    if log.waveform is None:
        return None if log.fields is None else detect_beacons(log.fields, site)
    try:
        return detect_beacons(received(log.waveform, log.imu, site, lockin)[0], site)
    except InputError:
        return None


def detected_in(samples: FieldSamples, site: Site) -> Detected:
    """Return which beacons are detected in the phasors of a solution."""
    result = detect_beacons(samples, site)
    return Detected(result.time, result.beacons, result.strong)


def with_motion_compensation(raw: BeaconDetection, compensated: Detected) -> BeaconDetection:
    """Return the reception with the motion inside the windows compensated.

    `raw`: with that motion in the noise. `compensated`: by a solution; those of its windows that
    are among ``raw``'s count.
    """
    if len(compensated.time) == 0:
        return raw
    nearest = np.clip(np.searchsorted(compensated.time, raw.time), 1, len(compensated.time) - 1)
    nearest -= raw.time - compensated.time[nearest - 1] < compensated.time[nearest] - raw.time
    among = np.flatnonzero(np.abs(compensated.time[nearest] - raw.time) < SAME_WINDOW)
    columns = np.array([raw.beacons.index(name) for name in compensated.beacons])
    strong = raw.strong.copy()
    strong[np.ix_(among, columns)] |= compensated.strong[nearest[among]]
    return replace(raw, strong=strong)


def within_reach(
    detection: BeaconDetection, site: Site, poses: Trajectory | None
) -> BeaconDetection:
    """Return the reception of those of many beacons that are detected at all, or must be.

    A beacon must be detected where even its weakest field at that distance is far above the noise.
    `poses`: reliable poses at some epochs; None where unknown.
    """
    due = np.zeros(len(detection.beacons), dtype=bool)
    if poses is not None and not has_schedule(site):
        places = sensor_positions(site, poses)[:, 0]
        least = 0.5 * np.max(largest_fields(site, places), axis=0)
        sigma = phasor_sigma(site, usual_lockin(site).window)
        strong = least > CERTAIN_DETECTION_RATIO * np.sqrt(DETECTION_CHI_SQUARE) * sigma
        names = {name for (name, _), one in zip(site.channels, strong, strict=True) if one}
        due = np.array([name in names for name in detection.beacons])
    share = _share(detection)
    kept = np.flatnonzero(due | (share >= HARDLY))
    if not len(kept):
        return replace(detection, passed_by=True)
    return replace(
        detection,
        beacons=tuple(detection.beacons[k] for k in kept.tolist()),
        snr=detection.snr[:, kept],
        amplitude=detection.amplitude[:, kept],
        strong=detection.strong[:, kept],
        passed_by=True,
    )


def _share(detection: BeaconDetection) -> Array:
    """Return the share of its epochs in which each beacon is detected, shape (beacons,)."""
    reported = np.maximum(np.sum(np.isfinite(detection.snr), axis=0), 1)
    return np.asarray(np.sum(detection.strong, axis=0) / reported)


def undetected_findings(
    detection: BeaconDetection, site: Site, *, aided: bool = False
) -> Iterator[Finding]:
    """Yield the beacons that are silent, always or for a while, and epochs without any beacon.

    `aided`: whether another sensor measures the motion, so that epochs without a beacon are no
    doubt.
    """
    if len(detection.time) == 0:
        return
    share = _share(detection)
    if np.all(share < HARDLY):
        best = float(
            np.nanmax(np.nanmedian(np.where(np.isnan(detection.snr), 0.0, detection.snr), axis=0))
        )
        yield Finding(
            "low_signal",
            f"no beacon is detected: the strongest is {best:.2g} times its noise. All are switched"
            " off, far away or on other frequencies, or the noise is large.",
            Verdict.FAILED,
            1e3,
        )
        return
    reported = np.isfinite(detection.snr).any(axis=1)
    alone = float(np.mean(~detection.strong[reported].any(axis=1)))
    if alone > MAX_UNDETECTED_SHARE and not detection.across:
        yield Finding(
            "low_signal",
            f"no beacon is detected in {100.0 * alone:.0f} % of the epochs: all are far away there,"
            " or the noise is large.",
            Verdict.TRUSTWORTHY if aided else Verdict.DOUBTFUL,
            100.0,
        )
    frequency = {b.name: b.tone_frequencies_hz for b in site.beacons}
    tones = [" and ".join(f"{f:g} Hz" for f in frequency[name]) for name in detection.beacons]
    never = np.flatnonzero(share < HARDLY).tolist()
    if never:
        yield _never_detected([(detection.beacons[k], tones[k]) for k in never])
    masked = []
    for k in range(len(tones)):
        if k in never or detection.across:
            continue
        named = f"{detection.beacons[k]} ({tones[k]})"
        off, far = _silences(detection, k)
        if off:
            yield Finding(
                "silent_beacon",
                f"beacon {named} is silent from {_places(off)}: it was switched off.",
                Verdict.DOUBTFUL,
                50.0 + sum(end - begin for begin, end in off),
            )
        if far:
            masked.append(f"beacon {named} is below the noise from {_places(far)}")
    if masked:
        more = f", and {len(masked) - LISTED} more beacons at times" if len(masked) > LISTED else ""
        yield Finding(
            "low_signal",
            f"{'; '.join(masked[:LISTED])}{more}: it is far away, or motion and other fields"
            " dominate.",
            Verdict.TRUSTWORTHY,
        )


def _never_detected(beacons: list[tuple[str, str]]) -> Finding:
    """Return one finding about beacons, given their names and tones."""
    if len(beacons) == 1:
        ((name, tones),) = beacons
        subject, them = f"beacon {name} is never detected at {tones}: it is", "it"
    else:
        named = ", ".join(f"{name} ({tones})" for name, tones in beacons[:LISTED])
        more = f" and {len(beacons) - LISTED} more" if len(beacons) > LISTED else ""
        subject, them = f"beacons {named}{more} are never detected: they are", "them"
    return Finding(
        "silent_beacon",
        f"{subject} switched off, out of range, or on another frequency. Switch {them} on, or"
        f" remove {them} from site.yaml.",
        weight=400.0,
    )


def _silences(
    detection: BeaconDetection, k: int
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Return when a beacon was switched off, and when it was only not detected (s)."""
    there = np.isfinite(detection.snr[:, k])
    time, strong = detection.time[there], detection.strong[there, k]
    amplitude, snr = detection.amplitude[there, k], detection.snr[there, k]
    off: list[tuple[float, float]] = []
    masked: list[tuple[float, float]] = []
    if len(time) < 2:
        return off, masked
    step = float(np.median(np.diff(time)))
    quiet = runs(~strong)
    long = (quiet.last - quiet.first) * step > SILENCE
    for first, last in zip(quiet.first[long], quiet.last[long], strict=True):
        others = np.append(amplitude[max(first - NEAR, 0) : first], amplitude[last : last + NEAR])
        elapsed = not detection.passed_by
        elapsed &= float(np.median(amplitude[first:last])) < FALLEN * float(np.median(others))
        # Who drives out of range leaves it at the weakest field that is detected.
        edges = np.append(snr[max(first - EDGE, 0) : first], snr[last : last + EDGE])
        elapsed &= float(np.max(edges, initial=0.0)) > CERTAIN_DETECTION_RATIO * MIN_SNR
        stretch = (float(time[first] - 0.5 * step), float(time[last - 1] + 0.5 * step))
        (off if elapsed else masked).append(stretch)
    return off, masked


def _places(stretches: list[tuple[float, float]]) -> str:
    more = f" and {len(stretches) - LISTED} more" if len(stretches) > LISTED else ""
    return ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in stretches[:LISTED]) + more
