"""State of a running estimator, and the tangent space of its covariance.

Tangent: rotation and position (body axes, right perturbation of the pose, GTSAM's chart), velocity
(world), accelerometer and gyro bias, then the calibration as `magfusion.model.parameters` has it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.model.parameters import Block, Calibration, difference, retract
from magfusion.model.short_repr import short_repr
from magfusion.model.trajectory import PoseAccess, Trajectory
from magfusion.units import Array, IntArray

MOTION = 15
ROTATION, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
ACCEL_BIAS, GYRO_BIAS = slice(9, 12), slice(12, 15)


@dataclass(frozen=True, eq=False)
class State(PoseAccess):
    """Motion and calibration at one time.

    Parameters
    ----------
    time : float
        On the log's clock (s).
    world_from_body : ndarray, shape (3, 3)
    position_world : ndarray, shape (3,)
        Of the body's origin, the IMU (m).
    velocity_world : ndarray, shape (3,)
        (m/s)
    accel_bias_body, gyro_bias_body : ndarray, shape (3,)
        (m/s^2) and (rad/s); with a motion prior, the rate in place of the gyro's bias.
    calibration : Calibration
        With its newest estimate.
    cov : ndarray, shape (15 + c, 15 + c)
        Of rotation, position (body axes, right perturbation; rad, m), velocity (world), bias of
        accelerometer and gyro, then of the c numbers of the calibration; squares of these units.
    """

    __repr__ = short_repr

    time: float
    world_from_body: Array
    position_world: Array
    velocity_world: Array
    accel_bias_body: Array
    gyro_bias_body: Array
    calibration: Calibration
    cov: Array

    @cached_property
    def pose(self) -> gtsam.Pose3:
        """Pose as a GTSAM object."""
        return gtsam.Pose3(gtsam.Rot3(self.world_from_body), self.position_world)

    @property
    def position_sigma(self) -> float:
        """Standard deviation of the position, largest axis (m)."""
        return float(np.sqrt(np.max(np.linalg.eigvalsh(self.cov[POSITION, POSITION]))))

    @property
    def rotation_sigma(self) -> float:
        """Standard deviation of the attitude, largest axis (rad)."""
        return float(np.sqrt(np.max(np.linalg.eigvalsh(self.cov[ROTATION, ROTATION]))))


def values_of(states: list[State]) -> gtsam.Values:
    """Return states as values of a graph: pose X(i), velocity V(i) and bias B(i) of each."""
    biases = [np.concatenate([s.accel_bias_body, s.gyro_bias_body]) for s in states]
    poses = [state.pose for state in states]
    return values_from(poses, [state.velocity_world for state in states], biases)


def values_from(
    poses: Sequence[gtsam.Pose3], velocity_world: Sequence[Array], bias_body: Sequence[Array]
) -> gtsam.Values:
    """Return poses X(i), velocities V(i) (m/s) and biases B(i) of some epochs as graph values.

    `bias_body` (6,) each: of the accelerometer, then of the gyro (m/s^2, rad/s).
    """
    step = gtsam.VectorValues()
    for i, (velocity, bias) in enumerate(zip(velocity_world, bias_body, strict=True)):
        step.insert(V(i), velocity)
        step.insert(B(i), bias)
    values = _initial_motion(len(poses)).retract(step)
    for i, pose in enumerate(poses):
        values.insert(X(i), pose)
    return values


@lru_cache(maxsize=32)
def _initial_motion(epochs: int) -> gtsam.Values:
    """Return zero velocities and biases, since inserting a bias takes ten times an update."""
    values, zero = gtsam.Values(), gtsam.imuBias.ConstantBias(np.zeros(3), np.zeros(3))
    for i in range(epochs):
        values.insert(V(i), np.zeros(3))
        values.insert(B(i), zero)
    return values


def moved(state: State, blocks: tuple[Block, ...], step: Array) -> State:
    """Return the state moved by a tangent vector; the covariance stays."""
    calibration = retract(state.calibration, blocks, step[MOTION:])
    return moved_to(state, calibration, step[:MOTION])


def moved_to(state: State, calibration: Calibration, step: Array) -> State:
    """Return the state with its motion moved by a tangent vector (15,), and a new calibration."""
    pose = state.pose.retract(step[:6])
    return replace(
        state,
        world_from_body=pose.rotation().matrix(),
        position_world=np.asarray(pose.translation()),
        velocity_world=state.velocity_world + step[VELOCITY],
        accel_bias_body=state.accel_bias_body + step[ACCEL_BIAS],
        gyro_bias_body=state.gyro_bias_body + step[GYRO_BIAS],
        calibration=calibration,
    )


def between(reference: State, state: State, blocks: tuple[Block, ...]) -> Array:
    """Return the tangent vector that takes ``reference`` to ``state``: the inverse of `moved`."""
    return np.concatenate(
        [
            reference.pose.localCoordinates(state.pose),
            state.velocity_world - reference.velocity_world,
            state.accel_bias_body - reference.accel_bias_body,
            state.gyro_bias_body - reference.gyro_bias_body,
            difference(reference.calibration, state.calibration, blocks),
        ]
    )


@dataclass(frozen=True, eq=False)
class States:
    """States of several epochs as arrays."""

    world_from_body: Array  # (n, 3, 3)
    position_world: Array  # (n, 3) (m)
    velocity_world: Array  # (n, 3) (m/s)
    # returns accelerometer, then gyro bias, shape (n, 6) (m/s^2, rad/s); few measurements use it
    read_bias: Callable[[], Array]

    def __len__(self) -> int:
        return len(self.position_world)

    def rows(self, epoch: IntArray) -> "States":
        """Return the states of some epochs."""
        if len(epoch) == len(self) and np.array_equal(epoch, np.arange(len(self))):
            return self
        return States(
            self.world_from_body[epoch],
            self.position_world[epoch],
            self.velocity_world[epoch],
            lambda: self.read_bias()[epoch],
        )


def states_in(values: gtsam.Values) -> States:
    """Return the states in ``values`` as arrays, in order of their keys."""
    flat = gtsam.utilities.extractPose3(values)

    @cache
    def biases() -> Array:
        return np.array([values.atConstantBias(B(i)).vector() for i in range(len(flat))])

    return States(
        world_from_body=flat[:, :9].reshape(-1, 3, 3),
        position_world=flat[:, 9:],
        velocity_world=gtsam.utilities.extractVectors(values, "v"),
        read_bias=biases,
    )


def states_of(states: list[State]) -> States:
    """Return states as arrays for a measurement."""
    return States(
        world_from_body=np.array([s.world_from_body for s in states]),
        position_world=np.array([s.position_world for s in states]),
        velocity_world=np.array([s.velocity_world for s in states]),
        read_bias=lambda: np.array(
            [np.concatenate([s.accel_bias_body, s.gyro_bias_body]) for s in states]
        ),
    )


def pose_steps(reference: States, states: States) -> Array:
    """Return the tangent vectors (n, 6) that take the poses of ``reference`` to those of states."""
    pairs = zip(_poses(reference), _poses(states), strict=True)
    return np.array([old.localCoordinates(new) for old, new in pairs]).reshape(-1, 6)


def _poses(states: States) -> list[gtsam.Pose3]:
    pairs = zip(states.world_from_body, states.position_world, strict=True)
    return [gtsam.Pose3(gtsam.Rot3(rotation), place) for rotation, place in pairs]


def as_trajectory(states: list[State]) -> Trajectory:
    """Return states as a trajectory with biases and the covariance of the poses."""
    return Trajectory(
        time=np.array([s.time for s in states]),
        world_from_body=np.array([s.world_from_body for s in states]).reshape(-1, 3, 3),
        position_world=np.array([s.position_world for s in states]).reshape(-1, 3),
        velocity_world=np.array([s.velocity_world for s in states]).reshape(-1, 3),
        gyro_bias_body=np.array([s.gyro_bias_body for s in states]).reshape(-1, 3),
        accel_bias_body=np.array([s.accel_bias_body for s in states]).reshape(-1, 3),
        pose_cov=np.array([s.cov[:6, :6] for s in states]).reshape(-1, 6, 6),
    )
