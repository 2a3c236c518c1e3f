"""Settings of a lock-in: window and step that separate the tones."""

from dataclasses import dataclass

import numpy as np

from magfusion.errors import InputError
from magfusion.model.detection_range import mutually_undetectable, phasor_sigma, tones_of
from magfusion.model.site import Beacon, Site
from magfusion.units import Array

MAX_WINDOW = 4.0  # s; motion within a longer one is no longer a ramp
EVEN = 1e-6  # steps; less is rounding of stamps
CLOSEST_TONES_HZ = 2.0 / MAX_WINDOW
AGAIN_WINDOW = 1.0  # s; in which beacons sharing a frequency must not be received together


@dataclass(frozen=True)
class LockinSettings:
    """Settings of a lock-in."""

    # window, step: length of a window and distance between two (s)
    window: float
    step: float
    # mains frequency; 0 for none. Harmonics below the Nyquist frequency are fitted too
    mains_hz: float = 50.0
    noise_windows: int = 9  # windows over which the noise near the tones is averaged
    lines_hz: tuple[float, ...] = ()  # additional lines that are fitted as tones are
    # centre of one window (s), which need not be in the log; None begins with the first sample. It
    # aligns the windows of several streams
    origin: float | None = None

    def first_centre(self, begin: float) -> float:
        """Return the centre of the first window of samples that begin at a time (s)."""
        centre = begin + self.window / 2.0
        if self.origin is None:
            return centre
        return self.origin + self.step * float(np.ceil((centre - self.origin) / self.step - EVEN))


def default_settings(site: Site, mains_hz: float = 50.0) -> LockinSettings:
    """Choose window and step from the spacing of the tones.

    Two periods of the closest pair (of tones, of a tone and the mains, of a tone and zero) separate
    them even with a ramp in each; windows overlap by half. Raises InputError where two beacons
    share a frequency, or a beacon is driven in time slots.
    """
    frequencies = sent_frequencies_hz(site)
    lines = np.sort(np.concatenate([[0.0], frequencies]))
    gaps = np.diff(lines)
    spacing = float(np.min(gaps))
    if mains_hz > 0:
        order = np.maximum(np.round(frequencies / mains_hz), 1.0)
        to_mains = np.abs(frequencies - order * mains_hz)
        spacing = min(spacing, float(np.min(to_mains[to_mains > 0.5], initial=np.inf)))
    window = float(np.clip(2.0 / spacing, 0.02, MAX_WINDOW))
    return LockinSettings(window=window, step=window / 2.0, mains_hz=mains_hz)


def sent_frequencies_hz(site: Site) -> Array:
    """Return the transmitted frequencies (Hz), rejecting tones that cannot be separated.

    A frequency shared by beacons that are never received together is listed once.
    """
    for beacon in site.beacons:
        if any(slot is not None for _, slot in beacon.tones):
            remedy = "" if beacon.slots else "declare its slots: {duration_s, count}, or "
            raise InputError(
                f"beacon {beacon.name} is driven in time slots, which the lock-in cannot separate; "
                f"{remedy}give its demodulated fields.parquet instead of the waveform"
            )
    frequencies = np.concatenate([b.tone_frequencies_hz for b in site.beacons])
    order = np.argsort(frequencies, kind="stable")
    close = np.flatnonzero(np.diff(frequencies[order]) < CLOSEST_TONES_HZ)
    again = len(close) > 0 and _used_again(site)
    for k in close:
        i, j = order[k], order[k + 1]
        if frequencies[i] == frequencies[j] and again:
            continue
        a, b = site.channels[i][0], site.channels[j][0]
        raise InputError(
            f"beacons {a} and {b} both transmit at {frequencies[i]:g} Hz; "
            f"tones must differ by at least {CLOSEST_TONES_HZ:g} Hz to be separated"
        )
    return tones_of(site).frequencies_hz


def _used_again(site: Site) -> bool:
    """Return whether no two beacons on one frequency are in range of each other."""
    sigma = phasor_sigma(site, AGAIN_WINDOW)
    on_tone: dict[float, list[Beacon]] = {}
    for beacon in site.beacons:
        for frequency in beacon.tone_frequencies_hz.tolist():
            others = on_tone.setdefault(frequency, [])
            if not all(mutually_undetectable(beacon, other, sigma) for other in others):
                return False
            others.append(beacon)
    return True
