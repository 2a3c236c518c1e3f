"""Noise cancellation with a second, reference magnetometer.

The noise that both magnetometers receive from storms, mains and machines is related by a complex
3 x 3 matrix about each tone.  It is estimated by least squares from pieces near the tones, which
contain no signal, and validated on pieces not used for the estimate.  A reference that does not
reduce the noise is not used, and the result is unchanged.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from magfusion.model.samples import Waveform
from magfusion.receiver.pieces import Pieces
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

MAX_LAG = 5.0  # s; of the reference's clock
BLOCK = 40.96  # s; in which lag and rate of the clock are estimated
CLEAR_HZ = 0.6  # excluded about tones and mains, which correlate at any lag of whole turns
MIN_PEAK = 8.0  # times the scatter of the correlation, for a lag
FINER = 8  # lags in a sampling step
NEAR_LAG = 8  # samples about the common lag, in which blocks find their own
PROBES = 8  # probes about a tone
PROBE_SPACING = 2.0  # resolutions of a piece, between them and from every tone
GROUPS = 8  # of successive pieces, every other one used for the estimate
WORTH = 0.95  # residual power, beyond which a reference is not used
MEMORY = 0.7  # weight of earlier pieces in each later stretch of a stream
GAP = 2.5  # steps of the reference, over which it is not interpolated


@dataclass(frozen=True)
class Lag:
    """Clock error of a reference: an event stamped t is at t + offset + rate t (s)."""

    offset: float
    rate: float

    def of(self, time: Array) -> Array:
        """Convert times to the clock of the log (s)."""
        return np.asarray(time + self.offset + self.rate * time)


NO_LAG = Lag(0.0, 0.0)


def reference_at(waveform: Waveform, reference: Waveform, lag: Lag) -> tuple[Array, BoolArray]:
    """Interpolate a reference to the samples of a waveform (n, 3), and return where it is valid."""
    time = lag.of(reference.time)
    step = float(np.median(np.diff(time)))
    at = np.clip(np.searchsorted(time, waveform.time), 1, len(time) - 1)
    there = (time[at] - time[at - 1] < GAP * step) & (waveform.time >= time[0] - step)
    there &= waveform.time <= time[-1] + step
    field = reference.measured_sensor - np.mean(reference.measured_sensor, axis=0)
    inside = np.clip(waveform.time, time[0], time[-1])
    return np.asarray(CubicSpline(time, field)(inside)), np.asarray(there)


def lag_of(waveform: Waveform, reference: Waveform, lines_hz: Array) -> Lag:
    """Estimate the clock error of a reference from the common noise; zero if there is none.

    `lines_hz`: tones and mains (Hz), which are excluded.
    """
    common = common_noise(waveform, reference, lines_hz)
    if common is None:
        return NO_LAG
    result, starts, mean, best, lags = common
    step = float(np.median(np.diff(waveform.time))) / FINER
    first = max(best - NEAR_LAG * FINER, 0)
    own = result[:, first : best + NEAR_LAG * FINER + 1]
    near = lags[first : first + own.shape[1]]
    peak = np.clip(np.argmax(own, axis=1), 1, own.shape[1] - 2)
    clear = own[np.arange(len(own)), peak] > np.median(mean) + MIN_PEAK * _scatter(mean)
    middle = waveform.time[starts] + 0.5 * BLOCK
    if np.sum(clear) < 3:
        return Lag(float(lags[best]) * step, 0.0)
    rows = np.flatnonzero(clear)
    before, here, after = (own[rows, peak[rows] + k] for k in (-1, 0, 1))
    finer = 0.5 * (before - after) / np.minimum(before - 2.0 * here + after, -1e-12)
    seen = (near[peak[rows]] + np.clip(finer, -0.5, 0.5)) * step
    rate, offset = np.polyfit(middle[rows], seen, 1)
    # Lags that do not lie on a line are better described by their median.
    residual = seen - offset - rate * middle[rows]
    rough = np.std(residual) / (np.std(middle[rows]) * np.sqrt(len(rows)) + 1e-300)
    if abs(rate) < 3.0 * rough:
        return Lag(float(np.median(seen)), 0.0)
    return Lag(float(offset), float(rate))


def common_noise(
    waveform: Waveform, reference: Waveform, lines_hz: Array
) -> tuple[Array, IntArray, Array, int, IntArray] | None:
    """Correlate the noise of a sensor and a reference in stretches; None without a peak.

    Lags are finer than a step: the peak of whitened noise is as narrow as a step. Returns
    `power` (n, lags): of the correlation of each stretch; `starts` (n,): first samples of the
    stretches; `mean` (lags,): of the powers; `best`: where its peak is; `lags` (lags,): in steps
    over `FINER`.
    """
    step = float(np.median(np.diff(waveform.time)))
    size = int(BLOCK / step) // 2 * 2
    starts = np.arange(0, len(waveform) - size + 1, size)
    other, there = reference_at(waveform, reference, NO_LAG)
    if not len(starts) or not np.any(there):
        return None
    reach = int(MAX_LAG / step) * FINER
    lags = np.arange(-reach, reach + 1)
    pairs = ((waveform.measured_sensor[k : k + size], other[k : k + size]) for k in starts)
    power = np.stack([_correlation(*pair, step, lines_hz)[lags] for pair in pairs])
    mean = np.mean(power, axis=0)
    best = int(np.argmax(mean))
    if mean[best] - np.median(mean) < MIN_PEAK * _scatter(mean):
        return None
    return power, starts, mean, best, lags


def _scatter(values: Array) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) + 1e-300


def _correlation(own: Array, other: Array, step: float, lines_hz: Array) -> Array:
    """Return the power of the whitened correlation at each lag, of all pairs of axes."""
    taper = np.hanning(len(own))[:, None]
    hertz = np.fft.rfftfreq(len(own), step)
    clear = hertz > CLEAR_HZ
    for line in lines_hz:
        clear &= np.abs(hertz - line) > CLEAR_HZ
    spectra = []
    for field in (own, other):
        result = np.fft.rfft((field - np.mean(field, axis=0)) * taper, axis=0)
        spectra.append(result / np.maximum(np.abs(result), 1e-300) * clear[:, None])
    total = np.zeros(FINER * len(own))
    for a in spectra[0].T:
        for b in spectra[1].T:
            total += np.fft.irfft(a * np.conj(b), len(total)) ** 2
    return total


def probes_hz(tone_hz: float, tones_hz: Array, length: float, highest_hz: float) -> Array:
    """Return the frequencies near a tone used to estimate the matrix, clear of every tone."""
    offsets = (PROBE_SPACING / length) * np.arange(1, 4 * PROBES)
    tried = np.concatenate([tone_hz + offsets, tone_hz - offsets])
    separate = np.min(np.abs(tried[:, None] - tones_hz), axis=1)
    good = tried[
        (separate > 0.99 * PROBE_SPACING / length)
        & (tried > PROBE_SPACING / length)
        & (tried < highest_hz)
    ]
    return np.asarray(good[np.argsort(np.abs(good - tone_hz))][:PROBES])


@dataclass(frozen=True, eq=False)
class ReferenceNormalEquations:
    """Normal equations of the matrix between the noise of a sensor and a reference.

    `other`, `both` (3, 3): sums of the products of the reference, and of those with the sensor.
    """

    other: ComplexArray
    both: ComplexArray

    @staticmethod
    def of(own: ComplexArray, other: ComplexArray, weight: Array) -> "ReferenceNormalEquations":
        """Compute them from pieces (n, probes, 3) with a weight each (n,)."""
        weighted = np.conj(other) * weight[:, None, None]
        return ReferenceNormalEquations(
            np.einsum("npi,npj->ij", weighted, other), np.einsum("npi,npj->ij", weighted, own)
        )

    def later(self, turn: float) -> "ReferenceNormalEquations":
        """Return their contribution to later pieces, after a clock correction by ``turn``.

        `turn`: decrease of the reference's phase (rad).
        """
        return ReferenceNormalEquations(MEMORY * self.other, MEMORY * np.exp(1j * turn) * self.both)

    def plus(self, more: "ReferenceNormalEquations | None") -> "ReferenceNormalEquations":
        """Return the sums of both."""
        if more is None:
            return self
        return ReferenceNormalEquations(self.other + more.other, self.both + more.both)

    def solved(self) -> ComplexArray:
        """Return the matrix."""
        normal = self.other + 1e-9 * np.trace(self.other).real * np.eye(3) + 1e-300 * np.eye(3)
        return np.asarray(np.linalg.solve(normal, self.both).T)


@dataclass(frozen=True, eq=False)
class Relation:
    """Relation of the noise of a sensor to that of a reference, about a tone."""

    matrix: ComplexArray  # (3, 3)
    # ratio of the noise power with and without it, in pieces not used for the estimate
    remaining_share: float
    normal: ReferenceNormalEquations  # its normal equations, propagated to later pieces

    @property
    def is_effective(self) -> bool:
        """Whether it reduces the noise."""
        return self.remaining_share < WORTH


def relation(
    result: Pieces, there: BoolArray, columns: slice, before: ReferenceNormalEquations | None = None
) -> Relation:
    """Estimate the relation of a sensor and its reference in the probes near a tone.

    Parameters
    ----------
    result : Pieces
        Of six components: the sensor's, and the reference's.
    there : bool ndarray, shape (n,)
        Pieces with a reference.
    columns : slice
        Probes of the tone.
    before : ReferenceNormalEquations, optional
        Of earlier pieces.
    """
    own, other = result.extra_lines[:, columns, :3], result.extra_lines[:, columns, 3:]
    power = np.sum(np.abs(own) ** 2, axis=(1, 2))
    monitor = np.sum(np.abs(other) ** 2, axis=(1, 2))
    usual = max(float(np.median(power)), 1e-300), max(float(np.median(monitor)), 1e-300)
    # Noisy pieces are down-weighted: an impact at one sensor is not received by the other.
    weight = there / (1.0 + power / usual[0] + monitor / usual[1])
    group = np.arange(len(own)) * GROUPS // max(len(own), 1) % 2
    residual = power_before = 0.0
    for half in (0, 1):
        matrix = (
            ReferenceNormalEquations.of(own, other, weight * (group != half)).plus(before).solved()
        )
        mine = (weight * (group == half))[:, None, None]
        power_before += float(np.sum(mine * np.abs(own) ** 2))
        residual += float(np.sum(mine * np.abs(own - other @ matrix.T) ** 2))
    normal = ReferenceNormalEquations.of(own, other, weight).plus(before)
    return Relation(normal.solved(), residual / max(power_before, 1e-300), normal)
