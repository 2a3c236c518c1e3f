"""True motion as an analytic function of time, for exact rate and specific force.

A motion is a geometric path (position and attitude over a path parameter) and the progress along
it over time.  The path parameter counts seconds of moving; where progress halts, the body comes to
rest.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BPoly, BSpline
from scipy.spatial.transform import Rotation, RotationSpline

from magfusion.errors import InputError
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

ATTITUDE_KNOT = 1.0  # s of moving
MAX_RAMP = 1.0  # s from rest to full speed
_DEGREE = 5
WANDER = 10.0  # m; a driver corrects his line over some car lengths


@dataclass(frozen=True)
class Rests:
    """When a motion is at rest (s): first ``start``, then ``pause`` after every ``move``."""

    start: float = 5.0
    move: float = 20.0
    pause: float = 3.0


@dataclass(frozen=True, eq=False)
class SimulatedMotion:
    """A motion, at rest before its start and after its end."""

    position: BSpline  # world position (m) over the path parameter
    attitude: RotationSpline  # world from body over the path parameter
    # derivative of the path parameter by time, over time (s); twice continuously differentiable
    rate: BPoly

    def _progress(self, time: Array) -> tuple[Array, Array, Array]:
        inside = np.clip(time, self.rate.x[0], self.rate.x[-1])
        parameter = self.rate.antiderivative()(inside)
        return parameter, self.rate(inside)[:, None], self.rate.derivative()(inside)[:, None]

    def world_from_body(self, time: Array) -> Rotation:
        """Return the attitude at the times, shape (n,)."""
        return self.attitude(self._progress(time)[0])

    def position_world(self, time: Array) -> Array:
        """Return the body's position (m), shape (n, 3)."""
        return self._path(self._progress(time)[0], 0)

    def _path(self, parameter: Array, order: int) -> Array:
        """Return a derivative of the path (n, 3); SciPy < 1.17 corrupts memory above its degree."""
        if order > self.position.k:
            return np.zeros((*parameter.shape, 3))
        return self.position(parameter, nu=order)

    def velocity_world(self, time: Array) -> Array:
        """Return the body's velocity (m/s), shape (n, 3)."""
        parameter, rate, _ = self._progress(time)
        return self._path(parameter, 1) * rate

    def acceleration_world(self, time: Array) -> Array:
        """Return the body's acceleration (m/s^2), shape (n, 3)."""
        parameter, rate, change = self._progress(time)
        curvature = self._path(parameter, 2) * rate**2
        return curvature + self._path(parameter, 1) * change

    def rate_body(self, time: Array) -> Array:
        """Return the angular rate (rad/s), shape (n, 3)."""
        parameter, rate, _ = self._progress(time)
        return self.attitude(parameter, 1) * rate

    def specific_force_body(self, time: Array, gravity: float) -> Array:
        """Return what an ideal accelerometer measures (m/s^2), shape (n, 3)."""
        force_world = self.acceleration_world(time) + np.array([0.0, 0.0, gravity])
        return self.world_from_body(time).inv().apply(force_world)

    def trajectory(self, time: Array) -> Trajectory:
        """Return poses and velocities at the times, shape (n,)."""
        return Trajectory(
            time=time,
            world_from_body=self.world_from_body(time).as_matrix(),
            position_world=self.position_world(time),
            velocity_world=self.velocity_world(time),
        )


def random_walk_motion(
    rng: np.random.Generator,
    duration: float,
    box_world: Array,
    speed: float = 0.5,
    tilt_rms: float = 0.1,
    heading_rate_rms: float = 0.3,
    rests: Rests | None = None,
) -> SimulatedMotion:
    """Return a smooth random walk inside a box, as of a person or a robot that carries the body.

    Parameters
    ----------
    duration : float
        (s)
    box_world : ndarray, shape (2, 3)
        Lower and upper corner (m) of the path's bounds.
    speed : float
        Approximate mean speed while moving (m/s); lower where the box is small, to stay smooth.
    tilt_rms : float
        Of the angle between the body's z axis and the vertical (rad), approximate.
    heading_rate_rms : float
        Approximate (rad/s).

    Raises
    ------
    InputError
        If the box, the duration or the speed is invalid.
    """
    rate, moving, knots = _progress(duration, rests or Rests())
    tilt = rng.normal(0.0, tilt_rms / np.sqrt(2.0), (len(knots), 3)) * [1.0, 1.0, 0.0]
    steps = rng.normal(0.0, heading_rate_rms * ATTITUDE_KNOT, len(knots))
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(steps)
    attitudes = Rotation.from_euler("z", heading[:, None]) * Rotation.from_rotvec(tilt)
    path = _path_in_box(rng, box_world, speed, moving)
    return SimulatedMotion(path, RotationSpline(knots, attitudes), rate)


def turning_motion(
    rng: np.random.Generator,
    duration: float,
    box_world: Array,
    speed: float = 0.3,
    rate_rms: float = 0.6,
    rests: Rests | None = None,
    interval: float = ATTITUDE_KNOT,
) -> SimulatedMotion:
    """Return a rotation about all axes, as of a body rotated by hand for calibration.

    `rng`, `duration`, `box_world`, `speed`, `rests`: as in `random_walk_motion`. `rate_rms`: of the
    angular rate (rad/s), approximate. `interval`: of the knots of the attitude (s); a turn of more
    than pi between two is shortened. Raises InputError if the box, the duration or the speed is
    invalid.
    """
    rate, moving, knots = _progress(duration, rests or Rests(), interval)
    attitudes = [Rotation.random(rng=rng)]
    for step in rng.normal(0.0, rate_rms * interval / np.sqrt(3.0), (len(knots) - 1, 3)):
        attitudes.append(attitudes[-1] * Rotation.from_rotvec(step))
    path = _path_in_box(rng, box_world, speed, moving)
    return SimulatedMotion(path, RotationSpline(knots, Rotation.concatenate(attitudes)), rate)


def driving_motion(
    rng: np.random.Generator,
    duration: float,
    box_world: Array,
    speed: float = 1.0,
    rests: Rests | None = None,
) -> SimulatedMotion:
    """Return laps of a vehicle along the longer walls of a box: it drives along its x axis, level.

    `rng`, `duration`, `box_world`, `speed`, `rests`: as in `random_walk_motion`. Raises InputError
    if the box, the duration or the speed is invalid.
    """
    rate, moving, _ = _progress(duration, rests or Rests(pause=0.0, move=duration))
    box = _checked_box(box_world, speed)
    seconds = np.arange(np.ceil(moving) + 2 * _DEGREE)
    course = _lap(box, speed * seconds)
    # Off the line by a fifth of the width, over some ten metres.
    width, across = (
        float(np.min(np.diff(box[:, :2], axis=0))),
        int(np.argmin(np.ptp(box[:, :2], 0))),
    )
    knots = np.arange(0.0, speed * len(seconds) + WANDER, WANDER)
    lateral = np.interp(speed * seconds, knots, rng.uniform(-0.1, 0.1, len(knots)) * width)
    course[:, across] += lateral
    path = BSpline(np.arange(len(seconds) + _DEGREE + 1.0) - _DEGREE, course, _DEGREE)
    along = np.arange(0.0, np.ceil(moving) + 2.0, 0.5 * ATTITUDE_KNOT)
    east, north, _ = path(along, nu=1).T
    heading = np.arctan2(north, east)
    return SimulatedMotion(
        path, RotationSpline(along, Rotation.from_euler("z", heading[:, None])), rate
    )


def _lap(box: Array, distance: Array) -> Array:
    """Return the places (n, 3) at distances (n,) (m) along two straights and two half circles."""
    size, long = np.diff(box[:, :2], axis=0)[0], int(np.argmax(np.ptp(box[:, :2], axis=0)))
    radius = 0.4 * float(size[1 - long])
    straight = max(float(size[long]) - 2.0 * radius, 0.0)
    half = straight + np.pi * radius
    lap, rest = np.divmod(distance, half)
    angle = np.maximum(rest - straight, 0.0) / max(radius, 1e-9)
    forth = np.minimum(rest, straight) - straight / 2.0 + radius * np.sin(angle)
    lateral = -radius * np.cos(angle)
    sign = np.where(lap % 2.0 == 0.0, 1.0, -1.0)
    out = np.tile(np.mean(box, axis=0), (len(distance), 1))
    out[:, long] += sign * forth
    out[:, 1 - long] += sign * lateral
    return out


def static_motion(position_world: Array, world_from_body: Rotation) -> SimulatedMotion:
    """Return a body that is always at rest."""
    still = BSpline(np.array([0.0, 1.0]), np.asarray(position_world, dtype=float)[None], 0)
    attitude = RotationSpline([0.0, 1.0], Rotation.concatenate([world_from_body] * 2))
    return SimulatedMotion(still, attitude, BPoly(np.zeros((1, 1)), np.array([0.0, 1.0])))


def progress_rate(duration: float, rests: Rests) -> BPoly:
    """Return the rate of progress: quintic ramps between 0 (rest) and 1 (full speed)."""
    if not duration > 0.0:
        raise InputError(f"duration: found {duration} s; give a positive number of seconds")
    if rests.start < 0.0 or rests.pause < 0.0 or rests.move <= 0.0:
        raise InputError(f"rests: found {rests}; give start and pause >= 0 and move > 0 (s)")
    times, rates = [0.0], [0.0]
    begin = rests.start
    while begin < duration:
        end = min(begin + rests.move, duration)
        ramp = min(MAX_RAMP, (end - begin) / 3.0)
        times += [begin, begin + ramp, end - ramp, end]
        rates += [0.0, 1.0, 1.0, 0.0]
        begin = end + rests.pause
    times.append(duration)
    rates.append(0.0)
    # The two ends of a rest of zero length are one knot.
    keep = np.append(np.diff(times) > 1e-9, True)
    keep[0] = keep[0] or not keep[1]
    knots, values = np.array(times)[keep], np.array(rates)[keep]
    return BPoly.from_derivatives(knots, [[value, 0.0, 0.0] for value in values])


def _progress(
    duration: float, rests: Rests, interval: float = ATTITUDE_KNOT
) -> tuple[BPoly, float, Array]:
    """Return the rate of progress, the seconds of moving, and the knots of attitude over them."""
    rate = progress_rate(duration, rests)
    moving = float(rate.integrate(rate.x[0], rate.x[-1]))
    return rate, moving, np.arange(np.ceil(moving / interval) + 2) * interval


def _path_in_box(
    rng: np.random.Generator, box_world: Array, speed: float, moving: float
) -> BSpline:
    """Return a quintic B-spline whose control points, and hence all of it, lie in the box."""
    box = _checked_box(box_world, speed)
    # Control points one unit apart, uniform in the box, give a mean speed of 0.17 diagonals a unit.
    spacing = max(0.17 * float(np.linalg.norm(box[1] - box[0])) / speed, 1.0)
    count = int(np.ceil(moving / spacing)) + 1 + _DEGREE
    knots = (np.arange(count + _DEGREE + 1) - _DEGREE) * spacing
    return BSpline(knots, rng.uniform(box[0], box[1], (count, 3)), _DEGREE)


def _checked_box(box_world: Array, speed: float) -> Array:
    box = np.asarray(box_world, dtype=float)
    if box.shape != (2, 3) or np.any(box[0] > box[1]):
        raise InputError(
            f"box: found {box.tolist()}; give the lower and the upper corner, three metres each"
        )
    if not speed > 0.0:
        raise InputError(f"speed: found {speed} m/s; give a positive number")
    return box
