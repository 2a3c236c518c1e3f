"""Decimation of an inertial stream between distant epochs, with the same integral.

GTSAM integrates one step a call.  Here the steps of a long interval are joined by tens or more, two
joined steps at a time.  Their rates give the rotations of the two halves, their specific forces the
velocity and position gained over both, exactly as the Galilean group composes them from the single
steps.  The covariance of the noise and the derivatives by the biases are those of the longer steps.
GTSAM's covariance scheme is of first order: the sigmas differ by less than half a step's share of
the interval.  The derivatives differ by a twelfth of the square of the rotation in a step, times a
change of bias that vanishes with the next iteration.
"""

from bisect import bisect_left
from dataclasses import replace
from functools import lru_cache
from math import factorial

import gtsam
import numpy as np

from magfusion.estimation.graph.preintegration import Increments, cut_at_epochs, preintegrate
from magfusion.model.perturbation import skew
from magfusion.model.quaternion import cross, matrices, of_vectors
from magfusion.model.samples import ImuSamples
from magfusion.model.site import ImuModel
from magfusion.receiver.admission import meets
from magfusion.units import Array, BoolArray, IntArray

JOINED = (25, 20, 10)  # steps joined to one
MIN_JOINED_STEPS = 20  # minimum of joined steps in an interval: sigmas differ by some thousandths
ROUGHLY_JOINED, ROUGHLY_LEFT = (20, 10, 7, 5), 8  # where errors of sigmas by a tenth are harmless
MAX_TURN = 0.5  # rad; within a joined step, for the series and for the derivatives
CHUNK = 32_768  # steps joined at a time: intermediate results stay in the cache
STRETCH = 200_000  # samples cut at a time: bounds the memory in a long log
_STATIONARY_STEP = np.concatenate([np.eye(3), 0.5 * np.eye(3)], axis=1)
# Of `_coefficients` the factors of 1, x^2, x^4 ...
_SERIES = np.array(
    [
        [
            (-1) ** k / factorial(2 * k + 2),
            (-1) ** k / factorial(2 * k + 3),
            (-1) ** k / factorial(2 * k + 4),
        ]
        for k in range(5)
    ]
)
# Squares up to which 1, 2, ... terms after the first suffice: the next is negligible.
_FEW_TERMS = [
    (1e-17 / np.max(np.abs(_SERIES[k] / _SERIES[0]))) ** (1 / k) for k in range(2, len(_SERIES))
]


def preintegrate_stream(
    imu: ImuSamples,
    time_offset: float,
    epochs: Array,
    model: ImuModel,
    gravity: float,
    accel_bias: Array,
    gyro_bias: Array,
    silence: tuple[Array, Array] | None = None,
    *,
    roughly: bool = False,
) -> tuple[list[gtsam.PreintegratedCombinedMeasurementsG], BoolArray]:
    """Preintegrate a whole stream between epochs, in segments.

    Parameters
    ----------
    time_offset : float
        Added to its stamps to bring them to the log's clock (s).
    epochs : ndarray, shape (n,)
        (s)
    gravity : float
        (m/s^2)
    accel_bias, gyro_bias : ndarray, shape (n, 3)
        At which to linearise (m/s^2, rad/s).
    silence : tuple of ndarray, optional
        Beginnings and ends of gaps that are filled by other samples (s).
    roughly : bool
        Whether approximate sigmas suffice, so that intervals of some tens of samples are decimated.

    Returns
    -------
    list
        One for each interval.
    bool ndarray, shape (n - 1,)
        Intervals with a gap.
    """
    before = np.searchsorted(imu.time, epochs - time_offset)
    usual = float(np.median(np.diff(imu.time + time_offset)))
    measured, gap_bridged = [], []
    begin = 0
    while begin < len(epochs) - 1:
        reach = int(np.searchsorted(before, before[begin] + STRETCH))
        end = min(max(reach, begin + 1), len(epochs) - 1)
        # With two samples beyond each end, and one more for the rounding of the offset.
        rows = slice(max(int(before[begin]) - 3, 0), int(before[end]) + 3)
        here = slice(begin, end + 1)
        stream = ImuSamples(imu.time[rows], imu.gyro_body[rows], imu.accel_body[rows])
        increments = cut_at_epochs(stream, time_offset, epochs[here], usual)
        if silence is not None:
            silent = meets(*silence, epochs[begin:end], epochs[begin + 1 : end + 1])
            increments = replace(increments, gap_bridged=increments.gap_bridged | silent)
        ways = (ROUGHLY_JOINED, ROUGHLY_LEFT) if roughly else (JOINED, MIN_JOINED_STEPS)
        increments = thinned(increments, accel_bias[here], gyro_bias[here], *ways)
        measured += preintegrate(increments, model, gravity, accel_bias[here], gyro_bias[here])
        gap_bridged.append(increments.gap_bridged)
        begin = end
    return measured, np.concatenate(gap_bridged)


def thinned(
    increments: Increments,
    accel_bias: Array,
    gyro_bias: Array,
    ways: tuple[int, ...] = JOINED,
    min_steps: int = MIN_JOINED_STEPS,
) -> Increments:
    """Join the steps of the long intervals.

    `accel_bias`, `gyro_bias` (epochs, 3): at which they will be preintegrated (m/s^2, rad/s): there
    the result is the same to rounding. `ways`: numbers of steps that may be joined to one, falling.
    For each interval the one that leaves the fewest steps, but at least ``min_steps``. `min_steps`:
    minimum number of joined steps of an interval. Returns the given ones where no interval is long.
    Intervals with a gap, steps that fill no pair, and steps of fast rotation are not joined.
    """
    steps = increments.first[1:] - increments.first[:-1]
    steps[increments.gap_bridged] = 0
    if steps.max(initial=0) < min_steps * ways[-1]:
        return increments
    way = np.array([_way(number, ways, min_steps) for number in steps.tolist()])
    for joined in ways:
        if (long := way == joined).any():
            increments = _with_joined(increments, joined, long, accel_bias, gyro_bias)
    return increments


@lru_cache(maxsize=4096)
def _way(steps: int, ways: tuple[int, ...], min_steps: int) -> int:
    """Return how many steps of an interval are joined to one; 1 where it is too short."""
    enough = [joined for joined in ways if steps >= min_steps * joined]
    return min(enough, key=lambda n: 2 * (steps // (2 * n)) + steps % (2 * n), default=1)


def _with_joined(
    increments: Increments, joined: int, long: BoolArray, accel_bias: Array, gyro_bias: Array
) -> Increments:
    start, owner = _pairs(increments, joined, long)
    every = np.concatenate([increments.gyro_body.T, increments.accel_body.T, increments.dt[None]])
    bias = np.concatenate([gyro_bias.T, accel_bias.T])
    within, number = np.arange(2 * joined).reshape(2, joined).T, max(CHUNK // (2 * joined), 1)
    built, begun = [], []
    for lo in range(0, len(start), number):
        first = start[lo : lo + number]
        steps = every.take(within[..., None] + first, axis=1)
        both, gentle = _joined(steps, bias.take(owner[lo : lo + number], axis=1))
        if not gentle.all():
            both, first = both[..., gentle], first[gentle]
        built.append(both)
        begun.append(first)
    first, both = np.concatenate(begun), np.concatenate(built, axis=2)
    kept = np.ones(len(increments.dt), dtype=bool)
    kept[within[1:, :, None] + first] = False
    every[:, within[0][:, None] + first] = both
    every, ends = every[:, kept], np.append(0, np.cumsum(kept))[increments.first]
    return Increments(
        every[:3].T.copy(), every[3:6].T.copy(), every[6], ends, increments.gap_bridged
    )


def _pairs(increments: Increments, joined: int, long: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first step of every pair of joined steps, and its interval."""
    number = np.where(long, np.diff(increments.first) // (2 * joined), 0)
    owner = np.repeat(np.arange(len(number)), number)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    return increments.first[owner] + 2 * joined * within, owner


def _one_after_the_other(moved: Array) -> Array:
    """Return the product of k matrices, (k, ..., 5, 5), by a tree of pairwise products."""
    while len(moved) > 1:
        even = len(moved) - len(moved) % 2
        pairs = moved[0:even:2] @ moved[1:even:2]
        moved = pairs if even == len(moved) else np.concatenate([pairs, moved[even:]])
    return np.asarray(moved[0])


def _of_steps(steps: Array, bias: Array) -> tuple[Array, Array]:
    """Return the motion in single steps, and the rotation angle of each (rad).

    `steps`, `bias`: as of `_joined`. Returns `moved` (k, 2, n, 5, 5): rotation, velocity and
    position from rest at the beginning of the step, and its length: an element of the Galilean
    group, of which GTSAM's integration is a product; `angle` (k, 2, n).
    """
    dt = steps[6]
    rotation, gained = (steps[:6] - bias[:, None, None]).reshape(2, 3, *dt.shape) * dt
    square = np.einsum("i...,i...->...", rotation, rotation)
    b, c, d = _coefficients(square)
    once = cross(rotation, gained)
    twice = cross(rotation, once)
    turn = matrices(of_vectors(rotation.reshape(3, -1)))
    moved = np.zeros((*dt.shape, 5, 5))
    moved[..., :3, :3] = turn.reshape(*dt.shape, 3, 3)
    moved[..., :3, 3] = (gained + b * once + c * twice).transpose(1, 2, 3, 0)
    moved[..., :3, 4] = ((0.5 * gained + c * once + d * twice) * dt).transpose(1, 2, 3, 0)
    moved[..., 3, 3] = moved[..., 4, 4] = 1.0
    moved[..., 3, 4] = dt
    return moved, np.sqrt(square)


def _joined(steps: Array, bias: Array) -> tuple[Array, BoolArray]:
    """Return two steps with the same integral as many.

    Constant over each step, they give the rotations of the halves, and together velocity and
    position of the whole. `steps` (7, k, 2, n): rate, specific force and length of the single steps
    of both halves. `bias` (6, n): of gyro and accelerometer (rad/s, m/s^2). Returns
    `both` (7, 2, n): rate, specific force and length; `gentle` (n,): whether the rotation of both
    halves is small.
    """
    single, angle = _of_steps(steps, bias)
    halves = _one_after_the_other(single)
    whole = (halves[0] @ halves[1])[:, :3, 3:].swapaxes(1, 2).reshape(-1, 6, 1)
    rotation, dt = _small_vectors(halves[..., :3, :3]), halves[..., 3, 4]
    first, second = dt[..., None, None]
    by_1, by_2 = _by_force(rotation)
    system = np.empty((len(whole), 6, 6))
    system[:, :3, :3] = by_1[..., :3] * first
    system[:, 3:, :3] = by_1[..., 3:] * first**2 + by_1[..., :3] * (first * second)
    later = halves[0, :, :3, :3] @ by_2
    system[:, :3, 3:] = later[..., :3] * second
    system[:, 3:, 3:] = later[..., 3:] * second**2
    both = np.empty((7, *dt.shape))
    both[:3] = rotation / dt
    both[3:6] = np.linalg.solve(system, whole).reshape(-1, 2, 3).T
    both[:6] += bias[:, None]
    both[6] = dt
    return both, angle.sum(axis=0).max(axis=0) < MAX_TURN


def _small_vectors(turn: Array) -> Array:
    """Return the rotation vectors, (3, ...), of rotation matrices below a right angle (rad)."""
    odd = 0.5 * (turn - turn.swapaxes(-1, -2))
    axis = np.array([odd[..., 2, 1], odd[..., 0, 2], odd[..., 1, 0]])
    sine = np.sqrt(np.einsum("i...,i...->...", axis, axis))
    return np.asarray(axis / np.sinc(np.arcsin(np.minimum(sine, 1.0)) / np.pi))


def _by_force(rotation: Array) -> Array:
    """Return velocity and position by a constant specific force over a unit of time.

    `rotation` (3, ...): rotation vector at a constant rate (rad). Returns (..., 3, 6): integral,
    and integral of the integral, of the rotation's matrix.
    """
    once = skew(np.moveaxis(rotation, 0, -1))
    twice = once @ once
    factors = _coefficients(np.einsum("i...,i...->...", rotation, rotation))
    b, c, d = factors[..., None, None]
    out = np.empty((*once.shape[:-1], 6))
    out[..., :3] = b * once + c * twice
    out[..., 3:] = c * once + d * twice
    out += _STATIONARY_STEP
    return out


def _coefficients(square: Array) -> Array:
    """Return functions of the angle x of a rotation from its square, a small one, shape (3, ...).

    (1 - cos x) / x^2, (x - sin x) / x^3, (x^2 / 2 - 1 + cos x) / x^4.
    """
    last = 1 + bisect_left(_FEW_TERMS, square.max())
    terms = _SERIES.reshape(*_SERIES.shape, *(1,) * square.ndim)
    out = np.asarray(terms[last] * square)
    for term in terms[last - 1 : 0 : -1]:
        out += term
        out *= square
    out += terms[0]
    return out
