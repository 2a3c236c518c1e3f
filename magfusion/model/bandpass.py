"""Bandpass sampling: a recording reduced to narrow bands about its tones, at their frequencies.

A receiver of alternating fields needs nothing but these bands.  A symmetric FIR filter passes them
at once, and its output is sampled so slowly that they alias, each clear of the others.  The samples
are of the true waveform at their times, so that a lock-in at these times sees each tone at its own
frequency.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from magfusion.model.detection_range import tones_of
from magfusion.model.site import Site
from magfusion.units import Array, ComplexArray

# Noise is measured two resolutions of a window beside a tone, 25 Hz in the shortest default one
# (0.08 s, between harmonics of the mains); motion modulates a tone by less.
PASS_HZ = 30.0
WIDEST_HZ = 60.0  # of a transition: the delay is 42 ms
NARROWEST_HZ = 20.0  # of a transition: the delay is 0.13 s
STOP_DB = 80.0
WIDE = 3.0  # samples of a first stage in a period of the highest frequency
MIN_SPACING_HZ = 2.0 * PASS_HZ + NARROWEST_HZ


@dataclass(frozen=True, eq=False)
class BandFilter:
    """Filter of the bands of a site's tones at a sampling rate."""

    tones_hz: Array  # (tones,)
    rate_hz: float  # of the recording
    decimation: int  # samples of the recording for each that is kept
    # (length, tones), of the analytic signal in the middle of its samples, which are those of the
    # first stage
    taps: ComplexArray
    first_step: int  # samples of the recording for each of a first stage, which passes all bands
    first_taps: Array  # (length,)

    @property
    def middle(self) -> int:
        """Samples before the first result: the delay."""
        return len(self.first_taps) // 2 + self.first_step * (len(self.taps) // 2)

    @staticmethod
    def of_site(site: Site, rate_hz: float) -> "BandFilter | None":
        """Return the filter with the fewest samples.

        None if bands overlap, no samples are saved, or the receiver needs its static field.
        """
        if not site.beacons or not site.platform.magnetometer.ac_coupled:
            return None
        tones_hz = np.sort(tones_of(site).frequencies_hz)
        spacing = float(np.min(np.diff(tones_hz), initial=np.inf))
        if min(spacing, tones_hz[0]) < MIN_SPACING_HZ:
            return None
        transition = min(spacing - 2.0 * PASS_HZ, WIDEST_HZ)
        between = 2.0 * PASS_HZ + transition  # of two bands that do not fold onto each other
        decimation = _decimation(tones_hz, rate_hz, between)
        if decimation < 2 or tones_hz[-1] + 0.5 * between > 0.5 * rate_hz:
            return None
        highest = tones_hz[-1] + 0.5 * between
        step = _first_step(decimation, rate_hz / highest)
        first = np.ones(1) if step == 1 else _lowpass(highest, rate_hz / step - highest, rate_hz)
        own_hz = rate_hz / step
        lowpass = _lowpass(PASS_HZ, PASS_HZ + transition, own_hz)
        elapsed = (np.arange(len(lowpass)) - len(lowpass) // 2) / own_hz
        carrier = np.exp(-2j * np.pi * elapsed[:, None] * tones_hz)
        elapsed_first = (np.arange(len(first)) - len(first) // 2) / rate_hz
        passed = np.cos(2.0 * np.pi * elapsed_first[:, None] * tones_hz).T @ first
        taps = 2.0 * lowpass[:, None] * carrier / passed
        return BandFilter(tones_hz, rate_hz, decimation, taps, step, first)


def _lowpass(pass_hz: float, stop_hz: float, rate_hz: float) -> Array:
    from scipy.signal import firwin, kaiserord  # takes as long as all else to import

    length, beta = kaiserord(STOP_DB, (stop_hz - pass_hz) / (0.5 * rate_hz))
    cutoff = 0.5 * (pass_hz + stop_hz)
    return np.asarray(firwin(length | 1, cutoff, window=("kaiser", beta), fs=rate_hz))


def _first_step(decimation: int, oversampling: float) -> int:
    """Return the decimation of a first stage: a divisor that leaves a wide transition."""
    divisors = [k for k in range(1, decimation + 1) if decimation % k == 0]
    return max(k for k in divisors if k == 1 or k <= oversampling / WIDE)


def _decimation(tones_hz: Array, rate_hz: float, between_hz: float) -> int:
    """Return the largest decimation that keeps the bands this far apart; 1 for none."""
    least_hz = 2.0 * len(tones_hz) * between_hz
    for decimation in range(int(rate_hz / least_hz), 1, -1):
        rate = rate_hz / decimation
        alias = np.sort(np.abs(tones_hz - rate * np.round(tones_hz / rate)))
        edges = 2.0 * np.array([alias[0], 0.5 * rate - alias[-1]])
        if min(np.min(edges), np.min(np.diff(alias), initial=np.inf)) >= between_hz:
            return decimation
    return 1


class BandSampler:
    """Reduces a recording, block by block."""

    def __init__(self, band: BandFilter) -> None:
        self._band = band
        self._first = _Windows(band.first_taps[:, None], band.first_step)
        taps = np.concatenate([band.taps.real, band.taps.imag], axis=1)
        self._second = _Windows(taps, band.decimation // band.first_step)
        self._next = band.middle

    def push(self, block: Array) -> tuple[Array, ComplexArray]:
        """Return places and analytic signals of the samples that a block completes.

        `block` (n, columns): the next samples. Returns (m,): number of the recording's sample at
        which each is; (m, tones, columns): its real part is the waveform of each tone's band.
        """
        if self._band.first_step > 1:
            block = self._first.push(block)[..., 0]
        parts = self._second.push(block)
        place = self._next + self._band.decimation * np.arange(len(parts), dtype=float)
        self._next += self._band.decimation * len(parts)
        tones = len(self._band.tones_hz)
        return place, np.swapaxes(parts[..., :tones] + 1j * parts[..., tones:], 1, 2)


class _Windows:
    """Applies filters to every so many samples, block by block."""

    def __init__(self, taps: Array, step: int) -> None:
        self._taps, self._step, self._samples = taps, step, np.zeros((0, 0))

    def push(self, block: Array) -> Array:
        """Return results of a block (n, columns), shape (m, columns, filters)."""
        samples = np.concatenate([self._samples, block]) if len(self._samples) else block
        length = len(self._taps)
        count = max((len(samples) - length) // self._step + 1, 0)
        self._samples = samples[self._step * count :]
        if not count:
            return np.zeros((0, block.shape[1], self._taps.shape[1]))
        windows = sliding_window_view(samples, length, axis=0)[:: self._step]
        return np.asarray(np.ascontiguousarray(windows) @ self._taps)


def waveform_of_bands(time: Array, baseband: ComplexArray, tones_hz: Array) -> Array:
    """Return the waveform at its times from the complex amplitudes of tones, shape (n, 3).

    `baseband` (n, tones, 3): field of each tone is the real part of it times ``exp(j 2 pi f t)``.
    """
    turn = np.exp(2j * np.pi * time[:, None] * tones_hz)
    return np.real(np.einsum("nt,nti->ni", turn, baseband))


def is_bandpass(site: Site, rate_hz: float) -> bool:
    """Return whether samples of a site's receiver are those of bands: slower than its tones."""
    if not site.platform.magnetometer.ac_coupled or not site.beacons:
        return False
    return float(np.max(site.tone_frequencies_hz)) > 0.45 * rate_hz
