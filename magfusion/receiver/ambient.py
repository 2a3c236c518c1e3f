"""Ambient field in driven slots, estimated from the slots in which all coils were silent.

Paper 000, Eq 2-8, subtracts the silent slot of the cycle.  That is exact for a field that does not
change within the cycle and makes hum worse: of a tone f there remains, in units of its amplitude,
``|sinc(f tau)| 2 |sin(pi f n tau)|``, n slots before the silent one; with slots of 5 ms 50 Hz are
6.0 dB larger in the worst slot than had nothing been subtracted.
"""

from typing import Literal

import numpy as np

from magfusion.units import Array, BoolArray, ComplexArray, IntArray

Removal = Literal["none", "subtract", "interpolate", "state"]
MIN_TURNS = (
    1.2  # of an alias of the mains in the span of the state, which distinguishes it from a ramp
)
HARMONICS = (1, 3, 5)  # of the mains, whose waveform is symmetric
MIN_INFORMATION = 0.2  # least singular value of a separable design; that of a column of ones is one
FARTHEST, FARTHEST_BURSTS = 1.0, 16.0  # s, or lengths: slots farther away are not used
STRETCH = 4  # largest extension of the state where that separates mains and drift


def subtraction_gain(frequency_hz: float, duration: float, slots_apart: int) -> float:
    """Return the worst-case gain for a tone of subtracting a silent slot.

    `duration`: length of a slot (s). `slots_apart`: slots from the driven to the silent one.
    """
    averaged = abs(np.sinc(frequency_hz * duration))
    return float(averaged * 2.0 * abs(np.sin(np.pi * frequency_hz * slots_apart * duration)))


def ambient_weights(
    driven: IntArray,
    silent: IntArray,
    count: int,
    removal: Removal,
    *,
    cycles: int = 8,
    mains_turns: float = 0.0,
) -> tuple[IntArray, Array]:
    """Return the silent slots and weights from which the ambient field is estimated.

    Parameters
    ----------
    driven, silent : int ndarray, shape (n,) and (m,)
        Running numbers of the slots, increasing.
    count : int
        Slots in a cycle.
    removal : {"none", "subtract", "interpolate", "state"}
        Nothing; the mean of the silent slots of the same cycle; straight lines between the nearest
        silent slots before and after; least squares of a constant, a ramp and, where they can be
        separated, the mains over the nearest silent slots.
    cycles : int
        Length of the state (cycles); up to four times longer where that separates the mains from a
        drift.
    mains_turns : float
        Turns of the mains in a slot; zero for none.

    Returns
    -------
    index : int ndarray, shape (n, k)
        Into ``silent``.
    weight : ndarray, shape (n, k)
        NaN where no silent slot is near enough.
    """
    if removal == "none" or len(silent) == 0:
        nothing = np.zeros((len(driven), 1))
        return nothing.astype(np.int64), nothing + (np.nan if removal != "none" else 0.0)
    after = np.searchsorted(silent, driven)
    if removal == "subtract":
        return _same_cycle(driven, silent, count)
    if removal == "interpolate":
        return _interpolated(driven, silent, after, count)
    alias = _alias(mains_turns, count)
    if alias * (STRETCH * cycles - 1) >= MIN_TURNS:
        cycles = max(cycles, int(np.ceil(MIN_TURNS / alias)) + 1)
    per_cycle = len(np.unique(silent % count))
    number = min(cycles * per_cycle, len(silent))
    first = np.clip(after - number // 2, 0, len(silent) - number)
    index = first[:, None] + np.arange(number)
    elapsed = (silent[index] - driven[:, None]).astype(np.float64)
    # What is far off says nothing of the field now: the log has a gap.
    near = np.abs(elapsed) <= cycles * count
    design = _state_design(elapsed, near, count, mains_turns)
    weight = np.linalg.pinv(design, rcond=1e-6)[:, 0]  # the constant, at the driven slot itself
    return index, np.where(near.any(axis=1)[:, None], weight, np.nan)


def _alias(mains_turns: float, count: int) -> float:
    """Return how far the mains' alias at the silent slots is from a drift (turns per cycle).

    Zero where a slot averages them out.
    """
    if abs(np.sinc(mains_turns)) < 1e-3:
        return 0.0
    alias = abs(mains_turns * count - round(mains_turns * count))
    return float(min(alias, 0.5 - alias))


def _state_design(elapsed: Array, near: Array, count: int, mains_turns: float) -> Array:
    span = np.ptp(elapsed, axis=1).max() / count  # cycles
    columns = [np.ones_like(elapsed), elapsed / (span * count + 1.0)]
    if span * _alias(mains_turns, count) >= MIN_TURNS:
        angle = 2.0 * np.pi * mains_turns * elapsed
        # The ambient field at the driven slot includes the mains: cos(0) = 1 there, so that the
        # constant, less the cosine's own column, has both.
        columns += [np.cos(angle) - 1.0, np.sin(angle)]
    return np.stack(columns, axis=-1) * near[..., None]


def _same_cycle(driven: IntArray, silent: IntArray, count: int) -> tuple[IntArray, Array]:
    lo = np.searchsorted(silent // count, driven // count)
    hi = np.searchsorted(silent // count, driven // count, side="right")
    maximum = max(int(np.max(hi - lo)), 1)
    index = lo[:, None] + np.arange(maximum)
    there = index < hi[:, None]
    weight = np.where(there, 1.0 / np.maximum(hi - lo, 1)[:, None], 0.0)
    weight[hi == lo] = np.nan
    return np.minimum(index, len(silent) - 1), weight


def _interpolated(
    driven: IntArray, silent: IntArray, after: IntArray, count: int
) -> tuple[IntArray, Array]:
    right = np.minimum(after, len(silent) - 1)
    residual = np.maximum(after - 1, 0)
    span = np.maximum(silent[right] - silent[residual], 1)
    share = np.clip((driven - silent[residual]) / span, 0.0, 1.0)
    weight = np.stack([1.0 - share, share], axis=1)
    weight[span > 2 * count] = np.nan  # a gap
    outside = (driven < silent[residual]) | (driven > silent[right])
    reach = np.minimum(np.abs(driven - silent[residual]), np.abs(driven - silent[right]))
    weight[outside & (reach > count)] = np.nan
    return np.stack([residual, right], axis=1), weight


def uneven_weights(
    driven: Array,
    driven_length: Array,
    silent: Array,
    silent_length: Array,
    number: int,
    mains_hz: float,
) -> tuple[IntArray, Array]:
    """Return silent bursts without a fixed schedule and weights to estimate the ambient field.

    Fits the state of `ambient_weights` to the times and lengths of the bursts: a constant, a ramp
    and, once enough of the nearest bursts separate them, the mains with their odd harmonics.

    Parameters
    ----------
    driven, driven_length : ndarray, shape (n,)
        Middle and length (s).
    silent, silent_length : ndarray, shape (m,)
        Likewise, in order of time.
    number : int
        Number of bursts in the state; up to four times as many for the mains.
    mains_hz : float
        Zero for none.

    Returns
    -------
    index, weight
        As of `ambient_weights`.
    """
    if len(silent) == 0 or len(driven) == 0:
        return ambient_weights(np.arange(len(driven)), np.zeros(0, dtype=np.int64), 1, "state")
    index, weight = _uneven(driven, driven_length, silent, silent_length, number, ())[:2]
    residual = np.arange(len(driven) if mains_hz else 0)
    for orders in (HARMONICS, HARMONICS[:1]):
        lines_hz = tuple(order * mains_hz for order in orders)
        for wide in (number, 2 * number, STRETCH * number):
            if len(residual) == 0:
                break
            own = (driven[residual], driven_length[residual])
            wider, better, dimensions = _uneven(*own, silent, silent_length, wide, lines_hz)
            spare = ((0, 0), (0, max(wider.shape[1] - index.shape[1], 0)))
            index, weight = np.pad(index, spare), np.pad(weight, spare)
            rows, width = residual[dimensions], wider.shape[1]
            index[rows], weight[rows] = 0, 0.0
            index[rows, :width], weight[rows, :width] = wider[dimensions], better[dimensions]
            residual = residual[~dimensions]
    return index, weight


def _uneven(
    driven: Array,
    driven_length: Array,
    silent: Array,
    silent_length: Array,
    number: int,
    lines_hz: tuple[float, ...],
) -> tuple[IntArray, Array, BoolArray]:
    """Return index and weights of one design, and where its columns are separable."""
    number = min(number, len(silent))
    first = np.searchsorted(silent, driven) - number // 2
    index = np.clip(first, 0, len(silent) - number)[:, None] + np.arange(number)
    elapsed = silent[index] - driven[:, None]
    near = np.abs(elapsed) <= np.maximum(FARTHEST, FARTHEST_BURSTS * driven_length)[:, None]
    near &= elapsed != 0.0  # a silent burst does not predict itself
    span = np.max(np.abs(elapsed) * near, axis=1, keepdims=True)
    ramp = np.where(np.sum(near, axis=1, keepdims=True) > 1, elapsed / np.maximum(span, 1e-9), 0.0)
    columns = [np.ones_like(elapsed), ramp]
    wanted = [np.ones(len(driven)), np.zeros(len(driven))]
    for line_hz in lines_hz:
        # A burst averages the mains, each by its own length.
        share = np.sinc(line_hz * silent_length)[index]
        angle = 2.0 * np.pi * line_hz * elapsed
        columns += [share * np.cos(angle), share * np.sin(angle)]
        wanted += [np.sinc(line_hz * driven_length), np.zeros(len(driven))]
    design = np.stack(columns, axis=-1) * near[..., None]
    inverse = np.linalg.pinv(design, rcond=1e-6)
    weight = np.einsum("nc,nck->nk", np.stack(wanted, axis=1), inverse)
    least = np.linalg.svd(design, compute_uv=False)[:, -1] / np.sqrt(number)
    dimensions = (
        least > MIN_INFORMATION if number >= len(columns) else np.zeros(len(driven), dtype=bool)
    )
    return index, np.where(near.any(axis=1)[:, None], weight, np.nan), dimensions


def removed(
    driven: ComplexArray, silent: ComplexArray, index: IntArray, weight: Array
) -> ComplexArray:
    """Return the driven slots (n, 3) less the ambient field estimated from silent ones (m, 3)."""
    if len(silent) == 0:
        return driven + weight
    return driven - np.einsum("nk,nkx->nx", weight, silent[index])
