"""What the ambient field leaves in pulses of direct current, as the silent bursts tell.

Each silent burst is foretold by those beside it, as a driven one is: how far it is from that,
beyond noise, is what hum leaves that the state does not follow.
"""

import numpy as np

from magfusion.receiver.ambient import removed, uneven_weights
from magfusion.receiver.noise import smoothed_over_windows
from magfusion.units import Array, ComplexArray

FEWEST = 3  # silent bursts, below which none is foretold by others on both sides


def left_by_ambient(
    time: Array,
    length: Array,
    still: ComplexArray,
    noise: Array,
    state: tuple[int, float],
    spread: tuple[float, int],
) -> Array:
    """Return the covariance of what a burst holds of hum that no neighbour tells, (n, 3, 3) (T^2).

    Parameters
    ----------
    time, length : ndarray, shape (n,)
        Of silent bursts: mean time of their samples, and length (s).
    still : complex ndarray, shape (n, 3)
        What they hold (T), axes that do not turn.
    noise : ndarray, shape (n, 3, 3)
        Covariance of that by the noise of their samples (T^2).
    state : (int, float)
        Bursts in the state, and frequency of the mains (Hz), as `uneven_weights` takes them.
    spread : (float, int)
        The longest pause over which bursts tell of one another (s), and how many are averaged.
    """
    if len(time) < FEWEST:
        return np.zeros_like(noise)
    index, weight = uneven_weights(time, length, time, length, *state)
    left = removed(still, still, index, weight).real
    told = np.isfinite(left).all(axis=1)
    if np.sum(told) < FEWEST:
        return np.zeros_like(noise)
    square = np.where(np.isfinite(weight), weight, 0.0) ** 2
    expected = noise + np.einsum("nk,nkxy->nxy", square, noise[index])
    excess = left[:, :, None] * left[:, None] - expected
    # As large in the neighbours that foretell a burst as in itself.
    excess = (excess / (1.0 + np.sum(square, axis=1))[:, None, None])[told]
    mean = smoothed_over_windows(excess[:, None], time[told], spread[0], spread[1], None)[:, 0]
    value, vector = np.linalg.eigh(mean)
    mean = vector * np.maximum(value, 0.0)[:, None] @ np.swapaxes(vector, 1, 2)
    after = np.clip(np.searchsorted(time[told], time), 0, len(mean) - 1)
    return np.asarray(mean[after])
