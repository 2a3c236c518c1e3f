"""Undeclared lines in the spectrum of the field: mains, interference, other beacons.

The samples are first rotated to gyro-stabilized axes, so that the Earth field and the tones stay
narrow while the body rotates.  A line disturbs a tone by the lock-in's leakage: a share of its
amplitude of ``1 / (pi |df| window)``, and all of it where it is nearer.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from magfusion.errors import InputError
from magfusion.estimation.data_checks.turning import field_body
from magfusion.model.bandpass import is_bandpass
from magfusion.model.quaternion import rotate
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.strapdown import turn_at, turn_from_gyro
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.design import separable
from magfusion.receiver.receivers import usual_lockin
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array

SEGMENT, SHORTEST, SHARE = 8.0, 2.0, 0.35  # s, s, of the log
LEAST_SEGMENTS = 3
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
OWN_LINE_RATIO = 3.0  # a line near a tone and this many times as strong is the beacon itself
ALIASED = 3  # harmonics of the mains whose aliases are searched
CONSEQUENCE = 3.0  # times the model's error of a tone, from which a leak casts doubt
FITTED_CONSEQUENCE = 25.0  # the same of mains, which the noise near the tones accounts for
LEAST_MODEL_ERROR = 2e-3
LISTED = 4
BEGINNING = 60.0  # s; in which the lines to fit with the tones are searched
MOST_FITTED = 6  # number of fitted lines
LONGER = 2.0  # times the usual window, to separate a line from a tone
SEPARATED = 1.5  # over the window, the least distance of a fitted line from a tone


class Spectrum(NamedTuple):
    """Mean power spectrum of a field.

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
    power : ndarray, shape (n,)
        Squared amplitude of a line in the middle of the bin, over all axes (T^2).
    """

    frequency_hz: Array
    power: Array
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

    None if it is too short, or has the bands of tones alone.
    """
    wave = log.waveform
    if wave is None or len(wave) < 2:
        return None
    step = float(np.median(np.diff(wave.time)))
    if site is not None and is_bandpass(site, 1.0 / step):
        return None
    duration = float(wave.time[-1] - wave.time[0])
    length = int(np.clip(SHARE * duration, SHORTEST, SEGMENT) / step)
    count = int(duration / step) + 1
    if 2 * count // length - 1 < LEAST_SEGMENTS:
        return None
    field = still_field(log, site)
    if np.max(np.abs(np.diff(wave.time) - step)) > 1e-3 * step:
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


def _tones(site: Site) -> list[tuple[str, float]]:
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
    tones = [] if site is None else [f for _, f in _tones(site)]
    return tuple(line for line in lines(lines_found) if not is_sideband(lines_found, line, tones))


def undeclared(lines_found: Spectrum, site: Site) -> tuple[SpectralLine, ...]:
    """Return the lines that are neither a declared tone nor one of its motion sidebands."""
    tones = [f for _, f in _tones(site)]
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


def leaked(line: SpectralLine, tone_hz: float, window: float) -> float:
    """Return the leakage of a line into the lock-in of a tone (T)."""
    turns = np.pi * abs(line.frequency_hz - tone_hz) * window
    return float(line.amplitude / max(turns, 1.0))


def with_disturbing_lines(
    log: Log, site: Site, lockin: LockinSettings | None
) -> LockinSettings | None:
    """Return settings by which the lines that would disturb the tones are fitted with them.

    By the beginning of the log; unchanged where nothing disturbs, or the tones are in slots.

    Parameters
    ----------
    lockin : LockinSettings, optional
        As requested: its window is kept.  A window that is chosen by the tones depends on the
        lines, too.
    """
    wave = log.waveform
    if wave is None or len(wave) < 2 or has_schedule(site) or not site.beacons:
        return lockin
    result = spectrum(_until(log, wave, float(wave.time[0]) + BEGINNING), site)
    if result is None:
        return lockin
    try:
        settings = lockin or usual_lockin(site)
    except InputError:
        return lockin
    _, tones = map(np.array, zip(*_tones(site), strict=True))
    chosen: tuple[float, ...] = ()
    for line in undeclared(result, site):
        if len(chosen) == MOST_FITTED:
            break
        if _consequence(result, line, site, settings)[0] <= CONSEQUENCE:
            continue
        others = np.array([*tones, *chosen])
        requested = lockin is not None
        trial = _fitting(line.frequency_hz, others, site, settings, chosen, requested=requested)
        if trial is not None and separable(1.0 / result.rate_hz, trial, tones):
            settings, chosen = trial, trial.lines_hz
    return settings if chosen else lockin


def _until(log: Log, wave: Waveform, end: float) -> Log:
    """Return the waveform and the inertial samples of a log up to a time."""
    first = log.imu.time < end
    imu = ImuSamples(log.imu.time[first], log.imu.gyro_body[first], log.imu.accel_body[first])
    return replace(log, waveform=wave.rows(wave.time < end), imu=imu)


def _fitting(
    line_hz: float,
    others_hz: Array,
    site: Site,
    settings: LockinSettings,
    chosen: tuple[float, ...],
    *,
    requested: bool,
) -> LockinSettings | None:
    """Return settings that fit one more line, if a window can be long enough to separate it.

    Parameters
    ----------
    others_hz : ndarray
        Tones, and lines that are already fitted.
    requested : bool
        Whether the window was requested, and is kept.
    """
    separate = float(np.min(np.abs(line_hz - others_hz)))
    needed = (SEPARATED if requested else 2.0) / separate
    if needed > (settings.window if requested else LONGER * usual_lockin(site).window):
        return None
    longer = max(settings.window, needed)
    step = settings.step if requested else longer / 2.0
    return replace(settings, window=longer, step=step, lines_hz=(*chosen, line_hz))


def undeclared_lines(
    log: Log, site: Site | None, lockin: LockinSettings | None = None
) -> Iterator[Finding]:
    """Yield the lines that the site does not declare, with their effect on its tones."""
    if site is None or has_schedule(site) or len(site.beacons) == 0:
        return
    result = spectrum(log, site)
    if result is None:
        return
    try:
        settings = with_disturbing_lines(log, site, lockin) or usual_lockin(site)
    except InputError:
        return
    yield from judged_lines(result, site, settings)


def judged_lines(lines_found: Spectrum, site: Site, settings: LockinSettings) -> Iterator[Finding]:
    """Yield the effect of a spectrum's undeclared lines on the tones of a site."""
    doubtful: list[tuple[float, SpectralLine, str]] = []
    seen: list[tuple[float, SpectralLine, str]] = []
    fitted: list[str] = []
    for line in undeclared(lines_found, site):
        if any(abs(line.frequency_hz - one) < APART_HZ for one in settings.lines_hz):
            fitted.append(_named(line, site, lines_found, settings))
            continue
        worst, words = _consequence(lines_found, line, site, settings)
        limit = (
            FITTED_CONSEQUENCE if mains_of(line.frequency_hz, lines_found.rate_hz) else CONSEQUENCE
        )
        (doubtful if worst > limit else seen).append((worst, line, words))
    if fitted:
        yield Finding(
            "fitted_line",
            f"magnetometer: undeclared lines: {'; '.join(fitted)}. They are fitted with the tones"
            f" in a window of {settings.window:.3g} s. Declare the transmitters, or switch them"
            " off.",
            Verdict.TRUSTWORTHY,
        )
    for group, verdict in ((doubtful, Verdict.DOUBTFUL), (seen, Verdict.TRUSTWORTHY)):
        if not group:
            continue
        named = [_named(line, site, lines_found, settings) for _, line, _ in group]
        more = f" and {len(named) - LISTED} more" if len(named) > LISTED else ""
        only_mains = all(mains_of(line.frequency_hz, lines_found.rate_hz) for _, line, _ in group)
        worst, _, maximum = max(group, key=lambda one: one[0])
        yield Finding(
            "mains" if only_mains else "undeclared_line",
            f"magnetometer: undeclared lines: {'; '.join(named[:LISTED])}{more}. {maximum}",
            verdict,
            (200.0 if verdict is Verdict.DOUBTFUL else 0.0) + min(worst, 500.0),
        )


def _consequence(
    lines_found: Spectrum, line: SpectralLine, site: Site, settings: LockinSettings
) -> tuple[float, str]:
    """Return a line's leakage in units of the model's error, and its description."""
    error = max(site.model_error, LEAST_MODEL_ERROR)
    mains = settings.mains_hz
    order = max(round(line.frequency_hz / mains), 1) if mains > 0.0 else 1
    # A fitted line leaks only in proportion to its frequency error.
    off = abs(line.frequency_hz - order * mains) * settings.window if mains > 0.0 else np.inf
    fitted = min(1.0, float(np.pi * off)) if off < 1.0 else 1.0
    worst, where, share = 0.0, "", 0.0
    for name, tone in _tones(site):
        tone_amplitude = max(lines_found.amplitude(tone), 1e-30)
        leak = fitted * leaked(line, tone, settings.window) / tone_amplitude
        if leak / error > worst:
            worst, where, share = leak / error, f"beacon {name} ({tone:g} Hz)", leak
    if not where:
        return 0.0, ""
    if worst > CONSEQUENCE:
        return worst, (
            f"With a window of {settings.window:.3g} s they change the field of {where} by up to"
            f" {100.0 * share:.2g} %. Declare the transmitters, switch them off, or use a longer"
            " --window."
        )
    return worst, f"They change {where} by {100.0 * share:.2g} % at most."


def _named(line: SpectralLine, site: Site, lines_found: Spectrum, settings: LockinSettings) -> str:
    """Return the description of a line: frequency, amplitude, and probable origin."""
    size = f"{line.frequency_hz:.2f} Hz ({1e9 * line.amplitude:.3g} nT)"
    strongest = max((lines_found.amplitude(f) for _, f in _tones(site)), default=0.0)
    mains = mains_of(line.frequency_hz, lines_found.rate_hz)
    for name, tone in _tones(site):
        near = abs(line.frequency_hz - tone) * settings.window < 2.0 and not mains
        if near and line.amplitude > OWN_LINE_RATIO * lines_found.amplitude(tone):
            return f"{size}, probably beacon {name} itself, whose declared frequency_hz is {tone:g}"
        if near:
            return f"{size}, a neighbour of beacon {name} ({tone:g} Hz)"
        harmonic = None if mains else _order_of(line, tone, lines_found)
        if harmonic is not None:
            return f"{size}, {harmonic} times the tone of beacon {name}: its drive is distorted"
    if mains is not None:
        base, order = mains
        which = f"mains of {base:g} Hz" if order == 1 else f"{order} times mains of {base:g} Hz"
        other = "" if base == settings.mains_hz else f", give --mains-hz {base:g}"
        return f"{size}, {which}{other}"
    if line.amplitude > 0.1 * strongest:
        return f"{size}, as strong as a beacon"
    return size


def _order_of(line: SpectralLine, tone: float, lines_found: Spectrum) -> int | None:
    """Return the harmonic order of a weaker line with respect to a tone; None if it has none."""
    if line.amplitude >= 0.3 * lines_found.amplitude(tone):
        return None
    for order in range(2, HARMONICS + 1):
        at = aliased(order * tone, lines_found.rate_hz)
        if abs(line.frequency_hz - at) < MIN_SEPARATION * lines_found.resolution_hz:
            return order
    return None
