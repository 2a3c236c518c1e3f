"""Propagation of a state by inertial samples, one strapdown step each, with its covariance.

Each step continues from the last: nothing is integrated again from the epoch.  Motion and
covariance of several samples are computed together, in closed form except one matrix product per
sample.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.estimation.graph.dead_reckoning_error import step_noise, step_transitions
from magfusion.estimation.graph.inertial import STEP
from magfusion.estimation.graph.preintegration import in_gap, step_means
from magfusion.estimation.graph.process_noise import ProcessNoise
from magfusion.estimation.graph.state import MOTION, POSITION, ROTATION, VELOCITY, State
from magfusion.model.parameters import Block, corrected_imu, inertial_blocks, retract
from magfusion.model.samples import ImuSamples
from magfusion.model.site import Site
from magfusion.model.strapdown_steps import steps_of
from magfusion.model.trajectory import interpolated
from magfusion.units import Array, BoolArray


@dataclass(frozen=True, eq=False)
class PropagationStart:
    """The state of an epoch, and all that its propagation needs."""

    state: State  # of the estimator
    site: Site  # its gravity and the noise of its IMU
    blocks: tuple[Block, ...]  # calibration parameters in the state's tangent
    process_noise: ProcessNoise  # of the calibration
    time_offset: float  # added to the IMU's stamps (s)
    usual: float  # sampling interval of the IMU (s)


@dataclass(frozen=True, eq=False)
class Passage:
    """Propagated states, and their transition and noise since the epoch."""

    time: Array  # (n,) (s)
    world_from_body: Array  # (n, 3, 3)
    position_world: Array  # (n, 3) (m)
    velocity_world: Array  # (n, 3) (m/s)
    # gyro_body, accel_body: (n, 3), at these times, without bias (rad/s, m/s^2)
    gyro_body: Array
    accel_body: Array
    # (n, 15, 15 or 15 + calibration), from the tangent of the epoch's state to errors as defined by
    # `magfusion.estimation.graph.dead_reckoning_error`
    transition: Array
    noise: Array  # (n, 15, 15), covariance of these errors that is added since the epoch

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, chosen: slice | BoolArray) -> "Passage":
        """Return a subset."""
        return Passage(**{name: part[chosen] for name, part in vars(self).items()})


def initial_passage(start: PropagationStart) -> Passage:
    """Return the start of a propagation; its rate and specific force are not known yet."""
    state = start.state
    width = len(state.cov) if inertial_blocks(start.blocks) else MOTION
    transition = np.eye(MOTION, width)
    transition[ROTATION, ROTATION] = transition[POSITION, POSITION] = state.world_from_body
    none = np.zeros((1, 3))
    return Passage(
        np.array([state.time]),
        state.world_from_body[None],
        state.position_world[None],
        state.velocity_world[None],
        none,
        none,
        transition[None],
        np.zeros((1, MOTION, MOTION)),
    )


def propagate_passage(
    start: PropagationStart, last: Passage, imu: ImuSamples, wanted: Array, *, blind: bool = False
) -> tuple[Passage, Passage]:
    """Propagate a passage to some times, and to the newest inertial sample.

    Parameters
    ----------
    last : Passage
        Of one time: the end of the previous propagation.
    imu : ImuSamples
        Including the one before that time.
    wanted : ndarray, shape (n,)
        Rising, not before the last time nor after the newest sample (s).
    blind : bool
        Whether samples are substitutes for inertial ones: they have the noise of a gap.

    Returns
    -------
    Passage, Passage
        At these times, and at the newest sample.
    """
    begin, stamps = last.time[0], imu.time + start.time_offset
    grid = np.union1d(stamps[stamps > begin], np.append(wanted, begin))
    passage = _along(start, last, imu, grid, blind=blind)
    return passage.rows(np.isin(grid, wanted)), passage.rows(slice(-1, None))


def _along(
    start: PropagationStart, last: Passage, imu: ImuSamples, grid: Array, *, blind: bool
) -> Passage:
    """Return the passage at the times of a grid that starts at its time."""
    state, stamps = start.state, imu.time + start.time_offset
    samples = corrected_imu(state.calibration, start.blocks, imu)
    bias = np.concatenate([state.gyro_bias_body, state.accel_bias_body])
    read = interpolated(grid, stamps, np.hstack([samples.gyro_body, samples.accel_body]) - bias)
    dt = np.diff(grid)
    mean = step_means(grid, read)
    rotated = steps_of(mean[:, :3], mean[:, 3:], dt)
    count = len(grid)
    rotation = np.empty((count, 3, 3))
    rotation[0] = last.world_from_body[0]
    for k in range(count - 1):
        rotation[k + 1] = rotation[k] @ rotated.rotation[k]
    before, gravity = rotation[:-1], np.array([0.0, 0.0, start.site.gravity])
    gained = (before @ rotated.velocity[..., None])[..., 0] - gravity * dt[:, None]
    velocity = np.cumsum(np.concatenate([last.velocity_world, gained]), axis=0)
    moved = (before @ rotated.position[..., None])[..., 0] - 0.5 * gravity * dt[:, None] ** 2
    moved += velocity[:-1] * dt[:, None]
    position = np.cumsum(np.concatenate([last.position_world, moved]), axis=0)
    gap = in_gap(stamps, grid, start.usual) | blind
    noise_of = start.site.platform.imu
    middle = 0.5 * (before + rotation[1:])
    force = (middle @ mean[:, 3:, None])[..., 0]
    steps, added = step_transitions(dt, middle, force), step_noise(dt, noise_of, gap)
    by_calibration = _by_calibration(start, imu, grid)
    transition = np.empty((count, *last.transition.shape[1:]))
    noise = np.empty((count, MOTION, MOTION))
    transition[0], noise[0] = last.transition[0], last.noise[0]
    for k in range(count - 1):
        step = steps[k]
        np.matmul(step, transition[k], out=transition[k + 1])
        if by_calibration is not None:
            # A parameter's effect on a sample is that of the bias with the opposite sign.
            own = by_calibration[k]
            transition[k + 1, :9, MOTION:] -= step[:9, 9:] @ own
        np.matmul(step @ noise[k], step.T, out=noise[k + 1])
        noise[k + 1] += added[k]
    return Passage(grid, rotation, position, velocity, read[:, :3], read[:, 3:], transition, noise)


def _by_calibration(start: PropagationStart, imu: ImuSamples, grid: Array) -> Array | None:
    """Return specific force and rate of each step by the calibration, shape (n, 6, dimension)."""
    acting, calibration = inertial_blocks(start.blocks), start.state.calibration
    if not acting:
        return None
    size = len(start.state.cov) - MOTION
    by_sample = np.zeros((len(imu), 6, size))
    for block in acting:
        for column, sigma in zip(range(size)[block.columns], block.sigma, strict=True):
            step = np.zeros(size)
            step[column] = STEP * sigma
            ahead, behind = (
                corrected_imu(retract(calibration, start.blocks, way * step), acting, imu)
                for way in (1.0, -1.0)
            )
            by_sample[:, :3, column] = ahead.accel_body - behind.accel_body
            by_sample[:, 3:, column] = ahead.gyro_body - behind.gyro_body
            by_sample[:, :, column] /= 2.0 * step[column]
    stamps = imu.time + start.time_offset
    read = interpolated(grid, stamps, by_sample.reshape(len(imu), -1)).reshape(len(grid), 6, size)
    return np.asarray(0.5 * (read[1:] + read[:-1]))


def ahead(passage: Passage, horizon: float, gravity: float, cov_body: Array) -> Passage:
    """Return a passage extrapolated with constant rate and constant specific force in world axes.

    `horizon` (s), `gravity` (m/s^2). `cov_body` (9, 9): of rotation, position and velocity: the
    cost of that assumption.
    """
    count = len(passage)
    length = np.full(count, horizon)
    rotation = passage.world_from_body
    force = (rotation @ passage.accel_body[..., None])[..., 0]
    accel = force - [0.0, 0.0, gravity]
    step = step_transitions(length, rotation, force)
    back = np.swapaxes(step, 1, 2)
    turn = np.zeros((count, 9, 9))
    for part in (ROTATION, POSITION, VELOCITY):
        turn[:, part, part] = rotation
    noise = step @ passage.noise @ back
    noise[:, :9, :9] += turn @ cov_body @ np.swapaxes(turn, 1, 2)
    return Passage(
        passage.time + horizon,
        rotation @ steps_of(passage.gyro_body, passage.accel_body, length).rotation,
        passage.position_world + horizon * passage.velocity_world + 0.5 * horizon**2 * accel,
        passage.velocity_world + horizon * accel,
        passage.gyro_body,
        passage.accel_body,
        step @ passage.transition,
        noise,
    )


def in_tangent(passage: Passage) -> tuple[Array, Array]:
    """Return transition and noise in the tangent of the propagated states."""
    turn = np.zeros((len(passage), MOTION, MOTION))
    turn[:] = np.eye(MOTION)
    for part in (ROTATION, POSITION):
        turn[:, part, part] = np.swapaxes(passage.world_from_body, 1, 2)
    return turn @ passage.transition, turn @ passage.noise @ np.swapaxes(turn, 1, 2)


def states_along(start: PropagationStart, passage: Passage) -> list[State]:
    """Return the states of a passage, with covariances of all that the epoch's state has."""
    state, (transition, noise) = start.state, in_tangent(passage)
    if len(passage) == 0:
        return []
    prior, width = state.cov, transition.shape[2]
    remaining = transition @ prior[:width]
    motion = remaining[:, :, :width] @ np.swapaxes(transition, 1, 2) + noise
    cov = np.empty((len(passage), *prior.shape))
    elapsed = passage.time[-1] - state.time
    walked = start.process_noise.cov(state.calibration, passage.time[-1], elapsed)
    cov[:, MOTION:, MOTION:] = prior[MOTION:, MOTION:] + walked
    cov[:, :MOTION] = remaining
    cov[:, MOTION:, :MOTION] = np.swapaxes(remaining[:, :, MOTION:], 1, 2)
    cov[:, :MOTION, :MOTION] = 0.5 * (motion + np.swapaxes(motion, 1, 2))
    parts = zip(
        passage.time.tolist(),
        passage.world_from_body,
        passage.position_world,
        passage.velocity_world,
        cov,
        strict=True,
    )
    kept = state.accel_bias_body, state.gyro_bias_body, state.calibration
    return [
        State(time, rotation, position, velocity, *kept, own)
        for time, rotation, position, velocity, own in parts
    ]
