"""Lock-in: raw waveform to phasors, one least-squares design a window.

The window is long against the motion, so that a plain lock-in leaks the Earth field and the other
beacons into each tone.  Each sample is therefore first turned by the gyro into the axes of the
window's centre, and the design holds a linear ramp for each tone.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from magfusion.errors import InputError
from magfusion.receiver.noise import noise_beside_tones, smoothed_over_windows
from magfusion.records.samples import FieldSamples, ImuSamples, Waveform
from magfusion.site import Magnetometer, Site
from magfusion.strapdown import attitude_at, attitude_from_gyro
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

CHUNK = 1000  # windows demodulated at once
SATURATED_RUN = 3  # consecutive samples at the extreme of the range


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


@dataclass(frozen=True, eq=False)
class Demodulated:
    """Phasors, and the linear map that made them.

    Parameters
    ----------
    fields : FieldSamples
    operator : WindowOperator
        The map that made them.
    """

    fields: FieldSamples
    operator: "WindowOperator"


@dataclass(frozen=True, eq=False)
class WindowOperator:
    """The linear map from samples to phasors, kept so that a prediction can pass through it.

    Parameters
    ----------
    settings : LockinSettings
    frequencies_hz, nuisance_hz : ndarray
        Tones, and lines that are fitted beside them (Hz).
    time : ndarray, shape (samples,)
        (s)
    windows : Windows
    turn : callable
        Gives, for sample indices (n, m) and the window centres, the matrices (n, m, 3, 3) that turn
        a measured field into the axes of the window's centre.
    """

    settings: LockinSettings
    frequencies_hz: Array
    nuisance_hz: Array
    time: Array
    windows: Windows
    turn: Callable[[IntArray, Array], Array]

    def apply(self, measured_sensor: Array) -> ComplexArray:
        """Return the phasors of a waveform given at the same sample times.

        Parameters
        ----------
        measured_sensor : ndarray, shape (samples, 3)
            (T)

        Returns
        -------
        complex ndarray, shape (n, channels, 3)
            (T), measured axes at the centre of the window.
        """
        out = np.empty((len(self.windows.centre), len(self.frequencies_hz), 3), dtype=np.complex128)
        for rows in chunks(len(self.windows.centre)):
            part = fit_windows(self, rows, measured_sensor)
            out[rows] = part.phasor
        return out


@dataclass(frozen=True, eq=False)
class _Fit:
    phasor: ComplexArray
    unit_variance: Array
    elapsed: Array
    weight: BoolArray
    design: Array
    inverse: Array
    turned: Array


def chunks(n: int) -> list[slice]:
    """Cut n windows into pieces that fit in memory."""
    return [slice(i, min(i + CHUNK, n)) for i in range(0, n, CHUNK)]


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
    window = float(np.clip(2.0 / spacing, 0.02, 4.0))
    return LockinSettings(window=window, step=window / 2.0, mains_hz=mains_hz)


def channel_frequencies_hz(site: Site) -> Array:
    """Return the frequency of each channel (Hz), refusing tones that cannot be told apart."""
    for beacon in site.beacons:
        if any(slot is not None for _, slot in beacon.tones):
            raise InputError(
                f"beacon {beacon.name} is driven in time slots, which the lock-in cannot separate; "
                "give its demodulated fields.parquet instead of the waveform"
            )
    frequencies = np.concatenate([b.tone_frequencies_hz for b in site.beacons])
    order = np.argsort(frequencies)
    close = np.flatnonzero(np.diff(frequencies[order]) < 0.1)
    if len(close):
        a, b = (site.channels[order[close[0] + i]][0] for i in (0, 1))
        raise InputError(
            f"beacons {a} and {b} both transmit at {frequencies[order[close[0]]]:g} Hz; "
            "tones must differ by at least 0.1 Hz to be told apart"
        )
    return frequencies


def _nuisances_hz(settings: LockinSettings, frequencies: Array, nyquist_hz: float) -> Array:
    if settings.mains_hz <= 0:
        return np.zeros(0)
    lines = np.arange(settings.mains_hz, 0.95 * nyquist_hz, settings.mains_hz)[:6]
    apart = np.min(np.abs(lines[:, None] - frequencies), axis=1) * settings.window
    return np.asarray(lines[apart > 0.8])


def demodulate(
    waveform: Waveform,
    imu: ImuSamples,
    site: Site,
    settings: LockinSettings,
    windows: Windows,
    *,
    gyro_bias_body: Array | None = None,
    time_offset: float | None = None,
) -> Demodulated:
    """Turn a raw waveform into phasors with covariance.

    Parameters
    ----------
    waveform : Waveform
    imu : ImuSamples
        Its gyro turns each sample into the axes of its window's centre.
    site : Site
        Tones, magnetometer matrix and mounting.
    settings : LockinSettings
    windows : Windows
        From `choose_windows`.
    gyro_bias_body : ndarray, shape (3,) or (len(imu), 3), optional
        (rad/s)
    time_offset : float, optional
        IMU time offset (s); the site's where it is not given.

    Returns
    -------
    Demodulated
    """
    offset = site.platform.imu.time_offset if time_offset is None else time_offset
    imu_time = imu.time + offset
    gyro = imu.gyro_body - (0.0 if gyro_bias_body is None else gyro_bias_body)
    frequencies = channel_frequencies_hz(site)
    operator = WindowOperator(
        settings=settings,
        frequencies_hz=frequencies,
        nuisance_hz=_nuisances_hz(settings, frequencies, sample_rate_hz(waveform) / 2.0),
        time=waveform.time,
        windows=windows,
        turn=_turner(waveform.time, imu_time, gyro, site.platform.magnetometer),
    )
    phasor, unit, noise = _fit_all(operator, waveform.measured_sensor)
    smooth = smoothed_over_windows(noise, windows.centre, settings.step, settings.noise_windows)
    fields = FieldSamples(
        time=windows.centre,
        window=np.full(len(windows.centre), settings.window),
        channels=site.channels,
        phasor_sensor=phasor,
        phasor_cov=unit[..., None, None] * smooth,
    )
    return Demodulated(fields=fields, operator=operator)


def sample_rate_hz(waveform: Waveform) -> float:
    """Return the usual sampling rate (Hz)."""
    return 1.0 / float(np.median(np.diff(waveform.time)))


def _turner(
    time: Array, imu_time: Array, gyro_body: Array, magnetometer: Magnetometer
) -> Callable[[IntArray, Array], Array]:
    attitude = attitude_from_gyro(imu_time, gyro_body)
    at_samples = attitude_at(attitude, imu_time, gyro_body, time).as_matrix()
    mounting, matrix = magnetometer.body_from_sensor, magnetometer.matrix
    measured_from_body = matrix @ mounting.T
    body_from_measured = np.linalg.inv(measured_from_body)

    def turn(index: IntArray, centre: Array) -> Array:
        body_from_start = attitude_at(attitude, imu_time, gyro_body, centre).as_matrix()
        to_centre = np.swapaxes(body_from_start, -1, -2)[:, None] @ at_samples[index]
        return np.asarray(measured_from_body @ to_centre @ body_from_measured)

    return turn


def _fit_all(operator: WindowOperator, measured: Array) -> tuple[ComplexArray, Array, Array]:
    shape = (len(operator.windows.centre), len(operator.frequencies_hz))
    phasor = np.empty((*shape, 3), dtype=np.complex128)
    unit = np.empty(shape)
    noise = np.empty((*shape, 3, 3))
    for rows in chunks(len(operator.windows.centre)):
        fit = fit_windows(operator, rows, measured)
        phasor[rows], unit[rows] = fit.phasor, fit.unit_variance
        noise[rows] = noise_beside_tones(
            operator.frequencies_hz,
            operator.nuisance_hz,
            fit.elapsed,
            fit.weight,
            fit.design,
            fit.inverse,
            fit.turned,
        )
    return phasor, unit, noise


def fit_windows(operator: WindowOperator, rows: slice, measured_sensor: Array) -> _Fit:
    """Fit the design of some windows to a waveform, all at once."""
    settings, f, windows = operator.settings, operator.frequencies_hz, operator.windows
    centre, first, count = windows.centre[rows], windows.first[rows], windows.count[rows]
    reach = np.arange(int(np.max(count)))
    weight = reach < count[:, None]
    index = np.minimum(first[:, None] + reach, len(operator.time) - 1)
    elapsed = np.where(weight, operator.time[index] - centre[:, None], 0.0)
    design = _design(elapsed, settings.window, f, operator.nuisance_hz) * weight[..., None]
    turned = (operator.turn(index, centre) @ measured_sensor[index][..., None])[..., 0]
    turned *= weight[..., None]
    normal = np.swapaxes(design, -1, -2) @ design
    inverse = np.linalg.inv(normal)
    coefficients = inverse @ (np.swapaxes(design, -1, -2) @ turned)
    n = len(f)
    cosine, sine = coefficients[:, 2 : 2 + n], coefficients[:, 2 + n : 2 + 2 * n]
    reference = np.exp(-2j * np.pi * f * centre[:, None])
    phasor = (cosine - 1j * sine) * reference[..., None]
    diagonal = np.einsum("nii->ni", inverse)
    unit = 0.5 * (diagonal[:, 2 : 2 + n] + diagonal[:, 2 + n : 2 + 2 * n])
    return _Fit(phasor, unit, elapsed, weight, design, inverse, turned)


def _design(elapsed: Array, window: float, frequencies: Array, nuisances: Array) -> Array:
    """Columns: constant, drift, each tone's cosines, sines and their ramps, mains."""
    ramp = elapsed[..., None] * (2.0 / window)
    angle = 2.0 * np.pi * elapsed[..., None] * frequencies
    cosine, sine = np.cos(angle), np.sin(angle)
    mains = 2.0 * np.pi * elapsed[..., None] * nuisances
    return np.concatenate(
        [np.ones_like(ramp), ramp, cosine, sine, ramp * cosine, ramp * sine]
        + [np.cos(mains), np.sin(mains)],
        axis=-1,
    )


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
        Where the sampling rate is too low for the tones, or no window is usable.
    """
    rate, highest = sample_rate_hz(waveform), float(np.max(channel_frequencies_hz(site)))
    if highest > 0.45 * rate:
        raise InputError(
            f"magnetometer: sampled at {rate:.4g} Hz, too slow for the tone at {highest:g} Hz; "
            f"at least {highest / 0.45:.4g} Hz are needed"
        )
    imu_time = imu.time + site.platform.imu.time_offset
    time, half = waveform.time, settings.window / 2.0
    # The last sample stands for the interval up to the next one, as every sample does.
    number = int(np.floor((time[-1] + 1.0 / rate - time[0] - settings.window) / settings.step)) + 1
    centre = time[0] - 0.5 / rate + half + settings.step * np.arange(max(number, 0))
    first = np.searchsorted(time, centre - half)
    last = np.searchsorted(time, centre + half)
    reasons = Counter[str]()
    usable = np.ones(len(centre), dtype=bool)

    def drop(reason: str, spoilt: BoolArray) -> None:
        reasons[reason] += int(np.sum(usable & spoilt))
        usable[spoilt] = False

    gaps = time[:-1][np.diff(time) > 1.5 / rate]
    drop("gap in the magnetometer stream", _holds(gaps, centre - half, centre + half))
    drop("too few samples", last - first < 0.9 * settings.window * rate)
    drop("magnetometer saturated", _holds(_saturated(waveform), centre - half, centre + half))
    step = float(np.median(np.diff(imu_time)))
    margin = 2.0 * step + 3.0 * site.platform.imu.time_offset_sigma
    inside = (centre - half >= imu_time[0] - margin) & (centre + half <= imu_time[-1] + margin)
    drop("no inertial data", ~inside)
    missing = np.zeros(len(centre), dtype=bool)
    for i in np.flatnonzero(np.diff(imu_time) > 3.0 * step):
        missing |= (centre + half > imu_time[i]) & (centre - half < imu_time[i + 1])
    drop("gap in the inertial stream", missing)
    if not np.any(usable):
        told = "; ".join(f"{k}: {v}" for k, v in reasons.items() if v) or "the log is too short"
        raise InputError(
            f"magnetometer: no window of {settings.window:g} s is usable ({told}); "
            "record longer, or choose a shorter window"
        )
    return Windows(
        centre=centre[usable],
        first=first[usable],
        count=(last - first)[usable],
        dropped={k: v for k, v in reasons.items() if v},
    )


def _holds(instants: Array, start: Array, end: Array) -> BoolArray:
    """Which intervals hold at least one of the sorted instants."""
    return np.asarray(np.searchsorted(instants, end) > np.searchsorted(instants, start))


def _saturated(waveform: Waveform) -> Array:
    """Times at which an axis stays at the extreme of all its values: a clipped converter."""
    hit = np.zeros(len(waveform), dtype=bool)
    for axis in waveform.measured_sensor.T:
        for extreme in (np.min(axis), np.max(axis)):
            at = axis == extreme
            run = np.convolve(at, np.ones(SATURATED_RUN), mode="same") >= SATURATED_RUN
            hit |= run
    return np.asarray(waveform.time[hit])
