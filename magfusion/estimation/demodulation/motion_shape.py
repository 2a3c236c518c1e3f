"""Interpolated motion between states by the IMU, and its derivative by the IMU's time offset."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from magfusion.estimation.graph.preintegration import low_pass_reach
from magfusion.model.hermite import hermite
from magfusion.model.quaternion import (
    cross,
    inverse,
    matrices,
    of_matrices,
    of_vectors,
    product,
    rotate,
    unit,
    vectors,
)
from magfusion.model.samples import ImuSamples
from magfusion.model.strapdown import turn_at, turn_from_gyro
from magfusion.model.trajectory import Trajectory, interpolated
from magfusion.units import Array

MARGIN = 3  # inertial samples on either side of the requested times
AT_ONCE = 1 << 14  # samples that are rotated at once: intermediate results stay in the cache


class _ByOffset(NamedTuple):
    """Derivatives by the IMU's time offset, at its samples (n, 3) and at the states."""

    # rate, rate_at_states: (rad/s), world axes
    rate: Array
    rate_at_states: Array
    # position, velocity: (m/s), and (m/s^2)
    position: Array
    velocity: Array


@dataclass(frozen=True, eq=False)
class MotionShape:
    """The IMU integrated once over a log, with its errors at the states spread between them."""

    states: Trajectory  # with velocity and biases, at the field epochs
    time: Array  # (n,), of the inertial samples, on the log's clock (s)
    gyro_body: Array  # (n, 3), without the bias (rad/s)
    chain: Array  # (4, n), ``body(0)_from_body(k)``, quaternions, scalar first
    world_from_start: Array  # (4, states), at the states
    spread: Array  # (3, states - 1), rotation error spread between each state and the next (rad)
    world_from_body: Array  # (4, n), at the inertial samples
    # accel_world, velocity_world, position_world: (n, 3), as integrated from rest at the origin
    # (m/s^2, m/s, m)
    accel_world: Array
    velocity_world: Array
    position_world: Array
    gravity: float
    reach: int  # number of inertial samples on either side over which `changing_at` averages
    usual: float  # median interval of the inertial samples (s)

    @staticmethod
    def of(
        states: Trajectory,
        imu: ImuSamples,
        time_offset: float,
        gravity: float,
        reach: int | None = None,
        usual: float | None = None,
    ) -> "MotionShape":
        """Integrate an inertial stream through states.

        `time_offset` (s), `gravity` (m/s^2). `reach`: where the samples are a part of a longer
        stream. `usual`: usual interval of the samples (s), if known.
        """
        if states.velocity_world is None or states.gyro_bias_body is None:
            raise ValueError("states must have velocity and biases")
        assert states.accel_bias_body is not None
        time = imu.time + time_offset
        usual = float(np.median(np.diff(imu.time))) if usual is None else usual
        gyro = imu.gyro_body - interpolated(time, states.time, states.gyro_bias_body)
        accel = imu.accel_body - interpolated(time, states.time, states.accel_bias_body)
        chain = turn_from_gyro(time, gyro)
        at_states = turn_at(chain, time, gyro, states.time)
        known = of_matrices(states.world_from_body)
        world_from_start = product(known, inverse(at_states))
        spread = _between(world_from_start)
        world_from_body, world_accel = np.empty_like(chain), np.empty_like(accel)
        for rows in _pieces(len(time)):
            start = _turn_at(states.time, world_from_start, spread, time[rows])
            world_from_body[:, rows] = product(start, chain[:, rows])
            world_accel[rows] = rotate(world_from_body[:, rows], accel[rows].T).T
        del accel  # each of these takes a good part of the log's memory
        world_accel -= [0.0, 0.0, gravity]
        velocity, position = _integrated(time, world_accel)
        return MotionShape(
            states=states,
            time=time,
            gyro_body=gyro,
            chain=chain,
            world_from_start=world_from_start,
            spread=spread,
            world_from_body=world_from_body,
            accel_world=world_accel,
            velocity_world=velocity,
            position_world=position,
            gravity=gravity,
            reach=low_pass_reach(usual) if reach is None else reach,
            usual=usual,
        )

    def turned_at(self, wanted: Array) -> Array:
        """Return ``body(0)_from_body`` at times (m,) in any order, quaternions (4, m)."""
        near = self._near(np.array([np.min(wanted), np.max(wanted)]))
        return turn_at(self.chain[:, near], self.time[near], self.gyro_body[near], wanted)

    def at(self, wanted: Array, rotated: Array | None = None) -> Trajectory:
        """Return the motion at any times.

        `wanted` (m,): strictly increasing (s). `rotated` (4, m): as of `turned_at`, if known.
        Returns pose and velocity.
        """
        near, known = self._near(wanted), self.states.time
        path = self.time[near], self.position_world[near], self.velocity_world[near]
        position, velocity = hermite(*path, wanted)
        inside = np.minimum(np.maximum(wanted, known[0]), known[-1])
        lack, slope = hermite(known, *self._lack, inside)
        return Trajectory(
            time=wanted,
            world_from_body=self._attitude(wanted, rotated),
            position_world=position + lack + slope * (wanted - inside)[:, None],
            velocity_world=velocity + slope,
        )

    def changing_at(
        self, wanted: Array, rotated: Array | None = None
    ) -> tuple[Trajectory, tuple[Array, Array]]:
        """Return the motion at any times as `at`, and its derivative by the IMU's time offset.

        The states are fixed, and the stream is delayed: every pose changes by the motion in that
        time, minus the change at the states.  Rate and specific force are averaged (`low_passed`),
        since white noise in a derivative would appear as information. Returns pose and velocity;
        (m, 3) each: rotation (rad/s) and position (m/s), world axes.
        """
        near, known, late = self._near(wanted), self.states.time, self._by_offset
        own, (place, speed) = self.time[near], self._with_change
        position, velocity = hermite(own, place[near], speed[near], wanted)
        inside = np.minimum(np.maximum(wanted, known[0]), known[-1])
        lack, slope = hermite(known, *self._lack_with_change, inside)
        position += lack + slope * (wanted - inside)[:, None]
        motion = Trajectory(
            time=wanted,
            world_from_body=self._attitude(wanted, rotated),
            position_world=position[:, :3],
            velocity_world=velocity[:, :3] + slope[:, :3],
        )
        by_rotation = interpolated(wanted, known, late.rate_at_states)
        by_rotation -= interpolated(wanted, own, late.rate[near])
        return motion, (by_rotation, position[:, 3:])

    def _attitude(self, wanted: Array, rotated: Array | None) -> Array:
        rotated = self.turned_at(wanted) if rotated is None else rotated
        start = _turn_at(self.states.time, self.world_from_start, self.spread, wanted)
        return matrices(unit(product(start, rotated)))

    def _near(self, wanted: Array) -> slice:
        """Return the inertial samples needed for some times, with a margin."""
        first, last = np.searchsorted(self.time, wanted[[0, -1]])
        return slice(max(min(first, len(self.time)) - MARGIN, 0), last + MARGIN)

    @cached_property
    def _lack(self) -> tuple[Array, Array]:
        """Errors of the integrated position and velocity at the states, shape (states, 3)."""
        states = self.states
        assert states.velocity_world is not None
        path = self.time, self.position_world, self.velocity_world
        position, velocity = hermite(*path, states.time)
        return states.position_world - position, states.velocity_world - velocity

    @cached_property
    def _with_change(self) -> tuple[Array, Array]:
        """Position and velocity, and their derivatives by the time offset, shape (n, 6)."""
        late = self._by_offset
        return (
            np.concatenate([self.position_world, late.position], axis=1),
            np.concatenate([self.velocity_world, late.velocity], axis=1),
        )

    @cached_property
    def _lack_with_change(self) -> tuple[Array, Array]:
        """As `_lack`, and the derivatives fixed by the states, shape (states, 6)."""
        states = self.states
        assert states.velocity_world is not None
        place, speed = hermite(self.time, *self._with_change, states.time)
        place, speed = -place, -speed
        place[:, :3] += states.position_world
        speed[:, :3] += states.velocity_world
        return place, speed

    @cached_property
    def _by_offset(self) -> "_ByOffset":
        known = self.states.time
        rate, tilted = self._averaged(self.gyro_body), np.empty_like(self.accel_world)
        for rows in _pieces(len(rate)):
            rate[rows] = rotate(self.world_from_body[:, rows], rate[rows].T).T
        at_states = interpolated(known, self.time, rate)
        # The rotation that the states prevent tilts the specific force.
        for rows in _pieces(len(rate)):
            force = self.accel_world[rows] + np.array([0.0, 0.0, self.gravity])
            fixed = interpolated(self.time[rows], known, at_states)
            tilted[rows] = cross(fixed.T, force.T).T
        speed, moved = _integrated(self.time, tilted)
        del tilted
        moved -= self.velocity_world
        speed -= self.accel_world
        position = self._averaged(moved)
        del moved
        # Near a gap, and at the ends, a mean is of another time: the speed gained since the
        # beginning must not matter there.
        start_time = self.time - self.time[0]
        late = self._averaged(start_time) - start_time
        uneven = np.flatnonzero(np.abs(late) > 0.5 * self.usual)
        position[uneven] -= late[uneven, None] * speed[uneven]
        velocity = self._averaged(speed)
        del speed
        return _ByOffset(rate, at_states, position, velocity)

    def _averaged(self, values: Array) -> Array:
        return uniform_filter1d(values, 2 * self.reach + 1, axis=0, mode="nearest")


def motion_at(
    states: Trajectory, imu: ImuSamples, time_offset: float, gravity: float, wanted: Array
) -> Trajectory:
    """Return the motion at any times, interpolated through the states by the IMU.

    `states`: with velocity and biases, at the field epochs. `time_offset` (s), `gravity` (m/s^2).
    `wanted` (m,): strictly increasing (s). Returns pose and velocity at ``wanted``.
    """
    return MotionShape.of(states, imu, time_offset, gravity).at(wanted)


def _integrated(time: Array, rate: Array) -> tuple[Array, Array]:
    """Return the integral of samples (n, 3) that are linear in between, and its integral."""
    once, twice = np.zeros((2, *rate.shape))
    for rows in _pieces(len(time) - 1):
        later = slice(rows.start + 1, rows.stop + 1)
        before, after = rate[rows], rate[later]
        step = (time[later] - time[rows])[:, None]
        gained = 0.5 * (before + after) * step
        gained[0] += once[rows.start]
        np.cumsum(gained, axis=0, out=once[later])
        gained = once[rows] * step + (2.0 * before + after) * step**2 / 6.0
        gained[0] += twice[rows.start]
        np.cumsum(gained, axis=0, out=twice[later])
    return once, twice


def _pieces(count: int) -> Iterator[slice]:
    """Yield slices of rows that fit the cache."""
    for begin in range(0, count, AT_ONCE):
        yield slice(begin, min(begin + AT_ONCE, count))


def _between(turn: Array) -> Array:
    """Return the rotation vectors between neighbours, (4, states) to (3, states - 1) (rad)."""
    between = product(inverse(turn[:, :-1]), turn[:, 1:])
    if not between.shape[1]:
        return np.zeros((3, 0))
    return vectors(between)


def _turn_at(known: Array, turn: Array, between: Array, wanted: Array) -> Array:
    """Interpolate slowly varying rotations along great circles, constant beyond the ends.

    From shape (4, states) to shape (4, m), scalar first; ``between`` as of `_between`.
    """
    if len(known) == 1:
        return np.repeat(turn, len(wanted), axis=1)
    inside = np.minimum(np.maximum(wanted, known[0]), known[-1])
    if len(known) == 2:
        share = (inside - known[0]) / (known[1] - known[0])
        return product(turn[:, :1], of_vectors(share * between))
    index = np.searchsorted(known, inside, side="right") - 1
    index = np.minimum(np.maximum(index, 0), len(known) - 2)
    share = (inside - known[index]) / (known[1:] - known[:-1])[index]
    return product(turn[:, index], of_vectors(share * between[:, index]))
