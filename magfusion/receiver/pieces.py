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
STANDS_OUT = 4.5  # times the median size of what a fit leaves; noise does so once in 10^10
MOST_BANGS, CUT_TWICE = 0.25, 2  # of the samples of a piece; how often they are left out
NO_PROBES = np.zeros(0)
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
    phasor : complex ndarray, shape (n, tones, components)
        (T), the axes of the sensor; their phase is that of a cosine at time zero of the log.
    beside : complex ndarray, shape (n, probes, components)
        The same of what is left at other frequencies.
    """

    centre: Array
    length: float
    phasor: ComplexArray
    beside: ComplexArray

    def rows(self, kept: BoolArray) -> "Pieces":
        """Return some pieces."""
        return Pieces(self.centre[kept], self.length, self.phasor[kept], self.beside[kept])


def pieces(
    waveform: Waveform,
    span: tuple[float, float],
    frequencies_hz: Array,
    length: float,
    hum: Hum | None = None,
    beside_hz: Array = NO_PROBES,
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
    beside_hz : ndarray, shape (probes,)
        Other frequencies at which what the fit leaves is told.
    """
    time = waveform.time
    step = float(np.median(np.diff(time)))
    count = int((span[1] - span[0] + step) / (0.5 * length)) - 1
    centre = np.asarray(span[0] - 0.5 * step + 0.5 * length * np.arange(1.0, count + 1.0))
    first = np.searchsorted(time, centre - 0.5 * length)
    held = np.searchsorted(time, centre + 0.5 * length) - first
    whole = held * step >= LEAST_SHARE * length
    centre, first, held = centre[whole], first[whole], held[whole]
    fitted = _Fitted(waveform, frequencies_hz, beside_hz, length, hum)
    found = [
        fitted.of(centre[k], first[k], held[k])
        for k in (slice(i, i + CHUNK) for i in range(0, len(centre), CHUNK))
    ]
    components = waveform.measured_sensor.shape[1]
    none = [np.zeros((0, len(f), components), dtype=complex) for f in (frequencies_hz, beside_hz)]
    phasor = np.concatenate([none[0], *(one for one, _ in found)])
    beside = np.concatenate([none[1], *(other for _, other in found)])
    alive = np.any(phasor != 0.0, axis=(1, 2))
    return Pieces(centre, length, phasor, beside).rows(alive)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """The fit of pieces, some at once."""

    waveform: Waveform
    frequencies_hz: Array
    beside_hz: Array
    length: float
    hum: Hum | None

    def of(
        self, centre: Array, first: IntArray, held: IntArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the phasors of tones, and of probes, shape (n, tones or probes, components)."""
        reach, time = np.arange(int(np.max(held))), self.waveform.time
        index = np.minimum(first[:, None] + reach, len(time) - 1)
        elapsed, field = time[index] - centre[:, None], self.waveform.measured_sensor[index]
        inside = reach < held[:, None]
        taper = np.where(inside, np.cos(np.pi * elapsed / self.length) ** 2, 0.0)
        design = _design(elapsed, time[index], self.frequencies_hz, self.length, self.hum)
        fitted = _solved(design, taper, field)
        for _ in range(CUT_TWICE):
            bang = _bangs(field - design @ fitted, inside)
            if not np.any(bang):
                break
            taper = np.where(bang, 0.0, taper)
            fitted = _solved(design, taper, field)
        n = len(self.frequencies_hz)
        phasor = fitted[:, 2 : 2 + n] - 1j * fitted[:, 2 + n : 2 + 2 * n]
        turns = np.exp(-2j * np.pi * self.frequencies_hz * centre[:, None])
        if not len(self.beside_hz):
            return phasor * turns[..., None], np.zeros((len(centre), 0, field.shape[2]), complex)
        left = (field - design @ fitted) * (taper * 2.0 / np.sum(taper, axis=1)[:, None])[..., None]
        carrier = np.exp(-2j * np.pi * elapsed[..., None] * self.beside_hz)
        return phasor * turns[..., None], np.swapaxes(carrier, 1, 2) @ left


def _solved(design: Array, taper: Array, field: Array) -> Array:
    weighted = np.swapaxes(design * taper[..., None], 1, 2)
    return np.asarray(np.linalg.solve(weighted @ design, weighted @ field))


def _bangs(left: Array, inside: BoolArray) -> BoolArray:
    """Return samples of the sensor that stand out of what a fit leaves of a piece, (n, m).

    Where they are many they are no bangs.  Those of a reference are left to the weights of pieces:
    it is not to change what the sensor tells alone.
    """
    size = np.linalg.norm(left[..., :3], axis=2)
    usual = np.nanmedian(np.where(inside, size, np.nan), axis=1)
    found = inside & (size > STANDS_OUT * usual[:, None])
    few = np.sum(found, axis=1) < MOST_BANGS * np.sum(inside, axis=1)
    return np.asarray(found & few[:, None])


def _design(
    elapsed: Array, time: Array, frequencies_hz: Array, length: float, hum: Hum | None
) -> Array:
    """Return columns: constant, ramp, cosines and sines of tones, bends, hum and its ramps.

    Shape (n, m, columns).
    """
    ramp = elapsed[..., None] * (2.0 / length)
    angle = 2.0 * np.pi * elapsed[..., None] * frequencies_hz
    # Steel that passes bends the steady field.
    columns = [np.ones_like(ramp), ramp, np.cos(angle), np.sin(angle), ramp**2, ramp**3]
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
