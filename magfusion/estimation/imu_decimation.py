"""Fewer steps of an inertial stream between epochs far apart, that integrate to the same.

GTSAM integrates one step a call.  Here the steps of a long interval are joined by eights, tens or
twenties, two joined steps at a time: their rates make the turns of the two halves, their specific
forces the velocity and the position gained over both, exactly as the Galilean group composes them
of the single steps.  The noise's covariance and the derivatives by the biases are those of the
longer steps.  GTSAM's scheme of the covariance is of first order: the sigmas differ by less than
half a step's share of the interval.  The derivatives differ by a twelfth of the square of the turn
in a step, of a change of bias that the next pass makes nothing.
"""

from bisect import bisect_left
from dataclasses import replace
from math import factorial
from typing import NamedTuple

import gtsam
import numpy as np

from magfusion.estimation.preintegration import Increments, cut_at_epochs, preintegrate
from magfusion.model.quaternion import cross, matrices, product, turned, vectors
from magfusion.model.samples import ImuSamples
from magfusion.model.site import ImuModel
from magfusion.receiver.admission import meets
from magfusion.units import Array, BoolArray, IntArray

# Steps made one, and how many joined ones an interval must have left.
Way = tuple[int, int]
JOINED: tuple[Way, ...] = ((20, 200), (10, 200), (8, 50))
# Where sigmas a tenth wrong do no harm.
ROUGHLY_JOINED: tuple[Way, ...] = ((20, 8), (10, 8), (7, 8), (5, 8))
MOST_TURN = 0.5  # rad; within a joined step, for the series and for the derivatives
CHUNK = 65_536  # steps joined at a time: what is computed of them stays in the cache
STRETCH = 200_000  # samples cut at a time: what is made of them is no multiple of a long log
_AT_REST = np.concatenate([np.eye(3), 0.5 * np.eye(3)], axis=1)
# Of `_coefficients` the factors of 1, x^2, x^4 ...
_SERIES = np.array(
    [
        [
            (-1) ** k / factorial(2 * k + 2),
            (-1) ** k / factorial(2 * k + 3),
            (-1) ** k / factorial(2 * k + 4),
            (-0.25) ** k / factorial(2 * k),
            0.5 * (-0.25) ** k / factorial(2 * k + 1),
        ]
        for k in range(5)
    ]
)
# The square up to which, after the first, 1, 2, ... terms do: the next is nothing beside the first.
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
    """Preintegrate a whole stream between epochs, a stretch of it at a time.

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
        Where gaps begin and end in which other samples stand in for inertial ones (s).
    roughly : bool
        Whether the sigmas matter little, and intervals of some tens of samples are thinned too.

    Returns
    -------
    list
        One for each interval.
    bool ndarray, shape (n - 1,)
        Intervals with a gap.
    """
    before = np.searchsorted(imu.time, epochs - time_offset)
    usual = float(np.median(np.diff(imu.time + time_offset)))
    measured, bridged = [], []
    begin = 0
    while begin < len(epochs) - 1:
        reach = int(np.searchsorted(before, before[begin] + STRETCH))
        end = min(max(reach, begin + 1), len(epochs) - 1)
        # With a sample beyond each end, and one more for what adding the offset rounds.
        rows = slice(max(int(before[begin]) - 2, 0), int(before[end]) + 2)
        here = slice(begin, end + 1)
        stream = ImuSamples(imu.time[rows], imu.gyro_body[rows], imu.accel_body[rows])
        increments = cut_at_epochs(stream, time_offset, epochs[here], usual)
        if silence is not None:
            silent = meets(*silence, epochs[begin:end], epochs[begin + 1 : end + 1])
            increments = replace(increments, bridged=increments.bridged | silent)
        ways = ROUGHLY_JOINED if roughly else JOINED
        increments = thinned(increments, accel_bias[here], gyro_bias[here], ways)
        measured += preintegrate(increments, model, gravity, accel_bias[here], gyro_bias[here])
        bridged.append(increments.bridged)
        begin = end
    return measured, np.concatenate(bridged)


def thinned(
    increments: Increments, accel_bias: Array, gyro_bias: Array, ways: tuple[Way, ...] = JOINED
) -> Increments:
    """Join the steps of the long intervals.

    Parameters
    ----------
    accel_bias, gyro_bias : ndarray, shape (epochs, 3)
        At which they will be preintegrated (m/s^2, rad/s): there the result is the same to
        rounding.
    ways : tuple of (int, int)
        How many steps may be joined to one, falling, and how many joined steps of an interval are
        enough for it.  Of each interval the first way is taken that leaves enough.

    Returns
    -------
    Increments
        The given ones where no interval is long.  Left single are intervals with a gap, steps that
        fill no pair, and those of a fast turn.
    """
    left = np.diff(increments.first)
    left[increments.bridged] = 0
    for joined, fewest in ways:
        long = left >= fewest * joined
        if long.any():
            increments = _with_joined(increments, joined, long, accel_bias, gyro_bias)
            left[long] = 0
    return increments


def _with_joined(
    increments: Increments, joined: int, long: BoolArray, accel_bias: Array, gyro_bias: Array
) -> Increments:
    start, owner = _pairs(increments, joined, long)
    every = np.concatenate([increments.gyro_body.T, increments.accel_body.T, increments.dt[None]])
    biases = np.concatenate([gyro_bias.T, accel_bias.T])
    single, number = np.arange(joined)[:, None], max(CHUNK // (2 * joined), 1)
    made, begun = [], []
    for lo in range(0, len(start), number):
        first = start[lo : lo + number]
        rows = single + np.concatenate([first, first + joined])
        bias = biases.take(np.tile(owner[lo : lo + number], 2), axis=1)
        both, gentle = _joined(every.take(rows, axis=1), bias)
        made.append(both[:, :, gentle])
        begun.append(first[gentle])
    first, both = np.concatenate(begun), np.concatenate(made, axis=2)
    kept = np.ones(len(increments.dt), dtype=bool)
    kept[np.arange(2 * joined)[:, None] + first] = False
    kept[first] = kept[first + joined] = True
    for half, steps in enumerate(both.swapaxes(0, 1)):
        every[:, first + half * joined] = steps
    every = every[:, kept]
    ends = np.append(0, np.cumsum(kept))[increments.first]
    return Increments(every[:3].T.copy(), every[3:6].T.copy(), every[6], ends, increments.bridged)


def _pairs(increments: Increments, joined: int, long: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first step of every pair of joined steps, and its interval."""
    number = np.where(long, np.diff(increments.first) // (2 * joined), 0)
    owner = np.repeat(np.arange(len(number)), number)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    return increments.first[owner] + 2 * joined * within, owner


class _Moved(NamedTuple):
    """What steps integrate to, each from rest at its own beginning.

    Parameters
    ----------
    turn : ndarray, shape (4, k, n)
        Quaternion, scalar first.
    gained : ndarray, shape (3, 2, k, n)
        Velocity and position, in the axes of the beginning (m/s, m).
    dt : ndarray, shape (k, n)
        (s)
    """

    turn: Array
    gained: Array
    dt: Array

    def part(self, steps: slice) -> "_Moved":
        """Return some of the k steps."""
        return _Moved(self.turn[:, steps], self.gained[:, :, steps], self.dt[steps])

    def then(self, later: "_Moved") -> "_Moved":
        """Return what these steps and later ones integrate to, one after the other."""
        gained = self.gained + turned(self.turn[:, None], later.gained)
        gained[:, 1] += self.gained[:, 0] * later.dt
        return _Moved(product(self.turn, later.turn), gained, self.dt + later.dt)


def _of_steps(steps: Array, bias: Array) -> tuple[_Moved, Array]:
    """Return what single steps, (7, k, n), integrate to, and the angle that each turns through."""
    dt = steps[6]
    rotation, gained = (steps[:6].reshape(2, 3, *dt.shape) - bias.reshape(2, 3, 1, -1)) * dt
    square = np.einsum("i...,i...->...", rotation, rotation)
    b, c, d, cosine, sine = _coefficients(square)
    once = cross(rotation, gained)
    twice = cross(rotation, once)
    both = np.empty((3, 2, *dt.shape))
    both[:, 0] = gained + b * once + c * twice
    both[:, 1] = (0.5 * gained + c * once + d * twice) * dt
    turn = np.empty((4, *dt.shape))
    turn[0] = cosine
    np.multiply(sine, rotation, out=turn[1:])
    return _Moved(turn, both, dt), np.sqrt(square)


def _one_after_the_other(steps: _Moved) -> _Moved:
    """Return what all k steps integrate to, k of it 1: neighbours together, and these again."""
    number = len(steps.dt)
    if number == 1:
        return steps
    even = number - number % 2
    pairs = steps.part(slice(0, even, 2)).then(steps.part(slice(1, even, 2)))
    if even < number:
        last = steps.part(slice(even, None))
        pairs = _Moved(
            np.concatenate([pairs.turn, last.turn], axis=1),
            np.concatenate([pairs.gained, last.gained], axis=2),
            np.concatenate([pairs.dt, last.dt]),
        )
    return _one_after_the_other(pairs)


def _joined(steps: Array, bias: Array) -> tuple[Array, BoolArray]:
    """Return two steps that integrate to what many do.

    Constant over each step, they give the turns of the halves, and together velocity and position
    of the whole.

    Parameters
    ----------
    steps : ndarray, shape (7, k, 2 n)
        Rate, specific force and length of the single steps of n first halves, then of the second.
    bias : ndarray, shape (6, 2 n)
        Of gyro and accelerometer (rad/s, m/s^2).

    Returns
    -------
    both : ndarray, shape (7, 2, n)
        Rate, specific force and length.
    gentle : ndarray of bool, shape (n,)
        Whether neither half turns far.
    """
    moved, angle = _of_steps(steps, bias)
    gentle = np.maximum(*angle.sum(axis=0).reshape(2, -1)) < MOST_TURN
    halves = _one_after_the_other(moved)
    turn, dt = halves.turn[:, 0], halves.dt[0]
    n = len(gentle)
    second = dt[n:, None, None]
    rotation, after = vectors(turn), matrices(turn[:, :n])
    gained = halves.gained[:, :, 0].T  # (2 n, 2, 3)
    whole = gained[:n] + gained[n:] @ after.transpose(0, 2, 1)
    whole[:, 1] += gained[:n, 0] * second[:, 0]
    by_force = _by_force(rotation) * dt[:, None, None]
    by_force[..., 3:] *= dt[:, None, None]
    system = np.empty((n, 6, 6))
    system[:, :3, :3] = by_force[:n, :, :3]
    system[:, 3:, :3] = by_force[:n, :, 3:] + by_force[:n, :, :3] * second
    later = after @ by_force[n:]
    system[:, :3, 3:], system[:, 3:, 3:] = later[..., :3], later[..., 3:]
    force = np.linalg.solve(system, whole.reshape(n, 6, 1))
    both = np.empty((7, 2, n))
    both[:3] = (rotation / dt).reshape(3, 2, n)
    both[3:6] = force.reshape(n, 2, 3).transpose(2, 1, 0)
    both[:6] += bias.reshape(6, 2, n)
    both[6] = dt.reshape(2, n)
    return both, gentle


def _by_force(rotation: Array) -> Array:
    """Return velocity and position by a constant specific force, of a unit of time.

    Parameters
    ----------
    rotation : ndarray, shape (3, n)
        Turned through at a constant rate (rad).

    Returns
    -------
    ndarray, shape (n, 3, 6)
        Integral, and integral of the integral, of the rotation's matrix.
    """
    factors = _coefficients(np.einsum("ij,ij->j", rotation, rotation))
    once = np.zeros((rotation.shape[1], 3, 3))
    x, y, z = rotation
    once[:, 2, 1], once[:, 0, 2], once[:, 1, 0] = x, y, z
    once -= once.transpose(0, 2, 1).copy()
    twice = once @ once
    b, c, d = (factor[:, None, None] for factor in factors[:3])
    out = np.empty((*once.shape[:2], 6))
    out[..., :3] = b * once + c * twice
    out[..., 3:] = c * once + d * twice
    out += _AT_REST
    return out


def _coefficients(square: Array) -> Array:
    """Return functions of the angle x of a rotation from its square, a small one, shape (5, ...).

    (1 - cos x) / x^2, (x - sin x) / x^3, (x^2 / 2 - 1 + cos x) / x^4, and of half the angle the
    cosine and half of sin(x / 2) / (x / 2).
    """
    last = 1 + bisect_left(_FEW_TERMS, square.max())
    terms = _SERIES.reshape(*_SERIES.shape, *(1,) * square.ndim)
    out = np.asarray(terms[last] * square)
    for term in terms[last - 1 : 0 : -1]:
        out += term
        out *= square
    out += terms[0]
    return out
