"""Integration of the pieces of a stationary interval to one phasor per tone, with covariance.

The noise about a tone is measured in the spectrum of the weighted pieces, a few resolutions of the
whole interval away.  It need not be white; power rising towards the tone, such as the tone's own
phase wander, counts as noise.  Outlying pieces (Huber) and noisy stretches get smaller weights.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import chdtrc, chdtri, fdtrc, gammaln

from magfusion.receiver.pieces import Pieces
from magfusion.units import Array, ComplexArray

NEAREST, MAX_NEIGHBOURS = 2, 12  # resolutions: the first whose power is noise; how many
MIN_NEIGHBOURS = 3
FARTHEST = 0.4  # of the inverse length of a piece, at which its taper still has gain
MIN_LENGTHS = (NEAREST + MIN_NEIGHBOURS) / FARTHEST  # of a piece, in a stationary interval
LEVEL = 31  # pieces over which the noise level is estimated
HUBER = 2.0  # times the noise level, beyond which a piece is down-weighted
ROUNDS = 3
PER_RESOLUTION = 4  # trial frequencies


@dataclass(frozen=True, eq=False)
class Integrated:
    """One tone of a whole stationary interval."""

    phasor: ComplexArray  # (3,) (T)
    cov: Array  # (3, 3), of its real, and of its imaginary part (T^2)
    freedom: int  # degrees of freedom of the covariance
    # centroid, spread: of the weights over time (s)
    centroid: float
    spread: float

    @property
    def chance(self) -> float:
        """Return the probability of such power by noise alone (Lawley-Hotelling trace)."""
        white = np.linalg.solve(np.linalg.cholesky(self._sample_cov()), self.phasor)
        return trace_chance(float(np.sum(np.abs(white) ** 2)), self.freedom)

    def _sample_cov(self) -> Array:
        least = 1e-12 * np.trace(self.cov) + 1e-60  # of a constant axis
        return (self.cov + least * np.eye(3)) * (self.freedom - 4.0) / self.freedom


def trace_chance(trace: float, freedom: int) -> float:
    """Return the probability of a larger Lawley-Hotelling trace of two vectors of three.

    McKeon's approximation by F, with the moments of the trace. `freedom`: of the covariance; more
    than five.
    """
    p, q = 3, 2
    half = 0.5 * (freedom - p - 1)
    b = (p + 2 * half) * (q + 2 * half) / (2 * (2 * half + 1) * (half - 1))
    second = 4.0 + (p * q + 2) / (b - 1)
    c = (2.0 + (p * q + 2) / (b - 1)) / (2 * half)
    return float(fdtrc(p * q, second, trace / freedom / c * second / (p * q)))


def integrated(result: Pieces, tone: int, time: float) -> Integrated:
    """Return one tone of a stationary interval, integrated over its pieces.

    `time`: reference time of centroid and spread (s).
    """
    phasor, elapsed = result.phasor[:, tone], result.centre - time
    there = np.isfinite(phasor).all(axis=1)
    phasor, elapsed = phasor[there], elapsed[there]
    weight = _weights(phasor)
    mean = np.asarray(weight @ phasor)
    span = float(np.ptp(elapsed)) + result.length
    maximum = int(FARTHEST * span / result.length) - NEAREST
    others = NEAREST + np.arange(int(np.clip(maximum, MIN_NEIGHBOURS, MAX_NEIGHBOURS)))
    offsets_hz = np.concatenate([-others, others]) / span
    bins = offsets_hz * result.length
    detected = np.sinc(bins) / (1.0 - bins**2)  # gain of a Hann taper
    carrier = np.exp(-2j * np.pi * offsets_hz[:, None] * elapsed)
    power = ((carrier * weight) @ (phasor - mean)) / detected[:, None]
    freedom = 2 * len(offsets_hz)
    sample = np.real(power.T @ np.conj(power)) / freedom
    # The sample covariance is biased for few readings; its inverse is corrected.
    cov = sample * freedom / (freedom - 4.0)
    centroid = float(weight @ elapsed)
    spread = float(np.sqrt(weight @ (elapsed - centroid) ** 2))
    return Integrated(mean, cov, freedom, centroid, spread)


def _weights(phasor: ComplexArray) -> Array:
    """Return the weights of pieces, with sum one, shape (n,)."""
    centre = np.median(phasor.real, axis=0) + 1j * np.median(phasor.imag, axis=0)
    weight = np.ones(len(phasor))
    for _ in range(ROUNDS):
        off = np.sum(np.abs(phasor - centre) ** 2, axis=1)
        usual = float(np.median(off))
        level = np.maximum(median_filter(off, LEVEL, mode="nearest"), 1e-3 * usual + 1e-300)
        weight = np.minimum(1.0, HUBER * np.sqrt(level / np.maximum(off, 1e-300))) / level
        weight /= np.sum(weight)
        centre = weight @ phasor
    return np.asarray(weight)


@dataclass(frozen=True)
class FrequencySearch:
    """Result of a search for the frequency of a beacon.

    `drift`: relative error of its clock. `trials`: searched range (Hz), times the RMS slope of a
    component with frequency.
    """

    drift: float
    trials: float


def searched(
    result: Pieces, tones: list[int], frequencies_hz: Array, largest: float
) -> FrequencySearch:
    """Return the relative clock error that maximises the power of tones.

    `frequencies_hz` (tones,): demodulation frequencies of all tones. `largest`: largest relative
    error searched, on either side.
    """
    there = np.isfinite(result.phasor[:, tones]).all(axis=(1, 2))
    centre = result.centre[there]
    half = float(np.ptp(centre)) + result.length
    elapsed = centre - np.mean(centre)
    highest = float(np.max(frequencies_hz[tones]))
    own = []
    for tone in tones:
        phasor = result.phasor[there, tone]
        weight = _weights(phasor)
        noise = float(np.median(np.sum(np.abs(phasor) ** 2, axis=1)))
        own.append(weight[:, None] * phasor / np.sqrt(noise))
    fine = 1.0 / (PER_RESOLUTION * half * highest)
    drifts = np.linspace(-largest, largest, 2 * int(np.ceil(largest / fine)) + 1)
    best = float(drifts[np.argmax(_loudness(own, tones, frequencies_hz, elapsed, drifts))])
    for finer in (fine / 4.0, fine / 32.0):
        # Trials beyond the range are not counted.
        near = np.clip(best + finer * np.arange(-6.0, 7.0), -largest, largest)
        best = float(near[np.argmax(_loudness(own, tones, frequencies_hz, elapsed, near))])
    slope = float(np.pi * half / np.sqrt(3.0))
    return FrequencySearch(best, 2.0 * largest * highest * slope)


def _loudness(
    own: list[ComplexArray], tones: list[int], frequencies_hz: Array, elapsed: Array, drifts: Array
) -> Array:
    total = np.zeros(len(drifts))
    for begin in range(0, len(drifts), 256):
        rows = slice(begin, begin + 256)
        for tone, phasor in zip(tones, own, strict=True):
            turns = frequencies_hz[tone] * drifts[rows, None] * elapsed
            total[rows] += np.sum(np.abs(np.exp(-2j * np.pi * turns) @ phasor) ** 2, axis=1)
    return total


def chance_of_any(chances: list[float], trials: float) -> float:
    """Return the probability of such power by noise alone at any searched frequency.

    Davies' bound on the maximum of a chi-square process. `chances`: of each tone of a beacon, at
    its frequency. `trials`: as of `FrequencySearch`.
    """
    square = float(sum(chdtri(6, max(c, 1e-300)) for c in chances))
    degrees = 6 * len(chances)
    size = 0.5 * (degrees - 1) * np.log(0.5 * square) - 0.5 * square - gammaln(0.5 * degrees)
    crossings = trials / np.sqrt(np.pi) * np.exp(size)
    return float(min(1.0, chdtrc(degrees, square) + crossings))
