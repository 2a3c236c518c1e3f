"""Tones of a sensor at rest, in pieces of a few seconds: what hours are made of.

At rest nothing is turned by the gyroscope, whose noise would make noise of the Earth's field.  Each
piece is fitted under a Hann taper, so that what is far from a tone does not leak into it, and
pieces overlap by half, so that their mean leaves nothing of the record out.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.model.samples import Waveform
from magfusion.receiver.hum import Hum
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

CHUNK = 64  # pieces at once
LEAST_SHARE = 0.9  # of the samples of a piece
HUM_CLEAR = 2.0  # resolutions of a piece between a tone and a harmonic that is fitted beside it


@dataclass(frozen=True, eq=False)
class Pieces:
    """Phasors of pieces, each referred to the frequency that it was demodulated by.

    Parameters
    ----------
    centre : ndarray, shape (n,)
        (s)
    length : float
        (s)
    phasor : complex ndarray, shape (n, tones, 3)
        (T), the axes of the sensor; their phase is that of a cosine at time zero of the log.
    """

    centre: Array
    length: float
    phasor: ComplexArray


def pieces(
    waveform: Waveform,
    span: tuple[float, float],
    frequencies_hz: Array,
    length: float,
    hum: Hum | None = None,
) -> Pieces:
    """Return the phasors of pieces of a waveform at rest.

    Parameters
    ----------
    span : tuple of float
        Beginning and end of the rest (s).
    frequencies_hz : ndarray, shape (tones,)
        As they are sent.
    length : float
        Of a piece (s).
    hum : Hum, optional
        Whose harmonics are fitted beside the tones.
    """
    time = waveform.time
    step = float(np.median(np.diff(time)))
    count = int((span[1] - span[0] + step) / (0.5 * length)) - 1
    centre = np.asarray(span[0] - 0.5 * step + 0.5 * length * np.arange(1.0, count + 1.0))
    first = np.searchsorted(time, centre - 0.5 * length)
    held = np.searchsorted(time, centre + 0.5 * length) - first
    whole = held * step >= LEAST_SHARE * length
    centre, first, held = centre[whole], first[whole], held[whole]
    found = [
        _fitted(waveform, centre[k], first[k], held[k], frequencies_hz, length, hum)
        for k in (slice(i, i + CHUNK) for i in range(0, len(centre), CHUNK))
    ]
    empty = np.zeros((0, len(frequencies_hz), 3), dtype=np.complex128)
    phasor = np.concatenate([empty, *found])
    alive = np.any(phasor != 0.0, axis=(1, 2))
    return Pieces(centre[alive], length, phasor[alive])


def _fitted(
    waveform: Waveform,
    centre: Array,
    first: IntArray,
    held: IntArray,
    frequencies_hz: Array,
    length: float,
    hum: Hum | None,
) -> ComplexArray:
    reach = np.arange(int(np.max(held)))
    index = np.minimum(first[:, None] + reach, len(waveform) - 1)
    elapsed = waveform.time[index] - centre[:, None]
    inside = reach < held[:, None]
    taper = np.where(inside, np.cos(np.pi * elapsed / length) ** 2, 0.0)
    design = _design(elapsed, waveform.time[index], frequencies_hz, length, hum)
    weighted = np.swapaxes(design * taper[..., None], 1, 2)
    fitted = np.linalg.solve(weighted @ design, weighted @ waveform.measured_sensor[index])
    n = len(frequencies_hz)
    turns = np.exp(-2j * np.pi * frequencies_hz * centre[:, None])
    return np.asarray((fitted[:, 2 : 2 + n] - 1j * fitted[:, 2 + n : 2 + 2 * n]) * turns[..., None])


def _design(
    elapsed: Array, time: Array, frequencies_hz: Array, length: float, hum: Hum | None
) -> Array:
    """Return columns: constant, ramp, cosines and sines of tones, and of the hum with their ramps.

    Shape (n, m, columns).
    """
    ramp = elapsed[..., None] * (2.0 / length)
    angle = 2.0 * np.pi * elapsed[..., None] * frequencies_hz
    columns = [np.ones_like(ramp), ramp, np.cos(angle), np.sin(angle)]
    if hum is not None:
        orders = hum.orders[_clear(hum, frequencies_hz, length)]
        angle = hum.angle(time)[..., None] * orders
        wave = np.concatenate([np.cos(angle), np.sin(angle)], axis=-1)
        columns += [wave, ramp * wave]
    return np.concatenate(columns, axis=-1)


def _clear(hum: Hum, frequencies_hz: Array, length: float) -> BoolArray:
    """Return which harmonics a piece tells from every tone."""
    off = np.abs(hum.orders[:, None] * hum.frequency_hz - frequencies_hz)
    return np.asarray(np.min(off, axis=1, initial=np.inf) * length > HUM_CLEAR)
