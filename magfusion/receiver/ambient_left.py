"""Residual ambient field in pulses of direct current, estimated from the silent bursts.

Each silent burst is predicted from its neighbours, as a driven one is.  The prediction error beyond
noise is the hum that the state does not follow.
"""

import numpy as np

from magfusion.receiver.ambient import removed, uneven_weights
from magfusion.receiver.noise import smoothed_over_windows
from magfusion.units import Array, ComplexArray

MIN_SILENT_BURSTS = 3  # silent bursts needed to predict one from both sides


def left_by_ambient(
    time: Array,
    length: Array,
    still: ComplexArray,
    noise: Array,
    state: tuple[int, float],
    spread: tuple[float, int],
) -> Array:
    """Return the covariance of the hum that the neighbours do not predict, (n, 3, 3) (T^2).

    Parameters
    ----------
    time, length : ndarray, shape (n,)
        Of silent bursts: mean time of their samples, and length (s).
    still : complex ndarray, shape (n, 3)
        Their values (T), non-rotating axes.
    noise : ndarray, shape (n, 3, 3)
        Covariance of their values by sample noise (T^2).
    state : (int, float)
        Bursts in the state, and frequency of the mains (Hz), as `uneven_weights` takes them.
    spread : (float, int)
        Longest pause between bursts that are averaged together (s), and how many are averaged.
    """
    if len(time) < MIN_SILENT_BURSTS:
        return np.zeros_like(noise)
    index, weight = uneven_weights(time, length, time, length, *state)
    residual = removed(still, still, index, weight).real
    dimensions = np.isfinite(residual).all(axis=1)
    if np.sum(dimensions) < MIN_SILENT_BURSTS:
        return np.zeros_like(noise)
    square = np.where(np.isfinite(weight), weight, 0.0) ** 2
    expected = noise + np.einsum("nk,nkxy->nxy", square, noise[index])
    excess = residual[:, :, None] * residual[:, None] - expected
    # The neighbours have as much hum as the predicted burst.
    excess = (excess / (1.0 + np.sum(square, axis=1))[:, None, None])[dimensions]
    mean = smoothed_over_windows(excess[:, None], time[dimensions], spread[0], spread[1], None)[
        :, 0
    ]
    value, vector = np.linalg.eigh(mean)
    mean = vector * np.maximum(value, 0.0)[:, None] @ np.swapaxes(vector, 1, 2)
    after = np.clip(np.searchsorted(time[dimensions], time), 0, len(mean) - 1)
    return np.asarray(mean[after])
