"""Samples lost in an even stream, by the tones: the phases of all step as by one delay.

The complex amplitudes of the tones on both sides of a step are one smooth motion (a Gaussian
process) when the right number of lost samples is put between them.  Tones alone determine it up to
the period that is common to them, 0.1 s of tones that are multiples of 10 Hz; the motion does the
rest.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array, ComplexArray

MAX_DURATION = 0.25  # s; of a slip
SIDE = 0.15  # s; of the amplitudes that are compared on each side
INDEPENDENT = 1.0 / 120.0  # s; between amplitudes in bands of 120 Hz
GRID = 4e-3  # s; within which the covariance of the amplitudes changes little
CORRELATIONS = (0.15, 0.3, 0.6, 60.0)  # s; of a hand, walks, and a rest
CHANGING = 0.3  # part of an amplitude that the motion changes, within some correlation times
ROUGH = 1e-3  # part of an amplitude by which it is not smooth
MIN_SNR = 5.0  # of an amplitude in a band
LIKELIHOOD_RATIO = 12.0  # log of the likelihood ratio
SWITCHED = -20.0  # log of the prior odds that a tone steps alone
NEAR = 2  # samples
MAX_LISTED = 4  # lengths
DEGREE = 7  # of the smooth amplitudes over both sides
POOR = 0.1  # part of the amplitudes that the best length leaves unexplained


@dataclass(frozen=True)
class Slip:
    """Samples that an even stream lacks."""

    place: int  # number of the first sample after it, as counted in the stream
    missing: int  # number of the missing samples
    others: tuple[int, ...] = ()  # numbers that explain the phases nearly as well


def log_likelihoods(
    before: tuple[Array, ComplexArray],
    after: tuple[Array, ComplexArray],
    noise: Array,
    tones_hz: Array,
    rate_hz: float,
) -> Array:
    """Return the log-likelihood of each number of lost samples, from zero to the largest.

    `before`, `after` (n,), (n, tones, columns): number of the sample, and amplitudes that are
    referred to it by the tones' phases. `noise` (tones,): standard deviation of each real part of
    an amplitude. `tones_hz` (tones,).
    """
    lengths = np.arange(round(MAX_DURATION * rate_hz) + 1)
    step = max(round(GRID * rate_hz), 1)
    grid = np.arange(0, lengths[-1] + step, step)
    split, columns = len(before[0]), before[1].shape[2]
    place = np.broadcast_to(np.r_[before[0], after[0]], (len(grid), split + len(after[0]))).copy()
    place[:, split:] += grid[:, None]
    elapsed = (place[:, :, None] - place[:, None, :]) / rate_hz
    results = np.zeros((len(CORRELATIONS), len(lengths)))
    for result, correlation in zip(results, CORRELATIONS, strict=True):
        smooth = 1.0 + CHANGING**2 * np.exp(-0.5 * (elapsed / correlation) ** 2)
        for k, tone_hz in enumerate(tones_hz):
            y = np.concatenate([before[1][:, k], after[1][:, k]])
            size = float(np.mean(np.abs(y) ** 2))
            own = 2.0 * noise[k] ** 2 + ROUGH**2 * size
            inverse = np.linalg.inv(size * smooth + own * np.eye(len(y)))
            part = y[:split], y[split:]
            alone = sum(
                np.einsum("ic,gij,jc->g", p.conj(), inverse[:, rows, rows], p).real
                for p, rows in zip(part, (slice(split), slice(split, None)), strict=True)
            )
            both = np.einsum("ic,gij,jc->g", part[0].conj(), inverse[:, :split, split:], part[1])
            fixed = columns * np.linalg.slogdet(inverse)[1] - alone
            turn = np.exp(-2j * np.pi * tone_hz * lengths / rate_hz)
            both_at = np.interp(lengths, grid, both.real) + 1j * np.interp(lengths, grid, both.imag)
            joint = np.interp(lengths, grid, fixed) - 2.0 * np.real(turn * both_at)
            # A beacon may have been switched or moved: both sides alone.
            cov = size * smooth[0] + own * np.eye(len(y))
            separate = SWITCHED + sum(
                _log_density(p, cov[rows, rows])
                for p, rows in zip(part, (slice(split), slice(split, None)), strict=True)
            )
            result += np.logaddexp(joint, separate)
    return np.asarray(np.logaddexp.reduce(results))


def _log_density(amplitude: ComplexArray, cov: Array) -> float:
    """Return the log-density of amplitudes (n, columns), less a constant."""
    square = np.sum(amplitude.conj() * np.linalg.solve(cov, amplitude)).real
    return float(-square - amplitude.shape[1] * np.linalg.slogdet(cov)[1])


def choose_length(likelihoods: Array) -> tuple[int, tuple[int, ...]]:
    """Return the most probable number of lost samples, and others that are not much less so."""
    likelihoods = likelihoods.copy()
    best = int(np.argmax(likelihoods))
    result: list[int] = []
    largest = likelihoods[best]
    while len(result) < MAX_LISTED:
        at = int(np.argmax(likelihoods))
        if likelihoods[at] < largest - LIKELIHOOD_RATIO:
            break
        result.append(at)
        likelihoods[max(at - NEAR, 0) : at + NEAR + 1] = -np.inf
    return best, tuple(result[1:])


def locate_slip(
    samples: Array,
    first: int,
    missing: int,
    place: Array,
    amplitude: ComplexArray,
    tones_hz: Array,
    rate_hz: float,
) -> tuple[int, float]:
    """Return the first sample after a slip, and the part of amplitudes that is not smooth.

    Parameters
    ----------
    samples : ndarray, shape (n, columns)
        Of the recording, among which it is.
    first : int
        Number of the first of them.
    missing : int
        Number of the missing samples.
    place : ndarray, shape (m,)
        Numbers on the true clock of the amplitudes on both sides.
    amplitude : complex ndarray, shape (m, tones, columns)
        Referred to the true clock.
    """
    middle = 0.5 * (place[0] + place[-1])
    unit = 0.5 * (place[-1] - place[0])
    flat = amplitude.reshape(len(place), -1)
    basis = np.vander((place - middle) / unit, DEGREE + 1)
    fitted = np.linalg.lstsq(basis, flat)[0]
    poor = np.linalg.norm(flat - basis @ fitted) / np.linalg.norm(flat)
    number = first + np.arange(len(samples), dtype=float)

    def expected(true: Array) -> Array:
        turn = np.exp(2j * np.pi * true[:, None] * tones_hz / rate_hz)
        smooth = np.vander((true - middle) / unit, DEGREE + 1) @ fitted
        return np.real(
            np.einsum("nt,ntc->nc", turn, smooth.reshape(len(true), *amplitude.shape[1:]))
        )

    off = [np.sum((samples - expected(true)) ** 2, axis=1) for true in (number, number + missing)]
    cost = np.concatenate([[0.0], np.cumsum(off[0] - off[1])])
    return first + int(np.argmin(cost)), float(poor)
