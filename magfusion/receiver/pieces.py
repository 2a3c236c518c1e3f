"""Tones of a stationary sensor in pieces of a few seconds, for the integration of long records.

Samples are not rotated by the gyro, whose noise would couple in through the Earth's field.  Each
piece is fitted under a Hann taper, so that distant frequencies do not leak into a tone.  Pieces
overlap by half, so that their mean uses the whole record.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.model.samples import Waveform
from magfusion.receiver.hum import Hum
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

CHUNK = 64  # pieces at once
MIN_SHARE = 0.9  # of the samples of a piece
OUTLIER_RATIO = 4.5  # times the median residual; exceeded by noise once in 10^10
MAX_OUTLIER_SHARE, CUT_TWICE = 0.25, 2  # of the samples of a piece; how often they are rejected
NO_PROBES = np.zeros(0)
HUM_CLEAR = 2.0  # resolutions of a piece between a tone and a fitted harmonic


@dataclass(frozen=True, eq=False)
class Pieces:
    """Phasors of pieces, each referred to its demodulation frequency."""

    centre: Array  # (n,) (s)
    length: float  # (s)
    # (n, tones, components) (T), the axes of the sensor; their phase is that of a cosine at time
    # zero of the log
    phasor: ComplexArray
    extra_lines: ComplexArray  # (n, probes, components), residual phasors at other frequencies

    def rows(self, kept: BoolArray) -> "Pieces":
        """Return a subset of the pieces."""
        return Pieces(self.centre[kept], self.length, self.phasor[kept], self.extra_lines[kept])


def pieces(
    waveform: Waveform,
    span: tuple[float, float],
    frequencies_hz: Array,
    length: float,
    hum: Hum | None = None,
    extra_lines_hz: Array = NO_PROBES,
) -> Pieces:
    """Return the phasors of pieces of a stationary waveform.

    Parameters
    ----------
    span : tuple of float
        Begin and end of the stationary interval (s).
    frequencies_hz : ndarray, shape (tones,)
        Transmitted frequencies.
    length : float
        Length of a piece (s).
    hum : Hum, optional
        Its harmonics are fitted with the tones.
    extra_lines_hz : ndarray, shape (probes,)
        Other frequencies at which the residual is evaluated.
    """
    time = waveform.time
    step = float(np.median(np.diff(time)))
    count = int((span[1] - span[0] + step) / (0.5 * length)) - 1
    centre = np.asarray(span[0] - 0.5 * step + 0.5 * length * np.arange(1.0, count + 1.0))
    first = np.searchsorted(time, centre - 0.5 * length)
    fixed = np.searchsorted(time, centre + 0.5 * length) - first
    whole = fixed * step >= MIN_SHARE * length
    centre, first, fixed = centre[whole], first[whole], fixed[whole]
    result = [
        _fitted(
            waveform, frequencies_hz, extra_lines_hz, length, hum, (centre[k], first[k], fixed[k])
        )
        for k in (slice(i, i + CHUNK) for i in range(0, len(centre), CHUNK))
    ]
    components = waveform.measured_sensor.shape[1]
    none = [
        np.zeros((0, len(f), components), dtype=complex) for f in (frequencies_hz, extra_lines_hz)
    ]
    phasor = np.concatenate([none[0], *(one for one, _ in result)])
    others = np.concatenate([none[1], *(other for _, other in result)])
    alive = np.any(phasor != 0.0, axis=(1, 2))
    return Pieces(centre, length, phasor, others).rows(alive)


def _fitted(
    waveform: Waveform,
    frequencies_hz: Array,
    extra_lines_hz: Array,
    length: float,
    hum: Hum | None,
    span: tuple[Array, IntArray, IntArray],
) -> tuple[ComplexArray, ComplexArray]:
    """Return the phasors of tones and of probes, shape (n, tones or probes, components).

    ``span`` has the centre of each piece (s), its first sample and their number, each (n,).
    """
    centre, first, count = span
    reach, time = np.arange(int(np.max(count))), waveform.time
    index = np.minimum(first[:, None] + reach, len(time) - 1)
    elapsed, field = time[index] - centre[:, None], waveform.measured_sensor[index]
    inside = reach < count[:, None]
    taper = np.where(inside, np.cos(np.pi * elapsed / length) ** 2, 0.0)
    design = _design(elapsed, time[index], frequencies_hz, length, hum)
    fitted = _solved(design, taper, field)
    for _ in range(CUT_TWICE):
        impact = _outliers(field - design @ fitted, inside)
        if not np.any(impact):
            break
        taper = np.where(impact, 0.0, taper)
        fitted = _solved(design, taper, field)
    n = len(frequencies_hz)
    phasor = fitted[:, 2 : 2 + n] - 1j * fitted[:, 2 + n : 2 + 2 * n]
    turns = np.exp(-2j * np.pi * frequencies_hz * centre[:, None])
    if not len(extra_lines_hz):
        return phasor * turns[..., None], np.zeros((len(centre), 0, field.shape[2]), complex)
    residual = (field - design @ fitted) * (taper * 2.0 / np.sum(taper, axis=1)[:, None])[..., None]
    carrier = np.exp(-2j * np.pi * elapsed[..., None] * extra_lines_hz)
    return phasor * turns[..., None], np.swapaxes(carrier, 1, 2) @ residual


def _solved(design: Array, taper: Array, field: Array) -> Array:
    weighted = np.swapaxes(design * taper[..., None], 1, 2)
    return np.asarray(np.linalg.solve(weighted @ design, weighted @ field))


def _outliers(residual: Array, inside: BoolArray) -> BoolArray:
    """Return outliers of the sensor in the residual of a piece, shape (n, m).

    Where they are many, none is rejected.  Outliers of a reference only affect the weights of
    pieces, so that it does not change the sensor's own result.
    """
    size = np.linalg.norm(residual[..., :3], axis=2)
    usual = np.nanmedian(np.where(inside, size, np.nan), axis=1)
    result = inside & (size > OUTLIER_RATIO * usual[:, None])
    few = np.sum(result, axis=1) < MAX_OUTLIER_SHARE * np.sum(inside, axis=1)
    return np.asarray(result & few[:, None])


def _design(
    elapsed: Array, time: Array, frequencies_hz: Array, length: float, hum: Hum | None
) -> Array:
    """Return columns: constant, ramp, tones, curvature, hum and its ramps.

    Shape (n, m, columns).
    """
    ramp = elapsed[..., None] * (2.0 / length)
    angle = 2.0 * np.pi * elapsed[..., None] * frequencies_hz
    # Moving steel makes the static field curve.
    columns = [np.ones_like(ramp), ramp, np.cos(angle), np.sin(angle), ramp**2, ramp**3]
    if hum is not None:
        orders = hum.orders[_clear(hum, frequencies_hz, length)]
        angle = hum.angle(time)[..., None] * orders
        wave = np.concatenate([np.cos(angle), np.sin(angle)], axis=-1)
        columns += [wave, ramp * wave]
    return np.concatenate(columns, axis=-1)


def _clear(hum: Hum, frequencies_hz: Array, length: float) -> BoolArray:
    """Return which harmonics a piece separates from every tone."""
    off = np.abs(hum.orders[:, None] * hum.frequency_hz - frequencies_hz)
    return np.asarray(np.min(off, axis=1, initial=np.inf) * length > HUM_CLEAR)
