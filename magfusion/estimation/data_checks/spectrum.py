"""Lines in the spectrum of the field: tones, mains, interference, other beacons.

The samples are first rotated to gyro-stabilized axes, so that the Earth field and the tones stay
narrow while the body rotates.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from magfusion.estimation.data_checks.field_rotation import field_body
from magfusion.estimation.data_checks.resolution import is_scheduled
from magfusion.model.bandpass import is_bandpass
from magfusion.model.quaternion import rotate
from magfusion.model.samples import Log
from magfusion.model.site import Site
from magfusion.model.strapdown import turn_at, turn_from_gyro
from magfusion.units import Array

SEGMENT, MIN_SEGMENT, SHARE = 8.0, 2.0, 0.35  # s, s, of the log
MIN_SEGMENTS = 3
LOWEST_HZ = 3.0  # Hz; below, the spectrum is that of motion
STAND_OUT = 30.0  # a line has this many times the neighbouring power
NEIGHBOUR_BAND_HZ = 2.5  # on either side, where that power is measured
WIDTH_HZ = 0.3  # of a line that motion modulates, on either side
APART_HZ = 0.5  # of two lines
MIN_SEPARATION = 3.0  # resolutions from a tone at which a line is separable from it
SIDEBAND_HZ = 4.0  # half width of a tone's motion sidebands
MIRRORED = 0.1  # least power of the mirrored sideband, or of another tone's, as a share
MAINS_HZ = (50.0, 60.0)
MAINS_OFF = 0.008  # relative; a line farther off is not mains
HARMONICS = 6
ALIASED = 3  # harmonics of the mains whose aliases are searched


class Spectrum(NamedTuple):
    """Mean power spectrum of a field."""

    frequency_hz: Array  # (n,)
    power: Array  # (n,), squared amplitude of a line in the middle of the bin, over all axes (T^2)
    rate_hz: float

    @property
    def resolution_hz(self) -> float:
        """Spacing of the bins."""
        return float(self.frequency_hz[1])

    def amplitude(self, frequency_hz: float) -> float:
        """Return the amplitude near a frequency, including its modulation (T)."""
        near = np.abs(self.frequency_hz - frequency_hz) <= WIDTH_HZ
        # The bins of a Hann window sum to one and a half times the power of a line.
        return float(np.sqrt(np.sum(self.power[near]) / 1.5))

    def peak(self, frequency_hz: float) -> float:
        """Return the largest power close to a frequency (T^2)."""
        near = np.abs(self.frequency_hz - frequency_hz) <= 1.5 * self.resolution_hz
        return float(np.max(self.power[near], initial=1e-300))


class SpectralLine(NamedTuple):
    """One line of a spectrum (Hz, T)."""

    frequency_hz: float
    amplitude: float


def still_field(log: Log, site: Site | None) -> Array:
    """Return the field of a waveform in gyro-stabilized axes, shape (n, 3) (T).

    In body axes without a site, where the mounting is unknown, and with fewer than three axes,
    where the field cannot be rotated.
    """
    field = field_body(log, site)
    if log.vectors is None or site is None or len(log.imu) < 2:
        return field
    imu, offset = log.imu, site.platform.imu.time_offset
    turns = turn_from_gyro(imu.time, imu.gyro_body)
    at = turn_at(turns, imu.time, imu.gyro_body, log.vectors.time - offset)
    return np.ascontiguousarray(rotate(at, field.T).T)


def spectrum(log: Log, site: Site | None) -> Spectrum | None:
    """Return the mean spectrum of a waveform in gyro-stabilized axes.

    None if it is too short, has the bands of tones alone, or pauses regularly: that makes lines.
    """
    wave = log.waveform
    if wave is None or len(wave) < 2:
        return None
    step = float(np.median(np.diff(wave.time)))
    if site is not None and is_bandpass(site, 1.0 / step):
        return None
    duration = float(wave.time[-1] - wave.time[0])
    length = int(np.clip(SHARE * duration, MIN_SEGMENT, SEGMENT) / step)
    count = int(duration / step) + 1
    if 2 * count // length - 1 < MIN_SEGMENTS:
        return None
    field = still_field(log, site)
    if np.max(np.abs(np.diff(wave.time) - step)) > 1e-3 * step:
        row = np.rint((wave.time - wave.time[0]) / step).astype(np.int64)
        gap = np.flatnonzero(np.diff(row) > 1)
        if is_scheduled(row[gap], row[gap + 1]):
            return None
        even = wave.time[0] + step * np.arange(count)
        field = np.stack([np.interp(even, wave.time, c) for c in field.T], axis=1)
    window = np.hanning(length + 1)[:-1, None]
    first = np.arange(0, len(field) - length + 1, length // 2)
    power = np.zeros(length // 2 + 1)
    for k in first:
        piece = field[k : k + length]
        result = np.fft.rfft((piece - np.mean(piece, axis=0)) * window, axis=0)
        power += np.sum(np.abs(result) ** 2, axis=1)
    scale = (2.0 / float(np.sum(window))) ** 2 / max(len(first), 1)
    frequency = np.asarray(np.fft.rfftfreq(length, step), dtype=np.float64)
    return Spectrum(frequency, scale * power, 1.0 / step)


def lines(lines_found: Spectrum) -> tuple[SpectralLine, ...]:
    """Return the lines of a spectrum, strongest first."""
    power, resolution = lines_found.power, lines_found.resolution_hz
    reach = 2 * int(NEIGHBOUR_BAND_HZ / resolution) + 1
    others = median_filter(power, reach, mode="nearest")
    inner = np.arange(1, len(power) - 1)
    top = (power[inner] >= power[inner - 1]) & (power[inner] > power[inner + 1])
    peaks = inner[top & (power[inner] > STAND_OUT * others[inner])]
    peaks = peaks[lines_found.frequency_hz[peaks] > LOWEST_HZ]
    out: list[SpectralLine] = []
    for k in peaks[np.argsort(-power[peaks])]:
        before, here, after = np.log(np.maximum(power[k - 1 : k + 2], 1e-300))
        finer = 0.5 * (before - after) / min(before - 2.0 * here + after, -1e-9)
        frequency = float((k + finer) * resolution)
        if all(abs(frequency - one.frequency_hz) > APART_HZ for one in out):
            out.append(SpectralLine(frequency, lines_found.amplitude(frequency)))
    return tuple(out)


def named_tones(site: Site) -> list[tuple[str, float]]:
    """Return beacon and frequency (Hz) of each tone."""
    return [(b.name, float(f)) for b in site.beacons for f in b.tone_frequencies_hz]


def aliased(frequency_hz: float, rate_hz: float) -> float:
    """Return the alias of a frequency at a sampling rate (Hz)."""
    return abs(frequency_hz - rate_hz * round(frequency_hz / rate_hz))


def mains_of(frequency_hz: float, rate_hz: float) -> tuple[float, int] | None:
    """Return the mains frequency (Hz) and harmonic of a line; None if it is neither."""
    for mains in MAINS_HZ:
        for order in range(1, HARMONICS + 1):
            folded = aliased(order * mains, rate_hz)
            if order > ALIASED and folded != order * mains:
                continue
            if abs(frequency_hz - folded) < MAINS_OFF * min(order, 2) * mains:
                return mains, order
    return None


def named_lines(lines_found: Spectrum, site: Site | None) -> tuple[SpectralLine, ...]:
    """Return tones and undeclared lines, without the motion sidebands of a site's tones."""
    tones = [] if site is None else [f for _, f in named_tones(site)]
    return tuple(line for line in lines(lines_found) if not is_sideband(lines_found, line, tones))


def undeclared(lines_found: Spectrum, site: Site) -> tuple[SpectralLine, ...]:
    """Return the lines that are neither a declared tone nor one of its motion sidebands."""
    tones = [f for _, f in named_tones(site)]
    out = []
    for line in lines(lines_found):
        separate = [abs(line.frequency_hz - f) for f in tones]
        if min(separate, default=np.inf) < MIN_SEPARATION * lines_found.resolution_hz:
            continue
        if not is_sideband(lines_found, line, tones):
            out.append(line)
    return tuple(out)


def is_sideband(lines_found: Spectrum, line: SpectralLine, tones: list[float]) -> bool:
    """Return whether a line is a motion sideband of a tone: its mirror exists, too."""
    own = lines_found.peak(line.frequency_hz)
    for tone in tones:
        off = line.frequency_hz - tone
        if abs(off) < SIDEBAND_HZ and lines_found.peak(tone) > own:
            share = own / lines_found.peak(tone)
            mirrors = [(tone, -off), *((f, d) for f in tones if f != tone for d in (off, -off))]
            if any(
                lines_found.peak(f + d) > MIRRORED * share * lines_found.peak(f) for f, d in mirrors
            ):
                return True
    return False
