"""Lock-in: raw waveform to phasors, one least-squares design a window.

The window is long against the motion, so that a plain lock-in leaks the Earth field and the other
beacons into each tone.  Each sample is therefore first turned by the gyro into axes that stand
still, what is found back into those of the window's centre, and the design holds a linear ramp for
each tone.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import starmap

import numpy as np

from magfusion.model.samples import FieldSamples, ImuSamples, Log, SteadyFields, Waveform
from magfusion.model.site import Site
from magfusion.receiver.admission import (
    Windows,
    meets_silence,
    sample_rate_hz,
    silences,
    usual_step,
)
from magfusion.receiver.noise import (
    FittedWindows,
    noise_beside_tones,
    not_below,
    smoothed_over_windows,
)
from magfusion.receiver.turn import on_clock, standing_in, turn_of
from magfusion.receiver.windows import LockinSettings, channel_frequencies_hz
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

CHUNK = 1000  # windows demodulated at once: they fit in memory
MOST_COMPARED = 50  # windows by which two clocks are compared
LEAST_COMPARED = 0.8  # of the samples of the fullest
UNSEEN_TURN = 1.0  # rad/s; of a person or a vehicle, while the gyro is silent
WORST_CONDITION = 1e8  # of a normal matrix; beyond, the samples do not tell its columns apart


@dataclass(frozen=True, eq=False)
class WindowOperator:
    """The linear map from samples to phasors, kept so that a prediction can pass through it.

    Parameters
    ----------
    channels : tuple of (str, int)
    frequencies_hz, nuisance_hz : ndarray
        Tones, and lines that are fitted beside them (Hz).
    time : ndarray, shape (samples,)
        (s)
    still_from_measured : ndarray, shape (samples, 3, 3)
        Takes each sample to axes that do not turn with the body.
    measured_from_still : ndarray, shape (windows, 3, 3)
        Takes the fields back at the centre of each window.
    declared_noise : float
        Of a sample, one sigma (T).
    unseen : bool ndarray, shape (windows,)
        Where the gyro is silent: the ramps follow a turn that it does not see, and what the
        square of it does is noise.
    apart : bool ndarray, shape (windows,)
        Whose noise is not that of their neighbours: there the turn was found without a gyro.
    """

    settings: LockinSettings
    channels: tuple[tuple[str, int], ...]
    frequencies_hz: Array
    nuisance_hz: Array
    time: Array
    windows: Windows
    still_from_measured: Array
    measured_from_still: Array
    declared_noise: float
    unseen: BoolArray
    apart: BoolArray

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
        return np.concatenate(list(starmap(self._phasor, self._fitted(measured_sensor))))

    def demodulate(self, measured_sensor: Array) -> tuple[FieldSamples, SteadyFields]:
        """Turn raw samples into phasors and the steady field beside them, each with covariance.

        Parameters
        ----------
        measured_sensor : ndarray, shape (samples, 3)
            (T).  Where a prediction has been taken off, the noise is measured without what motion
            leaks beside the tones.  For the steady field the known offset, or a prediction, should
            have been taken off: the gyro turns with the samples what does not turn with the
            platform.
        """
        n, parts = len(self.frequencies_hz), []
        for rows, fit in self._fitted(measured_sensor):
            turn = self.measured_from_still[rows]
            beside_hz = np.concatenate([self.nuisance_hz, self.settings.lines_hz])
            noise = noise_beside_tones(self.frequencies_hz, beside_hz, fit)
            own = np.einsum("nii->ni", fit.inverse)
            found = self._phasor(rows, fit)
            parts.append(
                (
                    found,
                    self._bent(rows, fit) * np.sum(np.abs(found) ** 2, axis=-1),
                    0.5 * (own[:, 2 : 2 + n] + own[:, 2 + n : 2 + 2 * n]),
                    turn[:, None] @ noise @ np.swapaxes(turn, 1, 2)[:, None],
                    (turn @ fit.coefficients[:, 0, :, None])[..., 0],
                    own[:, 0],
                )
            )
        phasor, bent, unit, noise, constant, constant_unit = (
            np.concatenate(part) for part in zip(*parts, strict=True)
        )
        centre, settings = self.windows.centre, self.settings
        smooth = smoothed_over_windows(
            noise, centre, settings.step, settings.noise_windows, self.unseen | self.apart
        )
        smooth = not_below(smooth, self.declared_noise)
        samples = FieldSamples(
            time=centre,
            window=np.full(len(centre), settings.window),
            channels=self.channels,
            phasor_sensor=phasor,
            phasor_cov=unit[..., None, None] * smooth + bent[..., None, None] * np.eye(3),
        )
        beside = constant_unit[:, None, None] * np.mean(smooth, axis=1)
        return samples, SteadyFields(centre, constant, beside)

    def _fitted(self, measured_sensor: Array) -> Iterator[tuple[slice, FittedWindows]]:
        """Yield the windows in pieces, each with the design fitted to a waveform."""
        still = (self.still_from_measured @ measured_sensor[..., None])[..., 0]
        for begin in range(0, len(self.windows), CHUNK):
            rows = slice(begin, begin + CHUNK)
            some = self.windows.rows(rows)
            index, weight, elapsed = _padded(some, self.time)
            design = _design(elapsed, self.settings, self.frequencies_hz, self.nuisance_hz)
            design *= weight[..., None]
            field, projected = still[index] * weight[..., None], np.swapaxes(design, -1, -2)
            inverse = np.asarray(np.linalg.inv(projected @ design))
            fitted = inverse @ (projected @ field)
            yield rows, FittedWindows(elapsed, weight, design, inverse, field, fitted)

    def unexplained(self, measured_sensor: Array) -> Array:
        """Return the power that the design leaves of each window, shape (n,) (T^2)."""
        out = []
        for _, fit in self._fitted(measured_sensor):
            left = fit.field - fit.design @ fit.coefficients
            out.append(np.sum(left**2, axis=(1, 2)) / np.sum(fit.weight, axis=1))
        return np.concatenate(out)

    def _bent(self, rows: slice, fit: FittedWindows) -> Array:
        """Return the relative variance of phasors by the square of a turn that is not seen.

        Shape (n, channels): what the design makes of a tone that falls with the square of time.
        """
        n, out = len(self.frequencies_hz), np.zeros((len(fit.elapsed), len(self.frequencies_hz)))
        unseen = self.unseen[rows]
        if not np.any(unseen):
            return out
        design, elapsed = fit.design[unseen], fit.elapsed[unseen]
        square = (UNSEEN_TURN * elapsed[..., None]) ** 2  # half of it for each axis across
        falling = square * design[..., 2 : 2 + n]
        made = fit.inverse[unseen] @ (np.swapaxes(design, -1, -2) @ falling)
        out[unseen] = np.einsum("nii->ni", made[:, 2 : 2 + n]) ** 2
        return out

    def _phasor(self, rows: slice, fit: FittedWindows) -> ComplexArray:
        n, centre = len(self.frequencies_hz), self.windows.centre[rows]
        cosine, sine = fit.coefficients[:, 2 : 2 + n], fit.coefficients[:, 2 + n : 2 + 2 * n]
        reference = np.exp(-2j * np.pi * self.frequencies_hz * centre[:, None])
        still = (cosine - 1j * sine) * reference[..., None]
        return still @ np.swapaxes(self.measured_from_still[rows], 1, 2)


def _nuisances_hz(settings: LockinSettings, frequencies: Array, nyquist_hz: float) -> Array:
    if settings.mains_hz <= 0:
        return np.zeros(0)
    lines = np.arange(settings.mains_hz, 0.95 * nyquist_hz, settings.mains_hz)[:6]
    others = np.concatenate([frequencies, settings.lines_hz])
    apart = np.min(np.abs(lines[:, None] - others), axis=1) * settings.window
    return lines[apart > 0.8]


def window_operator(
    waveform: Waveform,
    imu: ImuSamples,
    site: Site,
    settings: LockinSettings,
    windows: Windows,
    imu_step: float | None = None,
) -> WindowOperator:
    """Return the map from a waveform to phasors, with the gyro's turn of each sample.

    Parameters
    ----------
    imu : ImuSamples
        As from `magfusion.receiver.turn.on_clock`.
    site : Site
        Tones, magnetometer matrix and mounting.
    windows : Windows
        That were admitted.
    imu_step : float, optional
        Usual time between two inertial samples (s): a piece of a stream may have none.
    """
    frequencies, nyquist_hz = channel_frequencies_hz(site), sample_rate_hz(waveform) / 2.0
    step = usual_step(imu.time, "imu") if imu_step is None else imu_step
    margin = 2.0 * step + 3.0 * site.platform.imu.time_offset_sigma
    silence = silences(imu.time, step, margin)
    measured_from_still = turn_of(standing_in(imu, silence), site)
    return WindowOperator(
        settings=settings,
        channels=site.channels,
        frequencies_hz=frequencies,
        nuisance_hz=_nuisances_hz(settings, frequencies, nyquist_hz),
        time=waveform.time,
        windows=windows,
        still_from_measured=np.asarray(np.linalg.inv(measured_from_still(waveform.time))),
        measured_from_still=measured_from_still(windows.centre),
        declared_noise=site.platform.magnetometer.noise_density * float(np.sqrt(nyquist_hz)),
        unseen=meets_silence(windows, settings.window, waveform.time, silence),
        apart=np.zeros(len(windows), dtype=bool),
    )


def _padded(windows: Windows, time: Array) -> tuple[IntArray, BoolArray, Array]:
    """Return the samples of windows, which of them are no padding, and their times (s)."""
    reach = np.arange(int(np.max(windows.count)))
    weight = reach < windows.count[:, None]
    index = np.minimum(windows.first[:, None] + reach, len(time) - 1)
    return index, weight, np.where(weight, time[index] - windows.centre[:, None], 0.0)


def unexplained(log: Log, site: Site, settings: LockinSettings) -> Array:
    """Return the power that tones and turn leave of some windows in a row, shape (windows,) (T^2).

    Parameters
    ----------
    log : Log
        With a waveform.
    """
    waveform, half = log.waveform, 0.5 * settings.window
    assert waveform is not None
    first, last = waveform.time[0] + half, waveform.time[-1] - half
    centre = np.linspace(first, max(first, last), MOST_COMPARED)
    begin = np.searchsorted(waveform.time, centre - half)
    count = np.searchsorted(waveform.time, centre + half) - begin
    rows = count > LEAST_COMPARED * np.max(count)
    windows = Windows(np.arange(len(centre)), centre, begin, count).rows(rows)
    imu = on_clock(log.imu, site.platform.imu.time_offset)
    operator = window_operator(waveform, imu, site, settings, windows)
    return operator.unexplained(waveform.measured_sensor - site.platform.magnetometer.offset)


def separable(step: float, settings: LockinSettings, frequencies_hz: Array) -> bool:
    """Return whether the samples of a whole window, ``step`` apart (s), tell its columns apart."""
    elapsed = _whole_window(step, settings)
    design = _design(
        elapsed,
        settings,
        frequencies_hz,
        _nuisances_hz(settings, frequencies_hz, 0.5 / step),
    )[0]
    enough = design.shape[0] > design.shape[1]
    return enough and bool(np.linalg.cond(design.T @ design) < WORST_CONDITION)


def _whole_window(step: float, settings: LockinSettings) -> Array:
    """Return the times of a whole window's samples from its centre, shape (1, samples) (s)."""
    return np.arange(-0.5 * settings.window + 0.5 * step, 0.5 * settings.window, step)[None]


def variance_growth(
    windows: Windows, time: Array, step: float, settings: LockinSettings, frequencies_hz: Array
) -> Array:
    """Return how many times the variance of a window's phasors is that of a whole window.

    By the conditioning of the design at the samples that are there, the worst tone.

    Parameters
    ----------
    time : ndarray
        Of all samples (s).
    step : float
        Between two samples of a whole window (s).
    """
    nuisance_hz = _nuisances_hz(settings, frequencies_hz, 0.5 / step)

    def variance(elapsed: Array, weight: BoolArray) -> Array:
        design = _design(elapsed, settings, frequencies_hz, nuisance_hz) * weight[..., None]
        normal = np.swapaxes(design, -1, -2) @ design
        good = np.linalg.cond(normal) < WORST_CONDITION
        normal[~good] = np.eye(normal.shape[-1])
        own = np.diagonal(np.linalg.inv(normal), axis1=-2, axis2=-1)
        return np.where(good[:, None], own[:, 2 : 2 + 2 * len(frequencies_hz)], np.inf)

    whole = _whole_window(step, settings)
    usual, out = variance(whole, np.ones_like(whole, dtype=bool)), []
    for begin in range(0, len(windows), CHUNK):
        _, weight, elapsed = _padded(windows.rows(slice(begin, begin + CHUNK)), time)
        out.append(np.max(variance(elapsed, weight) / usual, axis=1))
    return np.concatenate(out)


def _design(
    elapsed: Array, settings: LockinSettings, frequencies: Array, nuisances: Array
) -> Array:
    """Columns: constant, drift, each tone's cosines, sines and their ramps, mains, other lines."""
    ramp = elapsed[..., None] * (2.0 / settings.window)
    other = 2.0 * np.pi * elapsed[..., None] * np.array(settings.lines_hz)
    along, across = np.cos(other), np.sin(other)
    angle = 2.0 * np.pi * elapsed[..., None] * frequencies
    cosine, sine = np.cos(angle), np.sin(angle)
    mains = 2.0 * np.pi * elapsed[..., None] * nuisances
    return np.concatenate(
        [
            *(np.ones_like(ramp), ramp, cosine, sine, ramp * cosine, ramp * sine),
            *(np.cos(mains), np.sin(mains)),
            *(along, across, ramp * along, ramp * across),
        ],
        axis=-1,
    )
