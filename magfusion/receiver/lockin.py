"""Lock-in: raw waveform to phasors, one least-squares design a window.

The window is long against the motion, so that a plain lock-in leaks the Earth field and the other
beacons into each tone.  Each sample is therefore first turned by the gyro into the axes of the
window's centre, and the design holds a linear ramp for each tone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from magfusion.receiver.noise import noise_beside_tones, smoothed_over_windows
from magfusion.receiver.windows import (
    LockinSettings,
    Windows,
    channel_frequencies_hz,
    sample_rate_hz,
)
from magfusion.records.samples import FieldSamples, ImuSamples, SteadyFields, Waveform
from magfusion.site import Magnetometer, Site
from magfusion.strapdown import attitude_at, attitude_from_gyro
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

CHUNK = 1000  # windows demodulated at once


@dataclass(frozen=True, eq=False)
class WindowOperator:
    """The linear map from samples to phasors, kept so that a prediction can pass through it.

    Parameters
    ----------
    settings : LockinSettings
    channels : tuple of (str, int)
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
    channels: tuple[tuple[str, int], ...]
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
    constant: Array
    constant_variance: Array
    elapsed: Array
    weight: BoolArray
    design: Array
    inverse: Array
    turned: Array


def chunks(n: int) -> list[slice]:
    """Cut n windows into pieces that fit in memory."""
    return [slice(i, min(i + CHUNK, n)) for i in range(0, n, CHUNK)]


def _nuisances_hz(settings: LockinSettings, frequencies: Array, nyquist_hz: float) -> Array:
    if settings.mains_hz <= 0:
        return np.zeros(0)
    lines = np.arange(settings.mains_hz, 0.95 * nyquist_hz, settings.mains_hz)[:6]
    apart = np.min(np.abs(lines[:, None] - frequencies), axis=1) * settings.window
    return np.asarray(lines[apart > 0.8])


def window_operator(
    waveform: Waveform,
    imu: ImuSamples,
    site: Site,
    settings: LockinSettings,
    windows: Windows,
    *,
    gyro_bias_body: Array | None = None,
    time_offset: float | None = None,
) -> WindowOperator:
    """Return the map from a waveform to phasors, with the gyro's turn of each sample.

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
    WindowOperator
    """
    offset = site.platform.imu.time_offset if time_offset is None else time_offset
    imu_time = imu.time + offset
    gyro = imu.gyro_body - (0.0 if gyro_bias_body is None else gyro_bias_body)
    frequencies = channel_frequencies_hz(site)
    return WindowOperator(
        settings=settings,
        channels=site.channels,
        frequencies_hz=frequencies,
        nuisance_hz=_nuisances_hz(settings, frequencies, sample_rate_hz(waveform) / 2.0),
        time=waveform.time,
        windows=windows,
        turn=_turner(waveform.time, imu_time, gyro, site.platform.magnetometer),
    )


def demodulate(operator: WindowOperator, measured_sensor: Array) -> FieldSamples:
    """Turn raw samples into phasors with covariance.

    Parameters
    ----------
    operator : WindowOperator
    measured_sensor : ndarray, shape (samples, 3)
        At the operator's times (T).  Where a prediction has been taken off, the noise is measured
        without what motion leaks beside the tones.

    Returns
    -------
    FieldSamples
    """
    return demodulate_with_steady(operator, measured_sensor)[0]


def demodulate_with_steady(
    operator: WindowOperator, measured_sensor: Array
) -> tuple[FieldSamples, SteadyFields]:
    """Turn raw samples into phasors and the steady field beside them, each with covariance.

    Parameters
    ----------
    operator, measured_sensor
        As in `demodulate`.  For the steady field the known offset, or a prediction, should have
        been taken off: the gyro turns with the samples what does not turn with the platform.

    Returns
    -------
    FieldSamples, SteadyFields
    """
    phasor, unit, noise, constant, constant_variance = _fit_all(operator, measured_sensor)
    centre, settings = operator.windows.centre, operator.settings
    smooth = smoothed_over_windows(noise, centre, settings.step, settings.noise_windows)
    samples = FieldSamples(
        time=centre,
        window=np.full(len(centre), settings.window),
        channels=operator.channels,
        phasor_sensor=phasor,
        phasor_cov=unit[..., None, None] * smooth,
    )
    beside = constant_variance[:, None, None] * np.mean(smooth, axis=1)
    return samples, SteadyFields(centre, constant, beside)


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


def _fit_all(
    operator: WindowOperator, measured: Array
) -> tuple[ComplexArray, Array, Array, Array, Array]:
    shape = (len(operator.windows.centre), len(operator.frequencies_hz))
    phasor = np.empty((*shape, 3), dtype=np.complex128)
    unit = np.empty(shape)
    noise = np.empty((*shape, 3, 3))
    constant, constant_variance = np.empty((shape[0], 3)), np.empty(shape[0])
    for rows in chunks(len(operator.windows.centre)):
        fit = fit_windows(operator, rows, measured)
        phasor[rows], unit[rows] = fit.phasor, fit.unit_variance
        constant[rows], constant_variance[rows] = fit.constant, fit.constant_variance
        noise[rows] = noise_beside_tones(
            operator.frequencies_hz,
            operator.nuisance_hz,
            fit.elapsed,
            fit.weight,
            fit.design,
            fit.inverse,
            fit.turned,
        )
    return phasor, unit, noise, constant, constant_variance


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
    return _Fit(
        phasor=phasor,
        unit_variance=np.asarray(unit),
        constant=np.asarray(coefficients[:, 0]),
        constant_variance=np.asarray(diagonal[:, 0]),
        elapsed=elapsed,
        weight=weight,
        design=np.asarray(design),
        inverse=np.asarray(inverse),
        turned=np.asarray(turned),
    )


def _design(elapsed: Array, window: float, frequencies: Array, nuisances: Array) -> Array:
    """Columns: constant, drift, each tone's cosines, sines and their ramps, mains."""
    ramp = elapsed[..., None] * (2.0 / window)
    angle = 2.0 * np.pi * elapsed[..., None] * frequencies
    cosine, sine = np.cos(angle), np.sin(angle)
    mains = 2.0 * np.pi * elapsed[..., None] * nuisances
    return np.concatenate(
        [
            *(np.ones_like(ramp), ramp, cosine, sine, ramp * cosine, ramp * sine),
            *(np.cos(mains), np.sin(mains)),
        ],
        axis=-1,
    )
