"""Lines in the spectrum of the field that disturb the tones: fitted with them, or reported.

A line disturbs a tone by the lock-in's leakage: a share of its amplitude of
``1 / (pi |df| window)``, and all of it where it is nearer.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.estimation.data_checks.spectrum import (
    APART_HZ,
    HARMONICS,
    MIN_SEPARATION,
    SpectralLine,
    Spectrum,
    aliased,
    mains_of,
    named_tones,
    spectrum,
    undeclared,
)
from magfusion.model.samples import ImuSamples, Log, Waveform
from magfusion.model.site import Site
from magfusion.model.trust import Finding, Verdict
from magfusion.receiver.design import separable
from magfusion.receiver.receivers import usual_lockin
from magfusion.receiver.slots import has_schedule
from magfusion.receiver.windows import LockinSettings
from magfusion.units import Array

OWN_LINE_RATIO = 3.0  # a line near a tone and this many times as strong is the beacon itself
CONSEQUENCE = 3.0  # times the model's error of a tone, from which a leak casts doubt
FITTED_CONSEQUENCE = 25.0  # the same of mains, which the noise near the tones accounts for
MIN_MODEL_ERROR = 2e-3
LISTED = 4
BEGINNING = 60.0  # s; in which the lines to fit with the tones are searched
MAX_FITTED = 6  # number of fitted lines
LONGER = 2.0  # times the usual window, to separate a line from a tone
SEPARATED = 1.5  # over the window, the least distance of a fitted line from a tone


def leaked(line: SpectralLine, tone_hz: float, window: float) -> float:
    """Return the leakage of a line into the lock-in of a tone (T)."""
    turns = np.pi * abs(line.frequency_hz - tone_hz) * window
    return float(line.amplitude / max(turns, 1.0))


def with_disturbing_lines(
    log: Log, site: Site, lockin: LockinSettings | None
) -> LockinSettings | None:
    """Return settings by which the lines that would disturb the tones are fitted with them.

    By the beginning of the log; unchanged where nothing disturbs, or the tones are in slots.
    `lockin`: as requested: its window is kept. A window that is chosen by the tones depends on the
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
    _, tones = map(np.array, zip(*named_tones(site), strict=True))
    chosen: tuple[float, ...] = ()
    for line in undeclared(result, site):
        if len(chosen) == MAX_FITTED:
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

    `others_hz`: tones, and lines that are already fitted. `requested`: whether the window was
    requested, and is kept.
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
    error = max(site.model_error, MIN_MODEL_ERROR)
    mains = settings.mains_hz
    order = max(round(line.frequency_hz / mains), 1) if mains > 0.0 else 1
    # A fitted line leaks only in proportion to its frequency error.
    off = abs(line.frequency_hz - order * mains) * settings.window if mains > 0.0 else np.inf
    fitted = min(1.0, float(np.pi * off)) if off < 1.0 else 1.0
    worst, where, share = 0.0, "", 0.0
    for name, tone in named_tones(site):
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
    strongest = max((lines_found.amplitude(f) for _, f in named_tones(site)), default=0.0)
    mains = mains_of(line.frequency_hz, lines_found.rate_hz)
    for name, tone in named_tones(site):
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
