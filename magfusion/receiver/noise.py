"""The noise that a window holds, measured beside the tones rather than taken from a data sheet."""

from typing import NamedTuple

import numpy as np

from magfusion.units import Array, BoolArray

LEFT = 1e-6  # of what probes are, from which what the design left of them counts
LEAST_SHARE = 0.1  # of the declared noise; held and coarse samples may show none
LEAST_NOISE = 1e-18  # T; rounding of the Earth's field


class FittedWindows(NamedTuple):
    """A design fitted to the samples of n windows, padded to m samples each.

    Parameters
    ----------
    elapsed : ndarray, shape (n, m)
        Sample times from the centre of the window (s).
    weight : bool ndarray, shape (n, m)
        False where a row is padding.
    design : ndarray, shape (n, m, k)
    inverse : ndarray, shape (n, k, k)
        Inverse of its normal matrix.
    field : ndarray, shape (n, m, 3)
        Samples in axes that stand still (T).
    coefficients : ndarray, shape (n, k, 3)
        (T)
    """

    elapsed: Array
    weight: BoolArray
    design: Array
    inverse: Array
    field: Array
    coefficients: Array


def _probe_frequencies(
    tone: int, frequencies_hz: Array, nuisance_hz: Array, window: float
) -> Array:
    """Two probes half-way to the neighbours of a tone, clear of every fitted line."""
    lines = np.concatenate([[0.0], frequencies_hz, nuisance_hz])
    apart = np.abs(lines - frequencies_hz[tone])
    nearest = float(np.min(apart[apart > 0]))
    shift = min(0.5 * nearest, 2.0 / window)
    return frequencies_hz[tone] + shift * np.array([-1.0, 1.0])


def noise_beside_tones(frequencies_hz: Array, nuisance_hz: Array, fit: FittedWindows) -> Array:
    """Return the covariance per sample of the noise around each tone, in the axes of the fit.

    Probe tones are fitted to what the design leaves of the window; the power in them, divided by
    what the design left of the probes themselves, is unbiased for white noise.  A short window
    leaves fewer directions than there are axes: what it says nothing of is taken for as noisy.

    Parameters
    ----------
    frequencies_hz, nuisance_hz : ndarray
        Lines in the design (Hz).

    Returns
    -------
    ndarray, shape (n, tones, 3, 3)
        (T^2)
    """
    window = float(np.max(fit.elapsed) - np.min(fit.elapsed))
    projected = np.swapaxes(fit.design, -1, -2)
    noise = np.empty((len(fit.elapsed), len(frequencies_hz), 3, 3))
    for tone in range(len(frequencies_hz)):
        probes = _probe_frequencies(tone, frequencies_hz, nuisance_hz, window)
        angle = 2.0 * np.pi * fit.elapsed[..., None] * probes
        probe = np.concatenate([np.cos(angle), np.sin(angle)], axis=-1) * fit.weight[..., None]
        mixed = projected @ probe
        across, removed = np.swapaxes(probe, -1, -2), np.swapaxes(mixed, -1, -2)
        left = across @ probe - removed @ fit.inverse @ mixed
        power = across @ fit.field - removed @ fit.coefficients
        value, vector = np.linalg.eigh(left)
        told = value > LEFT * np.trace(across @ probe, axis1=-2, axis2=-1)[:, None]
        seen = (
            np.swapaxes(vector, -1, -2) @ power / np.sqrt(np.where(told, value, np.inf))[..., None]
        )
        degrees = np.maximum(np.sum(told, axis=-1), 1)[:, None, None]
        own = np.swapaxes(seen, -1, -2) @ seen / degrees
        unseen = (1.0 - degrees / probe.shape[-1]) * np.trace(own, axis1=-2, axis2=-1)[
            :, None, None
        ]
        noise[:, tone] = own + unseen / 3.0 * np.eye(3)
    return noise


def not_below(noise_cov: Array, sigma: float) -> Array:
    """Return noise of which no direction has less than a share of the declared (T), shape as given.

    Held and coarsely quantised samples may be the same all through a window.
    """
    least = max(LEAST_SHARE * sigma, LEAST_NOISE) ** 2
    value, vector = np.linalg.eigh(noise_cov)
    low = value[..., 0] < least
    if not np.any(low):
        return noise_cov
    value = np.maximum(value, least)
    raised = vector * value[..., None, :] @ np.swapaxes(vector, -1, -2)
    return np.where(low[..., None, None], raised, noise_cov)


def smoothed_over_windows(
    noise_cov: Array, centre: Array, step: float, windows: int, unseen: BoolArray | None
) -> Array:
    """Average the noise over neighbouring windows, shape (n, tones, 3, 3), never across a gap.

    One window has four degrees of freedom a tone, too few for a weight.

    Parameters
    ----------
    unseen : bool ndarray, shape (n,), optional
        Windows without the gyro's turn: their noise is their own.
    """
    apart = np.diff(centre) > 1.5 * step
    if unseen is not None:
        apart |= unseen[1:] != unseen[:-1]
    breaks = np.flatnonzero(apart) + 1
    out = np.empty_like(noise_cov)
    for part in np.split(np.arange(len(centre)), breaks):
        rows = slice(part[0], part[-1] + 1)
        total = np.cumsum(noise_cov[rows], axis=0)
        total = np.concatenate([np.zeros_like(total[:1]), total])
        n = len(part)
        width = min(windows, n)
        first = np.clip(np.arange(n) - width // 2, 0, n - width)
        out[rows] = (total[first + width] - total[first]) / width
    return out
