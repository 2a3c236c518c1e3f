"""Fewer steps of an inertial stream between epochs far apart, that integrate to the same.

GTSAM integrates one step a call.  Here the steps of a long interval are joined by tens or twenties,
two joined steps at a time: their rates make the turns of the two halves, their specific forces the
velocity and the position gained over both, exactly as the Galilean group composes them of the
single steps.  The noise's covariance and the derivatives by the biases are those of the longer
steps.  GTSAM's scheme of the covariance is of first order: the sigmas differ by half a step's share
of the interval.  The derivatives differ by a twelfth of the square of the turn in a step, of a
change of bias that the next pass makes nothing.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from magfusion.estimation.preintegration import Increments, cut_at_epochs, preintegrate
from magfusion.model.quaternion import cross, matrices, product, turned, unit, vectors
from magfusion.model.samples import ImuSamples
from magfusion.model.site import ImuModel
from magfusion.receiver.admission import meets
from magfusion.units import Array, BoolArray, IntArray

JOINED = (20, 10)  # steps made one: as many as leave enough
FEWEST_LEFT = 200  # joined steps of an interval that is thinned
ROUGHLY_JOINED, ROUGHLY_LEFT = (20, 10, 7, 5), 8  # where sigmas a tenth wrong do no harm
MOST_TURN = 0.5  # rad; within a joined step, for the series and for the derivatives
CHUNK = 8192  # pairs of joined steps at a time: what is computed of them stays in the cache
STRETCH = 200_000  # samples cut at a time: what is made of them is no multiple of a long log


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
        ways = (ROUGHLY_JOINED, ROUGHLY_LEFT) if roughly else (JOINED, FEWEST_LEFT)
        increments = thinned(increments, accel_bias[here], gyro_bias[here], *ways)
        measured += preintegrate(increments, model, gravity, accel_bias[here], gyro_bias[here])
        bridged.append(increments.bridged)
        begin = end
    return measured, np.concatenate(bridged)


def thinned(
    increments: Increments,
    accel_bias: Array,
    gyro_bias: Array,
    ways: tuple[int, ...] = JOINED,
    fewest: int = FEWEST_LEFT,
) -> Increments:
    """Join the steps of the long intervals.

    Parameters
    ----------
    accel_bias, gyro_bias : ndarray, shape (epochs, 3)
        At which they will be preintegrated (m/s^2, rad/s): there the result is the same to
        rounding.
    ways : tuple of int
        Numbers of steps that may be joined to one, falling.  Of each interval the first is taken
        that leaves enough steps.
    fewest : int
        Joined steps of an interval that are enough.

    Returns
    -------
    Increments
        The given ones where no interval is long.  Left single are intervals with a gap, steps that
        fill no pair, and those of a fast turn.
    """
    steps = np.diff(increments.first)
    if steps.max(initial=0) < fewest * ways[-1]:
        return increments
    for i, joined in enumerate(ways):
        long = (steps >= fewest * joined) & ~increments.bridged
        if i > 0:
            long &= steps < fewest * ways[i - 1]
        if np.any(long):
            increments = _with_joined(increments, joined, long, accel_bias, gyro_bias)
    return increments


def _with_joined(
    increments: Increments, joined: int, long: BoolArray, accel_bias: Array, gyro_bias: Array
) -> Increments:
    start, owner = _pairs(increments, joined, long)
    kept = np.ones(len(increments.dt), dtype=bool)
    made, first = [], []
    for lo in range(0, len(start), CHUNK):
        rows, interval = start[lo : lo + CHUNK], owner[lo : lo + CHUNK]
        bias = np.concatenate([gyro_bias[interval], accel_bias[interval]], axis=1)
        halves = _halves(increments, joined, rows, bias)
        gentle = np.max(halves.path, axis=0) < MOST_TURN
        made.append(_joined(halves, bias)[gentle])
        first.append(rows[gentle])
    begun, both = np.concatenate(first), np.concatenate(made)
    for k in range(2 * joined):
        kept[begun + k] = k % joined == 0
    left = np.flatnonzero(kept)
    place = np.searchsorted(left, begun)
    gyro, accel, dt = increments.gyro_body[left], increments.accel_body[left], increments.dt[left]
    for half in range(2):
        gyro[place + half] = both[:, half, :3]
        accel[place + half] = both[:, half, 3:6]
        dt[place + half] = both[:, half, 6]
    return Increments(gyro, accel, dt, np.searchsorted(left, increments.first), increments.bridged)


def _pairs(increments: Increments, joined: int, long: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first step of every pair of joined steps, and its interval."""
    number = np.where(long, np.diff(increments.first) // (2 * joined), 0)
    owner = np.repeat(np.arange(len(number)), number)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    return increments.first[owner] + 2 * joined * within, owner


@dataclass(frozen=True, eq=False)
class _Halves:
    """What the steps of two joined ones integrate to, each from rest at its own beginning.

    Parameters
    ----------
    turn : ndarray, shape (4, 2, n)
        Quaternion, scalar first.
    velocity, position : ndarray, shape (3, 2, n)
        Gained, in the axes of the beginning (m/s, m).
    dt : ndarray, shape (2, n)
        (s)
    path : ndarray, shape (2, n)
        Angle turned through, to and fro (rad).
    """

    turn: Array
    velocity: Array
    position: Array
    dt: Array
    path: Array


def _halves(increments: Increments, joined: int, start: IntArray, bias: Array) -> _Halves:
    shape = (2, len(start))
    turn, path = np.zeros((4, *shape)), np.zeros(shape)
    turn[0] = 1.0
    velocity, position, total = np.zeros((3, *shape)), np.zeros((3, *shape)), np.zeros(shape)
    gyro_bias, accel_bias = bias.T[:3, None], bias.T[3:, None]
    for k in range(joined):
        rows = np.stack([start + k, start + joined + k])
        dt = increments.dt[rows]
        rotation = (np.moveaxis(increments.gyro_body[rows], 2, 0) - gyro_bias) * dt
        gained = (np.moveaxis(increments.accel_body[rows], 2, 0) - accel_bias) * dt
        square = np.sum(rotation**2, axis=0)
        once = cross(rotation, gained)
        twice = cross(rotation, once)
        b, c, d = _coefficients(square)
        position += velocity * dt + turned(turn, (0.5 * gained + c * once + d * twice) * dt)
        velocity += turned(turn, gained + b * once + c * twice)
        turn = product(turn, _quaternion(rotation, square))
        path += np.sqrt(square)
        total += dt
    return _Halves(turn, velocity, position, total, path)


def _joined(halves: _Halves, bias: Array) -> Array:
    """Return rate, specific force and length of both steps, shape (n, 2, 7).

    Constant over each step, they give the turns of the halves, and together velocity and position
    of the whole.
    """
    first, second = halves.dt[..., None, None]
    rotation = np.moveaxis(vectors(halves.turn), 0, 2)
    after = matrices(unit(halves.turn[:, 0]))
    (to_velocity, to_velocity_2), (to_position, to_position_2) = _by_force(rotation)
    v_1, v_2 = np.moveaxis(halves.velocity, 0, 2)[..., None]
    p_1, p_2 = np.moveaxis(halves.position, 0, 2)[..., None]
    whole = np.concatenate([v_1 + after @ v_2, p_1 + v_1 * second + after @ p_2], axis=1)
    system = np.empty((len(bias), 6, 6))
    system[:, :3, :3] = to_velocity * first
    system[:, :3, 3:] = after @ to_velocity_2 * second
    system[:, 3:, :3] = to_position * first**2 + to_velocity * first * second
    system[:, 3:, 3:] = after @ to_position_2 * second**2
    force = np.linalg.solve(system, whole).reshape(-1, 2, 3) + bias[:, None, 3:]
    length = halves.dt.T[..., None]
    rate = np.swapaxes(rotation, 0, 1) / length + bias[:, None, :3]
    return np.concatenate([rate, force, length], axis=2)


def _by_force(rotation: Array) -> tuple[Array, Array]:
    """Return velocity and position by a constant specific force, of a unit of time.

    Parameters
    ----------
    rotation : ndarray, shape (..., 3)
        Turned through at a constant rate (rad).

    Returns
    -------
    tuple of ndarray, shape (..., 3, 3)
        Integral, and integral of the integral, of the rotation's matrix.
    """
    b, c, d = (k[..., None, None] for k in _coefficients(np.sum(rotation**2, axis=-1)))
    once = -np.cross(rotation[..., None, :], np.eye(3))
    twice = once @ once
    return np.eye(3) + b * once + c * twice, 0.5 * np.eye(3) + c * once + d * twice


def _coefficients(square: Array) -> tuple[Array, Array, Array]:
    """Return (1 - cos x) / x^2, (x - sin x) / x^3, (x^2 / 2 - 1 + cos x) / x^4 of small squares."""
    x = square
    return (
        1 / 2 - x * (1 / 24 - x * (1 / 720 - x * (1 / 40320 - x / 3628800))),
        1 / 6 - x * (1 / 120 - x * (1 / 5040 - x * (1 / 362880 - x / 39916800))),
        1 / 24 - x * (1 / 720 - x * (1 / 40320 - x * (1 / 3628800 - x / 479001600))),
    )


def _quaternion(rotation: Array, square: Array) -> Array:
    """Return the quaternion of a small rotation, scalar first, by the series of half the angle."""
    x = square / 4.0
    out = np.empty((4, *square.shape))
    out[0] = 1.0 - x * (1 / 2 - x * (1 / 24 - x * (1 / 720 - x * (1 / 40320 - x / 3628800))))
    share = 1.0 - x * (1 / 6 - x * (1 / 120 - x * (1 / 5040 - x * (1 / 362880 - x / 39916800))))
    out[1:] = 0.5 * share * rotation
    return out
