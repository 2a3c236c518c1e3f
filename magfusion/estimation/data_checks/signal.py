"""Reception of each beacon along a log: never, with interruptions, or barely detected."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.detection import DETECTION_CHI_SQUARE
from magfusion.estimation.data_checks.samples import runs
from magfusion.model.audibility import largest_fields, phasor_sigma, tones_of
from magfusion.model.noise import sensor_positions, whitening
from magfusion.model.samples import FieldSamples, Log
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.receivers import received, usual_lockin
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array, BoolArray

HARDLY = 0.05  # share of the epochs; a beacon detected in fewer counts as silent
UNHEARD = 0.1  # share of the epochs without any beacon, from which it casts doubt
SILENCE = 1.0  # s; shorter silence is not reported
FALLEN = 0.2  # of the neighbouring amplitude; below, a beacon is switched off
LISTED = 3
SURELY = 3.0  # times the weakest detectable field: beyond, one of many beacons must be detected
SAME_WINDOW = 1e-6  # s; between the centres of identical windows


@dataclass(frozen=True, eq=False)
class Heard:
    """Reception of the beacons.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    beacons : tuple of str
    snr : ndarray, shape (n, beacons)
        Amplitude of the strongest tone over its noise, a component each; NaN where it is missing.
    amplitude : ndarray, shape (n, beacons)
        Of all its tones (T), including noise.
    loud : bool ndarray, shape (n, beacons)
        Whether it is detected.
    across : bool
        Whether components are missing: a field perpendicular to the others looks like silence.
    passed_by : bool
        Whether there are so many beacons that each is out of range for a while, so that the end
        of its signal need not be a fault.
    """

    time: Array
    beacons: tuple[str, ...]
    snr: Array
    amplitude: Array
    loud: BoolArray
    across: bool = False
    passed_by: bool = False


class Detected(NamedTuple):
    """Which beacons are detected in phasors that are compensated for motion.

    Parameters
    ----------
    time : ndarray, shape (n,)
        (s)
    beacons : tuple of str
    loud : bool ndarray, shape (n, beacons)
    """

    time: Array
    beacons: tuple[str, ...]
    loud: BoolArray


def heard(samples: FieldSamples, site: Site) -> Heard:
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
    loud = there & (best > DETECTION_CHI_SQUARE)
    across = bool(np.any(samples.partial))
    return Heard(samples.time, names, snr, amplitude, loud, across)


def heard_in(log: Log, site: Site, lockin: LockinSettings | None = None) -> Heard | None:
    """Return the reception of each beacon in a log; None where no window is usable."""
    if log.waveform is None:
        return None if log.fields is None else heard(log.fields, site)
    try:
        return heard(received(log.waveform, log.imu, site, lockin)[0], site)
    except InputError:
        return None


def detected_in(samples: FieldSamples, site: Site) -> Detected:
    """Return which beacons are detected in the phasors of a solution."""
    found = heard(samples, site)
    return Detected(found.time, found.beacons, found.loud)


def heard_with_motion(raw: Heard, freed: Detected) -> Heard:
    """Return the reception with the motion inside the windows compensated.

    Parameters
    ----------
    raw : Heard
        With that motion in the noise.
    freed : Detected
        By a solution; those of its windows that are among ``raw``'s count.
    """
    if len(freed.time) == 0:
        return raw
    nearest = np.clip(np.searchsorted(freed.time, raw.time), 1, len(freed.time) - 1)
    nearest -= raw.time - freed.time[nearest - 1] < freed.time[nearest] - raw.time
    among = np.flatnonzero(np.abs(freed.time[nearest] - raw.time) < SAME_WINDOW)
    columns = np.array([raw.beacons.index(name) for name in freed.beacons])
    loud = raw.loud.copy()
    loud[np.ix_(among, columns)] |= freed.loud[nearest[among]]
    return replace(raw, loud=loud)


def within_reach(found: Heard, site: Site, poses: Trajectory | None) -> Heard:
    """Return the reception of those of many beacons that are detected at all, or must be.

    A beacon must be detected where even its weakest field at that distance is far above the noise.

    Parameters
    ----------
    poses : Trajectory, optional
        Reliable poses at some epochs; None where unknown.
    """
    due = np.zeros(len(found.beacons), dtype=bool)
    if poses is not None and not has_schedule(site):
        places = sensor_positions(site, poses)[:, 0]
        least = 0.5 * np.max(largest_fields(site, places), axis=0)
        sigma = phasor_sigma(site, usual_lockin(site).window)
        loud = least > SURELY * np.sqrt(DETECTION_CHI_SQUARE) * sigma
        names = {name for (name, _), one in zip(site.channels, loud, strict=True) if one}
        due = np.array([name in names for name in found.beacons])
    share = _share(found)
    kept = np.flatnonzero(due | (share >= HARDLY))
    if not len(kept):
        return replace(found, passed_by=True)
    return replace(
        found,
        beacons=tuple(found.beacons[k] for k in kept.tolist()),
        snr=found.snr[:, kept],
        amplitude=found.amplitude[:, kept],
        loud=found.loud[:, kept],
        passed_by=True,
    )


def _share(found: Heard) -> Array:
    """Return the share of its epochs in which each beacon is detected, shape (beacons,)."""
    told = np.maximum(np.sum(np.isfinite(found.snr), axis=0), 1)
    return np.asarray(np.sum(found.loud, axis=0) / told)


def unheard(found: Heard, site: Site) -> Iterator[Finding]:
    """Yield the beacons that are silent, always or for a while, and epochs without any beacon."""
    if len(found.time) == 0:
        return
    share = _share(found)
    if np.all(share < HARDLY):
        best = float(np.nanmax(np.nanmedian(np.where(np.isnan(found.snr), 0.0, found.snr), axis=0)))
        yield Finding(
            "low_signal",
            f"no beacon is detected: the strongest is {best:.2g} times its noise. All are switched"
            " off, far away or on other frequencies, or the noise is large.",
            Verdict.FAILED,
            1e3,
        )
        return
    told = np.isfinite(found.snr).any(axis=1)
    alone = float(np.mean(~found.loud[told].any(axis=1)))
    if alone > UNHEARD and not found.across:
        yield Finding(
            "low_signal",
            f"no beacon is detected in {100.0 * alone:.0f} % of the epochs: all are far away there,"
            " or the noise is large.",
            Verdict.DOUBTFUL,
            100.0,
        )
    frequency = {b.name: b.tone_frequencies_hz for b in site.beacons}
    for k, name in enumerate(found.beacons):
        tones = " and ".join(f"{f:g} Hz" for f in frequency[name])
        if share[k] < HARDLY:
            yield Finding(
                "silent_beacon",
                f"beacon {name} is never detected at {tones}: it is switched off, out of range, or"
                " on another frequency. Switch it on, or remove it from site.yaml.",
                weight=400.0,
            )
        elif not found.across:
            yield from _silences(found, k, tones)


def _silences(found: Heard, k: int, tones: str) -> Iterator[Finding]:
    there = np.isfinite(found.snr[:, k])
    time, loud, amplitude = found.time[there], found.loud[there, k], found.amplitude[there, k]
    if len(time) < 2:
        return
    step = float(np.median(np.diff(time)))
    quiet = runs(~loud)
    long = (quiet.last - quiet.first) * step > SILENCE
    off: list[tuple[float, float]] = []
    drowned: list[tuple[float, float]] = []
    for first, last in zip(quiet.first[long], quiet.last[long], strict=True):
        beside = np.concatenate(
            [amplitude[max(first - 10, 0) : first], amplitude[last : last + 10]]
        )
        gone = not found.passed_by
        gone &= float(np.median(amplitude[first:last])) < FALLEN * float(np.median(beside))
        stretch = (float(time[first] - 0.5 * step), float(time[last - 1] + 0.5 * step))
        (off if gone else drowned).append(stretch)
    name = found.beacons[k]
    if off:
        yield Finding(
            "silent_beacon",
            f"beacon {name} ({tones}) is silent from {_places(off)}: it was switched off.",
            Verdict.DOUBTFUL,
            50.0 + sum(end - begin for begin, end in off),
        )
    if drowned:
        yield Finding(
            "low_signal",
            f"beacon {name} ({tones}) is below the noise from {_places(drowned)}: it is far away"
            " there, or motion and other fields dominate.",
            Verdict.TRUSTWORTHY,
        )


def _places(stretches: list[tuple[float, float]]) -> str:
    more = f" and {len(stretches) - LISTED} more" if len(stretches) > LISTED else ""
    return ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in stretches[:LISTED]) + more
