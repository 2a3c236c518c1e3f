"""How a waveform is demodulated: window and step that tell the tones apart."""

from dataclasses import dataclass

import numpy as np

from magfusion.errors import InputError
from magfusion.model.audibility import phasor_sigma, tones_of, unheard_by_each_other
from magfusion.model.site import Beacon, Site
from magfusion.units import Array

LONGEST_WINDOW = 4.0  # s; motion within a longer one is no longer a ramp
EVEN = 1e-6  # steps; less is rounding of stamps
CLOSEST_TONES_HZ = 2.0 / LONGEST_WINDOW
AGAIN_WINDOW = 1.0  # s; in which one beacon on a frequency must not be heard beside another


@dataclass(frozen=True)
class LockinSettings:
    """How a waveform is demodulated.

    Parameters
    ----------
    window, step : float
        Length of a window and distance between two (s).
    mains_hz : float
        Mains frequency; 0 for none.  Harmonics below the Nyquist frequency are fitted too.
    noise_windows : int
        Windows over which the noise beside the tones is averaged.
    lines_hz : tuple of float
        Lines that are no tones of the site; they are fitted beside these as tones are.
    origin : float, optional
        Where a window is centred, or would be (s); None begins with the first sample. By it the
        windows of several streams are at the same times.
    """

    window: float
    step: float
    mains_hz: float = 50.0
    noise_windows: int = 9
    lines_hz: tuple[float, ...] = ()
    origin: float | None = None

    def first_centre(self, begin: float) -> float:
        """Return the centre of the first window of samples that begin at a time (s)."""
        centre = begin + self.window / 2.0
        if self.origin is None:
            return centre
        return self.origin + self.step * float(np.ceil((centre - self.origin) / self.step - EVEN))


def default_settings(site: Site, mains_hz: float = 50.0) -> LockinSettings:
    """Choose window and step from the spacing of the tones.

    Two periods of the closest pair (of tones, of a tone and the mains, of a tone and zero)
    separate them even with a ramp in each; windows follow each other by half their length.

    Raises
    ------
    InputError
        Where two beacons share a frequency, or a beacon is driven in time slots.
    """
    frequencies = sent_frequencies_hz(site)
    lines = np.sort(np.concatenate([[0.0], frequencies]))
    gaps = np.diff(lines)
    spacing = float(np.min(gaps))
    if mains_hz > 0:
        order = np.maximum(np.round(frequencies / mains_hz), 1.0)
        to_mains = np.abs(frequencies - order * mains_hz)
        spacing = min(spacing, float(np.min(to_mains[to_mains > 0.5], initial=np.inf)))
    window = float(np.clip(2.0 / spacing, 0.02, LONGEST_WINDOW))
    return LockinSettings(window=window, step=window / 2.0, mains_hz=mains_hz)


def sent_frequencies_hz(site: Site) -> Array:
    """Return the frequencies that are sent (Hz), refusing tones that cannot be separated.

    One that beacons use again which do not hear each other stands once.
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
    """Return whether no two beacons on one frequency hear each other."""
    sigma = phasor_sigma(site, AGAIN_WINDOW)
    on_tone: dict[float, list[Beacon]] = {}
    for beacon in site.beacons:
        for frequency in beacon.tone_frequencies_hz.tolist():
            others = on_tone.setdefault(frequency, [])
            if not all(unheard_by_each_other(beacon, other, sigma) for other in others):
                return False
            others.append(beacon)
    return True
