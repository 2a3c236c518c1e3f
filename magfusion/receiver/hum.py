"""Mains hum of variable frequency, tracked so that its harmonics can be fitted."""

from dataclasses import dataclass

import numpy as np

from magfusion.model.samples import Waveform
from magfusion.units import Array, ComplexArray

SPAN = 1.0  # s; length of the tracking windows, which overlap by half
MAX_ORDERS = 6
HIGHEST = 0.95  # of half the sampling rate
COHERENT = 0.5  # coherence of successive windows; of noise it is one sixth
SMOOTHED = 5  # windows


@dataclass(frozen=True, eq=False)
class Hum:
    """Phase of the mains over a record."""

    frequency_hz: float  # mean frequency
    orders: Array  # (harmonics,), harmonics below the Nyquist frequency
    # time, turns: (n,), turns up to each time (s)
    time: Array
    turns: Array

    def angle(self, time: Array) -> Array:
        """Return the phase of the fundamental at times, same shape (rad)."""
        beyond = np.maximum(time - self.time[-1], 0.0) + np.minimum(time - self.time[0], 0.0)
        inside = np.interp(time, self.time, self.turns)
        return np.asarray(2.0 * np.pi * (inside + self.frequency_hz * beyond))


def hum_of(waveform: Waveform, mains_hz: float) -> Hum | None:
    """Return the mains of a stationary waveform, tracked; None if they do not exceed the noise.

    `mains_hz`: nominal frequency; zero for none.
    """
    step = float(np.median(np.diff(waveform.time)))
    orders = np.arange(1.0, MAX_ORDERS + 1.0)
    orders = orders[orders * mains_hz < HIGHEST * 0.5 / step]
    if mains_hz <= 0.0 or not len(orders):
        return None
    begin, end = float(waveform.time[0]), float(waveform.time[-1])
    nominal = Hum(mains_hz, orders, np.array([begin, end]), mains_hz * np.array([begin, end]))
    centre = np.arange(begin + 0.5 * SPAN, end - 0.5 * SPAN, 0.5 * SPAN)
    if len(centre) < 2 * SMOOTHED:
        return nominal
    looks = _looks(waveform, centre, mains_hz * orders, step)
    others = np.sum(np.conj(looks[:-1]) * looks[1:], axis=-1)
    power = np.sum(np.abs(looks) ** 2, axis=(0, 2))
    coherence = np.abs(np.sum(others, axis=0)) / np.maximum(power, 1e-300)
    best = int(np.argmax(np.where(coherence > COHERENT, power, -1.0)))
    if coherence[best] <= COHERENT:
        return nominal
    smooth = np.apply_along_axis(np.convolve, 0, others[:, best], np.ones(SMOOTHED), "same")
    off = np.angle(smooth) / (2.0 * np.pi * orders[best] * 0.5 * SPAN)
    turns = np.concatenate([[0.0], np.cumsum(0.5 * SPAN * (mains_hz + off))])
    return Hum(mains_hz + float(np.mean(off)), orders, centre, turns)


def _looks(waveform: Waveform, centre: Array, frequencies_hz: Array, step: float) -> ComplexArray:
    """Return the phasors of short windows, shape (windows, frequencies, 3)."""
    reach = int(SPAN / step)
    first = np.searchsorted(waveform.time, centre - 0.5 * SPAN)
    out = np.zeros((len(centre), len(frequencies_hz), 3), dtype=np.complex128)
    for begin in range(0, len(centre), 256):
        rows = slice(begin, begin + 256)
        index = np.minimum(first[rows, None] + np.arange(reach), len(waveform) - 1)
        time, field = waveform.time[index], waveform.measured_sensor[index]
        elapsed = time - centre[rows, None]
        taper = np.where(np.abs(elapsed) < 0.5 * SPAN, np.cos(np.pi * elapsed / SPAN) ** 2, 0.0)
        field = field - np.mean(field, axis=1, keepdims=True)
        for k, frequency in enumerate(frequencies_hz):
            carrier = taper * np.exp(-2j * np.pi * frequency * time)
            out[rows, k] = np.einsum("nm,nmx->nx", carrier, field)
    return out
