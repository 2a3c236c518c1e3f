"""Which stretches of a waveform are demodulated, and how."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_opening

from magfusion.errors import InputError
from magfusion.records.samples import ImuSamples, Waveform
from magfusion.site import Site
from magfusion.units import Array, BoolArray, IntArray

LONGEST_WINDOW = 4.0  # s; motion within a longer one is no longer a ramp
CLOSEST_TONES_HZ = 2.0 / LONGEST_WINDOW
SATURATED_RUN = 3  # consecutive samples at the extreme of the range
ROUNDING = 1e-6  # of a step; what arithmetic may take from the last window


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
    """

    window: float
    step: float
    mains_hz: float = 50.0
    noise_windows: int = 9


@dataclass(frozen=True, eq=False)
class Windows:
    """Which stretches of a waveform are demodulated.

    Parameters
    ----------
    centre : ndarray, shape (n,)
        (s)
    first, count : int ndarray, shape (n,)
        Samples of each window.
    dropped : mapping
        Reason to number of windows.
    """

    centre: Array
    first: IntArray
    count: IntArray
    dropped: Mapping[str, int]


def default_settings(site: Site, mains_hz: float = 50.0) -> LockinSettings:
    """Choose window and step from the spacing of the tones.

    Two periods of the closest pair (of tones, of a tone and the mains, of a tone and zero)
    separate them even with a ramp in each; windows follow each other by half their length.

    Raises
    ------
    InputError
        Where two beacons share a frequency, or a beacon is driven in time slots.
    """
    frequencies = channel_frequencies_hz(site)
    lines = np.sort(np.concatenate([[0.0], frequencies]))
    gaps = np.diff(lines)
    spacing = float(np.min(gaps))
    if mains_hz > 0:
        order = np.maximum(np.round(frequencies / mains_hz), 1.0)
        to_mains = np.abs(frequencies - order * mains_hz)
        spacing = min(spacing, float(np.min(to_mains[to_mains > 0.5], initial=np.inf)))
    window = float(np.clip(2.0 / spacing, 0.02, LONGEST_WINDOW))
    return LockinSettings(window=window, step=window / 2.0, mains_hz=mains_hz)


def channel_frequencies_hz(site: Site) -> Array:
    """Return the frequency of each channel (Hz), refusing tones that cannot be told apart."""
    for beacon in site.beacons:
        if any(slot is not None for _, slot in beacon.tones):
            remedy = "" if beacon.slots else "declare its slots: {duration_s, count}, or "
            raise InputError(
                f"beacon {beacon.name} is driven in time slots, which the lock-in cannot separate; "
                f"{remedy}give its demodulated fields.parquet instead of the waveform"
            )
    frequencies = np.concatenate([b.tone_frequencies_hz for b in site.beacons])
    order = np.argsort(frequencies)
    close = np.flatnonzero(np.diff(frequencies[order]) < CLOSEST_TONES_HZ)
    if len(close):
        a, b = (site.channels[order[close[0] + i]][0] for i in (0, 1))
        raise InputError(
            f"beacons {a} and {b} both transmit at {frequencies[order[close[0]]]:g} Hz; "
            f"tones must differ by at least {CLOSEST_TONES_HZ:g} Hz to be told apart"
        )
    return frequencies


def sample_rate_hz(waveform: Waveform) -> float:
    """Return the usual sampling rate (Hz).

    Raises
    ------
    InputError
        Where there are less than two samples.
    """
    return 1.0 / _usual_step(waveform.time, "magnetometer")


def _usual_step(time: Array, stream: str) -> float:
    if len(time) < 2:
        raise InputError(f"{stream}: found {len(time)} samples; record at least one window")
    return float(np.median(np.diff(time)))


def choose_windows(
    waveform: Waveform, imu: ImuSamples, site: Site, settings: LockinSettings
) -> Windows:
    """Lay windows over a waveform, dropping those that a gap or saturation spoils.

    Parameters
    ----------
    waveform : Waveform
    imu : ImuSamples
    site : Site
    settings : LockinSettings

    Returns
    -------
    Windows

    Raises
    ------
    InputError
        Where the sampling rate is too low for the tones, a stream has less than two samples, or no
        window is usable.
    """
    rate, highest = sample_rate_hz(waveform), float(np.max(channel_frequencies_hz(site)))
    if highest > 0.45 * rate:
        raise InputError(
            f"magnetometer: sampled at {rate:.4g} Hz, too slow for the tone at {highest:g} Hz; "
            f"at least {highest / 0.45:.4g} Hz are needed"
        )
    time, half = waveform.time, settings.window / 2.0
    # The last sample stands for the interval up to the next one, as every sample does.
    last_start = time[-1] + 1.0 / rate - time[0] - settings.window
    number = int(np.floor(last_start / settings.step + ROUNDING)) + 1
    centre = time[0] - 0.5 / rate + half + settings.step * np.arange(max(number, 0))
    first = np.searchsorted(time, centre - half)
    last = np.searchsorted(time, centre + half)
    limits = centre - half, centre + half
    least = 0.9 * settings.window * rate
    usable, reasons = usable_stretches(waveform, imu, site, limits, last - first, least)
    if not np.any(usable):
        told = "; ".join(f"{k}: {v}" for k, v in reasons.items()) or "the log is too short"
        raise InputError(
            f"magnetometer: no window of {settings.window:g} s is usable ({told}); "
            "record longer, or choose a shorter window"
        )
    return Windows(
        centre=centre[usable],
        first=first[usable],
        count=(last - first)[usable],
        dropped=reasons,
    )


def usable_stretches(
    waveform: Waveform,
    imu: ImuSamples,
    site: Site,
    limits: tuple[Array, Array],
    count: IntArray,
    least: float,
    *,
    clips: bool = True,
) -> tuple[BoolArray, Mapping[str, int]]:
    """Tell which stretches of a waveform no gap and no saturation spoils.

    Parameters
    ----------
    waveform : Waveform
    imu : ImuSamples
    site : Site
    limits : tuple of ndarray, shape (n,)
        Begin and end of each stretch (s).
    count : int ndarray, shape (n,)
        Samples that it holds.
    least : float
        Samples that it must hold.
    clips : bool
        Whether a constant extreme is saturation.

    Returns
    -------
    usable : bool ndarray, shape (n,)
    dropped : mapping
        Reason to number of stretches.
    """
    begin, end = limits
    time, rate = waveform.time, sample_rate_hz(waveform)
    imu_time = imu.time + site.platform.imu.time_offset
    reasons = Counter[str]()
    usable = np.ones(len(begin), dtype=bool)

    def drop(reason: str, spoilt: BoolArray) -> None:
        reasons[reason] += int(np.sum(usable & spoilt))
        usable[spoilt] = False

    gap = np.flatnonzero(np.diff(time) > 1.5 / rate)
    # From just before the first missing sample to just after the last.
    missing = time[gap] + 0.75 / rate, time[gap + 1] - 0.75 / rate
    drop("gap in the magnetometer stream", _meets(*missing, begin, end))
    drop("too few samples", count < least)
    if clips:
        clipped = _saturated(waveform)
        drop("magnetometer saturated", _meets(clipped, clipped, begin, end))
    step = _usual_step(imu_time, "imu")
    margin = 2.0 * step + 3.0 * site.platform.imu.time_offset_sigma
    inside = (begin >= imu_time[0] - margin) & (end <= imu_time[-1] + margin)
    drop("no inertial data", ~inside)
    gap = np.flatnonzero(np.diff(imu_time) > 3.0 * step)
    silent = _meets(imu_time[gap], imu_time[gap + 1], begin, end)
    drop("gap in the inertial stream", silent)
    return usable, {k: v for k, v in reasons.items() if v}


def _meets(begin: Array, end: Array, window_begin: Array, window_end: Array) -> BoolArray:
    """Tell which windows meet at least one of the stretches, which are sorted and apart."""
    begun, ended = np.searchsorted(begin, window_end), np.searchsorted(end, window_begin)
    return np.asarray(begun > ended)


def _saturated(waveform: Waveform) -> Array:
    """Return the times at which an axis stays at the extreme of all its values, as if clipped."""
    hit = np.zeros(len(waveform), dtype=bool)
    for axis in waveform.measured_sensor.T:
        for extreme in (np.min(axis), np.max(axis)):
            at = axis == extreme
            hit |= binary_opening(at, np.ones(SATURATED_RUN))
    return np.asarray(waveform.time[hit])
