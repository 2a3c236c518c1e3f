"""Attitude and motion between inertial samples, without a loop over samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.quaternion import components, cross, of_vectors, product, unit
from magfusion.model.site import MotionModel
from magfusion.units import Array, BoolArray, IntArray

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

CHUNK = 65_536  # samples at a time, to fit the CPU cache
LONG = 1 << 18  # samples whose rotations are multiplied at once


def _increments(time: Array, gyro_body: Array) -> Array:
    """Return the rotation vectors from each sample to the next, second-order coning included."""
    before, after = gyro_body[:-1], gyro_body[1:]
    dt = (time[1:] - time[:-1])[:, None]
    coning = cross(before.T, after.T).T * dt**2 / 12.0
    return np.asarray(0.5 * (before + after) * dt + coning)


def _prefix_products(quaternion: Array) -> Array:
    """Return the products of the first 1, 2, ... rotations, by neighbouring pairs.

    From and to shape (4, n), scalar first.
    """
    n = quaternion.shape[1]
    out = quaternion.copy()
    if n == 1:
        return out
    out[:, 1::2] = _prefix_products(product(quaternion[:, : n - 1 : 2], quaternion[:, 1::2]))
    if n > 2:
        out[:, 2::2] = product(out[:, 1 : n - 1 : 2], quaternion[:, 2::2])
    return out


def attitude_from_gyro(time: Array, gyro_body: Array) -> Rotation:
    """Return ``body(0)_from_body(k)`` for every sample.

    `time` (n,) (s). `gyro_body` (n, 3) (rad/s), bias removed. Returns n rotations, the first the
    identity.
    """
    return Rotation.from_quat(turn_from_gyro(time, gyro_body).T, scalar_first=True)


def turn_from_gyro(time: Array, gyro_body: Array) -> Array:
    """Return `attitude_from_gyro` as quaternions, shape (4, n), scalar first."""
    out = np.empty((4, len(time)))
    out[:, :1] = [[1.0], [0.0], [0.0], [0.0]]
    for lo in range(0, len(time), LONG):
        piece = slice(lo, lo + LONG + 1)  # from the last rotation of the previous piece
        steps = np.concatenate(
            [out[:, lo : lo + 1], of_vectors(_increments(time[piece], gyro_body[piece]).T)], axis=1
        )
        out[:, piece] = unit(_prefix_products(steps))
    return out


def attitude_at(attitude: Rotation, time: Array, gyro_body: Array, wanted: Array) -> Rotation:
    """Return the attitude at other times, from the nearest earlier sample and its rate.

    `attitude`: one for each sample, as from `attitude_from_gyro`. `time` (n,), `gyro_body` (n, 3)
    (rad/s). `wanted` (m,): times (s); outside the stream the end rate is extended. Returns m
    rotations.
    """
    result = turn_at(components(attitude), time, gyro_body, wanted)
    return Rotation.from_quat(result.T, scalar_first=True)


def turn_at(turn: Array, time: Array, gyro_body: Array, wanted: Array) -> Array:
    """Return `attitude_at` of and as quaternions, shape (4, n) and (4, m), scalar first."""
    out = np.empty((4, len(wanted)))
    for lo in range(0, len(wanted), CHUNK):
        rows = slice(lo, lo + CHUNK)
        index = _sample_before(time, wanted[rows])
        start_time = _turn_since(index, time, gyro_body, wanted[rows])
        out[:, rows] = product(turn[:, index], start_time)
    return out


def attitude_from_gyro_at(time: Array, gyro_body: Array, wanted: Array) -> Rotation:
    """Return the attitude at some times; faster than all samples for a long stream.

    `time` (n,) (s). `gyro_body` (n, 3) (rad/s), bias removed. `wanted` (m,): times (s); outside the
    stream the end rate is extended. Returns m rotations, as of `attitude_at` on the chain of
    `attitude_from_gyro`.
    """
    return Rotation.from_quat(turn_from_gyro_at(time, gyro_body, wanted).T, scalar_first=True)


def turn_from_gyro_at(time: Array, gyro_body: Array, wanted: Array) -> Array:
    """Return `attitude_from_gyro_at` as quaternions, shape (4, m), scalar first."""
    index = _sample_before(time, wanted)
    quaternion = np.tile([[1.0], [0.0], [0.0], [0.0]], len(wanted))
    propagated = quaternion[:, :1]
    for lo in range(0, len(time) - 1, CHUNK):
        piece = slice(lo, lo + CHUNK + 1)
        steps = of_vectors(_increments(time[piece], gyro_body[piece]).T)
        count = steps.shape[1]
        here = np.flatnonzero((index > lo) & (index <= lo + count))
        rotated = product(propagated, _products_of_first(steps, np.append(index[here] - lo, count)))
        quaternion[:, here] = rotated[:, :-1]
        propagated = rotated[:, -1:]
    start_time = _turn_since(index, time, gyro_body, wanted)
    return product(quaternion, start_time)


def _products_of_first(quaternion: Array, count: IntArray) -> Array:
    """Return the products of the first rotations for each count, by products of pairs.

    From shape (4, n) to shape (4, len(count)), scalar first.
    """
    n = quaternion.shape[1]
    if n == 1:
        return np.where(count > 0, quaternion, [[1.0], [0.0], [0.0], [0.0]])
    pairs = product(quaternion[:, : n - 1 : 2], quaternion[:, 1::2])
    out = _products_of_first(pairs, count // 2)
    odd = np.flatnonzero(count % 2)
    if len(odd):
        out[:, odd] = product(out[:, odd], quaternion[:, count[odd] - 1])
    return out


def _sample_before(time: Array, wanted: Array) -> IntArray:
    return np.searchsorted(time[1:], wanted, side="right")


def _turn_since(index: IntArray, time: Array, gyro_body: Array, wanted: Array) -> Array:
    """Return the rotation from samples to the times that follow, shape (4, m), scalar first."""
    after = np.minimum(index + 1, len(time) - 1)
    span = np.where(after > index, time[after] - time[index], 1.0)
    ahead = wanted - time[index]
    share = np.minimum(np.maximum(0.5 * ahead / span, 0.0), 0.5)[:, None]
    rate = (1.0 - share) * gyro_body[index] + share * gyro_body[after]
    return of_vectors((rate * ahead[:, None]).T)


def mean_about(time: Array, vector: Array, wanted: Array, span: float) -> Array:
    """Return the means of sampled vectors over a span centred at some times, shape (m, 3).

    `time` (n,) (s), `vector` (n, 3), `wanted` (m,) (s). `span`: without a sample in it, the nearest
    one is used (s).
    """
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(vector, axis=0)])
    lo = np.searchsorted(time, wanted - span / 2)
    hi = np.maximum(np.searchsorted(time, wanted + span / 2), lo + 1)
    hi = np.minimum(hi, len(time))
    lo = np.minimum(lo, hi - 1)
    return (total[hi] - total[lo]) / (hi - lo)[:, None]


def triad(field_world: Array, up_body: Array, field_body: Array) -> Array:
    """Return attitudes with the vertical exact and the heading from the field (TRIAD).

    `field_world` (3,): of any length, as all vectors here; not vertical. `up_body`,
    `field_body` (..., 3). Returns (..., 3, 3): world_from_body.
    """

    def axes(up: Array, field: Array) -> Array:
        z = up / np.linalg.norm(up, axis=-1, keepdims=True)
        east = np.cross(field, z)
        x = east / np.linalg.norm(east, axis=-1, keepdims=True)
        return np.stack([x, np.cross(z, x), z], axis=-1)

    world = axes(np.array([0.0, 0.0, 1.0]), field_world)
    return world @ np.swapaxes(axes(up_body, field_body), -1, -2)


def resting(
    time: Array,
    gyro_body: Array,
    accel_body: Array,
    span: float | None = None,
    *,
    motion: MotionModel,
    at: IntArray | None = None,
) -> BoolArray:
    """Return at which samples the platform is at rest.

    `time` (n,) (s), `gyro_body`, `accel_body` (n, 3) (rad/s, m/s^2). `span`: length of the stretch
    around each sample that must be quiet (s), overriding the model's. `motion`: thresholds of rest.
    `at` (k,): samples to test; default all. Returns (n,) or (k,): where rate and specific force
    scatter about their means by less than the thresholds.
    """
    span = motion.rest_span if span is None else span
    centre = np.concatenate([gyro_body.mean(axis=0), accel_body.mean(axis=0)])
    requested = time if at is None else time[at]
    quiet = np.empty(len(requested), dtype=bool)
    for begin in range(0, len(time), CHUNK):
        own: slice | IntArray = slice(begin, begin + CHUNK)
        if at is not None:
            own = np.flatnonzero((at >= begin) & (at < begin + CHUNK))
        here = time[begin : begin + CHUNK]
        first = np.searchsorted(time, here[0] - span / 2)
        last = np.searchsorted(time, here[-1] + span / 2, side="right")
        lo = np.searchsorted(time[first:last], requested[own] - span / 2)
        hi = np.searchsorted(time[first:last], requested[own] + span / 2, side="right")
        both = np.concatenate([gyro_body[first:last], accel_body[first:last]], axis=1)
        gyro, accel = _variance(both - centre, lo, hi).T
        quiet[own] = (gyro < motion.rest_gyro**2) & (accel < motion.rest_accel**2)
    inside = (requested - span / 2 >= time[0]) & (requested + span / 2 <= time[-1])
    return quiet & inside


def _variance(centred: Array, lo: IntArray, hi: IntArray) -> Array:
    """Return the sums of each vector's variances over rows from ``lo`` to before ``hi``, (n, 2)."""
    total = np.zeros((len(centred) + 1, 12))
    np.cumsum(np.concatenate([centred, centred**2], axis=1), axis=0, out=total[1:])
    mean = (total[hi] - total[lo]) / (hi - lo)[:, None]
    variance = mean[:, 6:] - mean[:, :6] ** 2
    return np.asarray(np.sum(variance.reshape(-1, 2, 3), axis=2))
