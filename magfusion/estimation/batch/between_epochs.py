"""The smoothed motion between the epochs, with its covariance propagated by the inertial stream.

Given the states at both ends of an interval, the motion in between is a Gauss-Markov process that
the inertial stream drives.  Its mean is `motion_at`; here is its covariance, conditioned on both
ends with their correlation.  Nothing is interpolated.
"""

from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.estimation.batch.batch import Smoothed
from magfusion.estimation.demodulation.motion_shape import motion_at
from magfusion.estimation.graph.considered import responses
from magfusion.estimation.graph.dead_reckoning_error import step_noise, step_transitions
from magfusion.estimation.graph.preintegration import GAP_SAMPLES
from magfusion.estimation.graph.state import MOTION
from magfusion.estimation.solve.bordered import eliminate
from magfusion.model.parameters import corrected_imu
from magfusion.model.samples import ImuSamples, Log
from magfusion.model.site import ImuModel
from magfusion.model.trajectory import Trajectory, interpolated
from magfusion.units import Array, BoolArray

CHUNK = 16_384  # samples at a time: their covariances fit the memory


def at_rate(result: Smoothed, log: Log, rate: Literal["imu"] | float) -> Trajectory:
    """Return the smoothed motion between the first and the last epoch, at another rate.

    Includes the covariance of the poses, with what the tests of the result have added to it.
    `rate`: at every inertial sample, or at this rate (Hz).
    """
    states, offset = result.states, result.calibration.time_offset
    calibration = result.calibration
    imu = calibration.on_log_rate(corrected_imu(calibration, result.blocks, log.imu))
    stamps = imu.time + offset
    # Every sample is a step of the covariance, whether or not it is requested.
    passed, requested = stamps, np.ones(len(stamps), dtype=bool)
    if rate != "imu":
        first, last = np.ceil(states.time[0] * rate), np.floor(states.time[-1] * rate)
        wanted = np.arange(first, last + 1.0) / rate
        passed = np.union1d(stamps, wanted)
        requested = np.isin(passed, wanted)
    inside = (passed >= states.time[0]) & (passed <= states.time[-1])
    passed, requested = passed[inside], requested[inside]
    dense = motion_at(states, imu, offset, result.declared.site.gravity, passed)

    def line(known: Array, values: Array | None) -> Array:
        assert values is not None
        return interpolated(passed, known, values)

    # A random walk between two of its values: the mean is on the straight line.
    gyro_bias = line(states.time, states.gyro_bias_body)
    accel_bias = line(states.time, states.accel_bias_body)
    stream = ImuSamples(passed, line(stamps, imu.gyro_body), line(stamps, imu.accel_body))
    joint = _joint_cov(result)
    own = np.concatenate([joint[:, :6, :6], joint[-1:, MOTION : MOTION + 6, MOTION : MOTION + 6]])
    assert states.pose_cov is not None
    added = line(states.time, (states.pose_cov - own).reshape(-1, 36)).reshape(-1, 6, 6)
    pose_cov = _pose_cov(result, joint, dense, stream, accel_bias) + added
    return Trajectory(
        time=passed[requested],
        world_from_body=dense.world_from_body[requested],
        position_world=dense.position_world[requested],
        velocity_world=None if dense.velocity_world is None else dense.velocity_world[requested],
        gyro_bias_body=gyro_bias[requested],
        accel_bias_body=accel_bias[requested],
        pose_cov=pose_cov[requested],
    )


class _Steps(NamedTuple):
    """Several intervals in one array, padded with steps of zero length, world axes."""

    length: Array  # (k, steps) (s)
    rotation: Array  # (k, steps, 3, 3), ``world_from_body`` at the beginning of each step
    force_world: Array  # (k, steps, 3), specific force (m/s^2)
    gap_bridged: BoolArray  # (k,), intervals with a gap of the inertial stream


def _pose_cov(
    result: Smoothed, joint: Array, dense: Trajectory, stream: ImuSamples, accel_bias: Array
) -> Array:
    """Return the covariance of the poses between the epochs, shape (samples, 6, 6).

    `joint` (epochs - 1, 30, 30): of every two successive states.
    """
    epochs, imu = result.states.time, result.declared.site.platform.imu
    force = stream.accel_body - accel_bias
    usual = float(np.median(np.diff(stream.time)))
    remaining = np.clip(np.searchsorted(epochs, stream.time, side="right") - 1, 0, len(epochs) - 2)
    first = np.searchsorted(remaining, np.arange(len(epochs)))
    out = np.empty((len(stream), 6, 6))
    begin = 0
    while begin < len(epochs) - 1:
        reach = np.searchsorted(first, first[begin] + CHUNK, side="right") - 1
        end = min(max(int(reach), begin + 1), len(epochs) - 1)
        # Short intervals in a batch with a long one would be padded to its length.
        width = 2 * (first[begin + 1] - first[begin]) + 2
        longer = np.flatnonzero(np.diff(first[begin : end + 1]) > width)
        end = begin + max(int(longer[0]), 1) if len(longer) else end
        rows, numbers = slice(first[begin], first[end]), np.arange(begin, end)
        count = np.diff(first[begin : end + 1])
        own, place = (
            remaining[rows] - begin,
            np.arange(first[begin], first[end]) - first[remaining[rows]],
        )
        edges = np.repeat(epochs[numbers + 1][:, None], int(np.max(count)) + 2, axis=1)
        edges[:, 0] = epochs[numbers]
        edges[own, place + 1] = stream.time[rows]
        shape = (len(numbers), edges.shape[1] - 1)
        rotation = np.empty((*shape, 3, 3))
        rotation[:] = result.states.world_from_body[numbers][:, None]
        rotation[own, place + 1] = dense.world_from_body[rows]
        body = np.zeros((*shape, 3))
        body[own, place + 1] = force[rows]
        body[:, 0] = body[:, min(1, shape[1] - 1)]
        length = np.diff(edges, axis=1)
        steps = _Steps(
            length,
            rotation,
            (rotation @ body[..., None])[..., 0],
            np.max(length, axis=1) > GAP_SAMPLES * usual,
        )
        last = result.states.world_from_body[numbers + 1]
        cov = _conditioned(steps, last, joint[numbers], imu)
        turn = np.zeros((len(stream.time[rows]), 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(dense.world_from_body[rows], 1, 2)
        out[rows] = turn @ cov[own, place] @ np.swapaxes(turn, 1, 2)
        begin = end
    return out


def _joint_cov(result: Smoothed) -> Array:
    """Return the covariance of every two successive states, shape (n - 1, 30, 30).

    Includes considered parameters.
    """
    estimate = result.estimate
    tree = eliminate(result.graph.linearized(estimate), result.graph.ordering)
    keys = [[X(i), V(i), B(i)] for i in range(len(result.states))]
    joint = np.array(
        [
            tree.jointMarginalCovariance([*before, *after]).fullMatrix()
            for before, after in pairwise(keys)
        ]
    )
    if result.fix_response is not None:
        response = np.zeros((len(keys), MOTION, result.fix_response.shape[2]))
        response[:, :6] = result.fix_response
    else:
        steps = responses(result.graph, estimate, result.uncertain)
        flat = [key for own in keys for key in own]
        parts = [step.vector(flat).reshape(-1, MOTION) for step in steps]
        response = np.stack(parts, axis=2) if parts else np.zeros((len(keys), MOTION, 0))
    both = np.concatenate([response[:-1], response[1:]], axis=1)
    return joint + both @ np.swapaxes(both, 1, 2)


def _conditioned(steps: _Steps, last: Array, joint: Array, imu: ImuModel) -> Array:
    """Return the covariance of the poses at the end of each step, world axes.

    `last` (k, 3, 3): ``world_from_body`` at the end of each interval. `joint` (k, 30, 30): of the
    states at both ends.
    """
    transition, noise = _step_transition(steps, imu)
    whole, total = transition[:, -1], noise[:, -1]
    scale = np.sqrt(np.diagonal(total, axis1=1, axis2=2))
    remaining = whole[:, None] @ np.linalg.inv(transition)  # transition of the remaining interval
    across = remaining @ noise / scale[:, None, :, None]
    # In units of the noise's sigmas, which differ by many orders of magnitude.
    rounded = (total / (scale[:, :, None] * scale[:, None, :]))[:, None]
    gain = np.swapaxes(np.linalg.solve(rounded, across), 2, 3)[:, :, :6] / scale[:, None, None]
    by_left = transition[:, :, :6] - gain @ whole[:, None]
    both = np.concatenate([by_left, gain], axis=3)
    ends = np.zeros((len(last), 2 * MOTION, 2 * MOTION))
    ends[:] = np.eye(2 * MOTION)
    for k, rotation in ((0, steps.rotation[:, 0]), (MOTION, last)):
        ends[:, k : k + 3, k : k + 3] = ends[:, k + 3 : k + 6, k + 3 : k + 6] = rotation
    joint = ends @ joint @ np.swapaxes(ends, 1, 2)
    own = noise[:, :, :6, :6] - gain @ (remaining @ noise)[..., :6]
    return both @ joint[:, None] @ np.swapaxes(both, 2, 3) + own


def _step_transition(steps: _Steps, imu: ImuModel) -> tuple[Array, Array]:
    """Return transition and noise from the beginning to the end of each step, world axes.

    Shape (k, steps, 15, 15): rotation, position, velocity, accelerometer and gyro bias.
    """
    k, count = steps.length.shape
    own = step_transitions(steps.length, steps.rotation, steps.force_world)
    added = step_noise(steps.length, imu, steps.gap_bridged[:, None])
    transition, noise = np.empty((2, k, count, MOTION, MOTION))
    so_far, spread = np.tile(np.eye(MOTION), (k, 1, 1)), np.zeros((k, MOTION, MOTION))
    for i in range(count):
        step = own[:, i]
        so_far = step @ so_far
        spread = step @ spread @ np.swapaxes(step, 1, 2) + added[:, i]
        transition[:, i], noise[:, i] = so_far, spread
    return transition, noise
