"""Noise of a window, measured next to the tones rather than taken from a data sheet."""

from itertools import pairwise

import numpy as np

from magfusion.units import Array, BoolArray, IntArray

MIN_RESIDUAL_SHARE = 1e-6  # least share of a probe outside the design for its residual to count
MIN_SHARE = 0.1  # of the declared noise; constant and coarse samples may show none
MIN_NOISE = 1e-18  # T; rounding of the Earth's field


def _probe_frequencies(
    tone: int, frequencies_hz: Array, nuisance_hz: Array, window: float
) -> Array:
    """Return two probes half-way to the neighbours of a tone, clear of every fitted line."""
    lines = np.concatenate([[0.0], frequencies_hz, nuisance_hz])
    separate = np.abs(lines - frequencies_hz[tone])
    nearest = float(np.min(separate[separate > 0]))
    shift = min(0.5 * nearest, 2.0 / window)
    return frequencies_hz[tone] + shift * np.array([-1.0, 1.0])


def probes_left(
    frequencies_hz: Array,
    nuisance_hz: Array,
    elapsed: Array,
    weight: BoolArray,
    design: Array,
    inverse: Array,
) -> tuple[Array, IntArray]:
    """Return the maps from samples to the residuals of probes next to each tone.

    Their power, divided by that of the probes' own residuals, is unbiased for white noise.  A
    short window leaves fewer directions than there are axes.

    Parameters
    ----------
    frequencies_hz, nuisance_hz : ndarray
        Lines in the design (Hz).
    elapsed, weight : ndarray, shape (n, m)
        Sample times from the centre of the window (s); False where a row is padding.
    design, inverse : ndarray, shape (n, m, k) and (n, k, k)
        With the inverse of its normal matrix.

    Returns
    -------
    ndarray, shape (n, tones, 4, m)
        White noise of unit variance gives unit variance in each observable direction, zero in
        others.
    int ndarray, shape (n, tones)
        Number of observable directions.
    """
    window = float(np.max(elapsed) - np.min(elapsed))
    tones = range(len(frequencies_hz))
    probes_hz = [_probe_frequencies(k, frequencies_hz, nuisance_hz, window) for k in tones]
    angle = 2.0 * np.pi * np.array(probes_hz)[None, ..., None] * elapsed[:, None, None]
    probe = np.concatenate([np.cos(angle), np.sin(angle)], axis=2) * weight[:, None, None]
    across = probe.reshape(len(elapsed), -1, elapsed.shape[1])
    removed = (across @ design @ inverse) @ np.swapaxes(design, -1, -2)
    residual = (across - removed).reshape(probe.shape)
    value, vector = np.linalg.eigh(residual @ np.swapaxes(probe, -1, -2))
    dimensions = value > MIN_RESIDUAL_SHARE * np.sum(probe**2, axis=(-2, -1))[..., None]
    scale = np.where(dimensions, 1.0 / np.sqrt(np.where(dimensions, value, 1.0)), 0.0)
    return (scale[..., None] * np.swapaxes(vector, -1, -2)) @ residual, np.sum(dimensions, axis=-1)


def noise_around_tones(seen: Array, dimensions: IntArray) -> Array:
    """Return the covariance per sample of the noise around each tone, in the axes of the samples.

    Unobserved directions get the mean noise of the observed ones. `seen` (n, tones, 4, 3):
    residuals of probes (T). `dimensions` (n, tones): as of `probes_left`. Returns (n, tones, 3, 3)
    (T^2).
    """
    share = np.maximum(dimensions, 1)[..., None, None] / seen.shape[-2]
    own = np.swapaxes(seen, -1, -2) @ seen / seen.shape[-2]
    unseen = (1.0 / share - 1.0) * np.trace(own, axis1=-2, axis2=-1)[..., None, None]
    return own + unseen / 3.0 * np.eye(3)


def not_below(noise_cov: Array, sigma: float) -> Array:
    """Limit the noise in every direction to at least a share of the declared (T), same shape.

    Repeated and coarsely quantised samples may be constant all through a window.
    """
    least = max(MIN_SHARE * sigma, MIN_NOISE) ** 2
    # The two larger eigenvalues have at most the product of half their sum squared.
    half = 0.5 * np.einsum("...ii->...", noise_cov)
    if (np.linalg.det(noise_cov) > least * half**2).all():
        return noise_cov
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

    One window has four degrees of freedom a tone, too few to weight by. `unseen` (n,): windows in
    gaps of the gyro, averaged separately.
    """
    if len(centre) == 1:
        return noise_cov
    separate = centre[1:] - centre[:-1] > 1.5 * step
    if unseen is not None:
        separate |= unseen[1:] != unseen[:-1]
    breaks = np.flatnonzero(separate) + 1
    out = np.empty_like(noise_cov)
    for begin, end in pairwise([0, *breaks.tolist(), len(centre)]):
        rows, n = slice(begin, end), end - begin
        total = np.zeros((n + 1, *noise_cov.shape[1:]))
        np.cumsum(noise_cov[rows], axis=0, out=total[1:])
        width = min(windows, n)
        first = np.minimum(np.maximum(np.arange(n) - width // 2, 0), n - width)
        out[rows] = (total[first + width] - total[first]) / width
    return out
