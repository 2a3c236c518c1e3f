"""Maximum-likelihood fix of one epoch: pose with covariance, every hypothesis that survives.

Started without a prior guess from `candidates`, refined by Levenberg-Marquardt on the one
measurement model, all epochs and hypotheses at once.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import EstimationError
from magfusion.fixes.candidates import attitudes, positions
from magfusion.fixes.fix import Fixes
from magfusion.fixes.survey import honest_covariance, survey_jacobians
from magfusion.observation import skew
from magfusion.parameters import Block, Calibration, linearize_channels
from magfusion.records.samples import FieldSamples
from magfusion.site import Site
from magfusion.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray
from magfusion.weights import block_diagonal, measurement_cov, paired_whitening, stacked

CHUNK = 500  # epochs solved at once
CANDIDATES = 10  # positions that get an attitude
REFINED = 6  # of these, how many are refined
HYPOTHESES = 4  # of these, how many are returned
ITERATIONS = 100  # a bound; the few that creep along a valley need more than 25
SAME_POSITION = 0.02  # m; two solutions closer than this and SAME_ROTATION are one
SAME_ROTATION = 0.02  # rad


@dataclass(frozen=True, eq=False)
class Gravity:
    """Direction of the specific force, where the platform is at rest or nearly so.

    Parameters
    ----------
    up_body : ndarray, shape (n, 3)
        Unit vectors.
    sigma : ndarray, shape (n,)
        (rad); infinite where it says nothing.
    """

    up_body: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class _Problem:
    calibration: Calibration
    time: Array
    measured: Array  # (n, channels, 6)
    root: Array  # (n, channels, 6, 6) whitening
    noise: Array | None  # (n, channels, 6, 6) whitened noise, where the root is more than that
    phase_blocks: tuple[Block, ...]
    gravity: Gravity | None
    prior: Trajectory | None


def _phase_blocks(site: Site) -> tuple[Block, ...]:
    blocks: list[Block] = []
    start = 0
    for beacon in site.beacons:
        if not beacon.synchronised:
            columns = slice(start, start + len(beacon.tones))
            sigma = np.full(len(beacon.tones), np.inf)
            blocks.append(Block("phase", beacon.name, "phase", columns, sigma))
            start = columns.stop
    return tuple(blocks)


def fix_epochs(
    samples: FieldSamples,
    calibration: Calibration,
    *,
    gravity: Gravity | None = None,
    prior: Trajectory | None = None,
    survey_error: bool = True,
) -> Fixes:
    """Fix the pose at every epoch, without a guess.

    Parameters
    ----------
    samples : FieldSamples
        Channels in the site's order.
    calibration : Calibration
    gravity : Gravity, optional
    prior : Trajectory, optional
        With ``pose_cov``, at the same times: one more candidate, and a term of the posterior.
    survey_error : bool
        Weigh by the site's calibration sigmas too.

    Returns
    -------
    Fixes
    """
    if len(samples) == 0:
        raise EstimationError("no epoch to fix: every window was dropped")
    cov = measurement_cov(calibration.site, samples, survey_error=survey_error)
    root = paired_whitening(cov, samples.valid)
    noise = None
    if survey_error:
        known = np.where(
            samples.valid[..., None, None], measurement_cov(calibration.site, samples), 0
        )
        single = root[..., :3, :3] @ known @ np.swapaxes(root[..., :3, :3], -1, -2)
        noise = block_diagonal(np.stack([single, single], axis=-3))
    parts = []
    for start in range(0, len(samples), CHUNK):
        rows = slice(start, start + CHUNK)
        problem = _Problem(
            calibration=calibration,
            time=samples.time[rows],
            measured=stacked(samples.phasor_sensor[rows]),
            root=root[rows],
            noise=None if noise is None else noise[rows],
            phase_blocks=_phase_blocks(calibration.site),
            gravity=None
            if gravity is None
            else Gravity(gravity.up_body[rows], gravity.sigma[rows]),
            prior=None if prior is None else _rows_of(prior, rows),
        )
        parts.append(_solve(problem))
    return Fixes(
        *(np.concatenate([getattr(p, f) for p in parts]) for f in Fixes.__dataclass_fields__)
    )


def _rows_of(prior: Trajectory, rows: slice) -> Trajectory:
    return Trajectory(
        prior.time[rows],
        prior.world_from_body[rows],
        prior.position_world[rows],
        pose_cov=None if prior.pose_cov is None else prior.pose_cov[rows],
    )


def _solve(problem: _Problem) -> Fixes:
    rotation, position, phase = _starts(problem)
    n, count = rotation.shape[:2]
    flat = _Flat(problem, count)
    state = (rotation.reshape(-1, 3, 3), position.reshape(-1, 3), phase.reshape(n * count, -1))
    state, cost, information, rms = _levenberg_marquardt(flat, *state)
    return _ranked(
        problem,
        state[0].reshape(n, count, 3, 3),
        state[1].reshape(n, count, 3),
        state[2].reshape(n, count, -1),
        cost.reshape(n, count),
        information.reshape(n, count, *information.shape[1:]),
        rms.reshape(n, count),
    )


def _starts(problem: _Problem) -> tuple[Array, Array, Array]:
    site = problem.calibration.site
    sensor = site.platform.magnetometer
    raw = problem.measured[..., :3] + 1j * problem.measured[..., 3:]
    phasor = raw @ np.linalg.inv(sensor.matrix).T
    weight = np.sum(problem.root[..., :3, :3] ** 2, axis=(-1, -2)) / 3.0
    beacons = {b.name: b.synchronised for b in site.beacons}
    free = np.array([not beacons[name] for name, _ in site.channels])
    up = up_weight = None
    if problem.gravity is not None:
        up = problem.gravity.up_body @ sensor.body_from_sensor
        up_weight = 1.0 / problem.gravity.sigma**2
    spots = positions(problem.calibration, phasor, weight, CANDIDATES)
    world_from_sensor, phase = attitudes(
        problem.calibration, spots, phasor, weight, free, up, up_weight
    )
    rotation = world_from_sensor @ sensor.body_from_sensor.T
    position = spots - rotation @ sensor.position_body
    phase = phase - problem.calibration.drive_phase(problem.time)[:, None] * free
    if problem.prior is not None:
        rotation = np.concatenate([problem.prior.world_from_body[:, None], rotation], axis=1)
        position = np.concatenate([problem.prior.position_world[:, None], position], axis=1)
        phase = np.concatenate([phase[:, :1], phase], axis=1)
    n, count = rotation.shape[:2]
    _, _, cost = _residual(
        _Flat(problem, count),
        rotation.reshape(-1, 3, 3),
        position.reshape(-1, 3),
        phase.reshape(n * count, -1),
    )
    order = np.argsort(cost.reshape(n, count), axis=1)[:, :REFINED]
    return (
        np.take_along_axis(rotation, order[..., None, None], axis=1),
        np.take_along_axis(position, order[..., None], axis=1),
        np.take_along_axis(phase, order[..., None], axis=1),
    )


class _Flat:
    """The problem with every epoch repeated for each of its hypotheses."""

    def __init__(self, problem: _Problem, count: int, rows: IntArray | None = None) -> None:
        self.problem, self.count = problem, count
        index = np.repeat(np.arange(len(problem.time)), count)
        self.epoch = index if rows is None else rows

    def subset(self, keep: IntArray) -> "_Flat":
        return _Flat(self.problem, self.count, self.epoch[keep])


def _residual(
    flat: _Flat, rotation: Array, position: Array, phase: Array
) -> tuple[Array, Array, Array]:
    """Whitened residual (m, rows), Jacobian (m, rows, 6 + phases) and cost (m,)."""
    problem, epoch = flat.problem, flat.epoch
    calibration = replace(problem.calibration, phase=problem.calibration.phase + phase)
    value, by_pose, by_phase = linearize_channels(
        calibration, problem.phase_blocks, problem.time[epoch], rotation, position
    )
    root = problem.root[epoch]
    error = (root @ (value - problem.measured[epoch])[..., None])[..., 0]
    jacobian = root @ np.concatenate([by_pose, by_phase], axis=-1)
    m, width = len(epoch), jacobian.shape[-1]
    errors, jacobians = [error.reshape(m, -1)], [jacobian.reshape(m, -1, width)]
    if problem.gravity is not None:
        up = rotation[:, 2]
        share = 1.0 / problem.gravity.sigma[epoch]
        errors.append(share[:, None] * (up - problem.gravity.up_body[epoch]))
        block = np.zeros((m, 3, width))
        block[:, :, :3] = share[:, None, None] * skew(up)
        jacobians.append(block)
    if problem.prior is not None and problem.prior.pose_cov is not None:
        step = _pose_difference(
            problem.prior.world_from_body[epoch],
            problem.prior.position_world[epoch],
            rotation,
            position,
        )
        block = np.zeros((m, 6, width))
        block[:, :, :6] = np.linalg.inv(np.linalg.cholesky(problem.prior.pose_cov))[epoch]
        errors.append((block[:, :, :6] @ step[..., None])[..., 0])
        jacobians.append(block)
    total = np.concatenate(errors, axis=1)
    return total, np.concatenate(jacobians, axis=1), np.sum(total**2, axis=1)


def _pose_difference(rotation0: Array, position0: Array, rotation: Array, position: Array) -> Array:
    """Perturbation from the first pose to the second, small-angle in its translation."""
    inverse = np.swapaxes(rotation0, -1, -2)
    turn = Rotation.from_matrix(inverse @ rotation).as_rotvec()
    shift = (inverse @ (position - position0)[..., None])[..., 0]
    return np.concatenate([turn, shift], axis=-1)


def _moved(
    rotation: Array, position: Array, phase: Array, step: Array, free: IntArray
) -> tuple[Array, Array, Array]:
    turned = rotation @ Rotation.from_rotvec(step[:, :3]).as_matrix()
    shifted = position + (rotation @ step[:, 3:6, None])[..., 0]
    lag = phase.copy()
    lag[:, free] += step[:, 6:]
    return turned, shifted, lag


def _free_channels(problem: _Problem) -> IntArray:
    owners = {b.owner for b in problem.phase_blocks}
    names = [name for name, _ in problem.calibration.site.channels]
    return np.flatnonzero([name in owners for name in names])


def _levenberg_marquardt(
    flat: _Flat, rotation: Array, position: Array, phase: Array
) -> tuple[tuple[Array, Array, Array], Array, Array, Array]:
    free = _free_channels(flat.problem)
    m = len(rotation)
    damping = np.full(m, 1e-3)
    error, jacobian, cost = _residual(flat, rotation, position, phase)
    normal = np.swapaxes(jacobian, 1, 2) @ jacobian
    gradient = np.einsum("mij,mi->mj", jacobian, error)
    active = np.arange(m)
    for _ in range(ITERATIONS):
        if len(active) == 0:
            break
        diagonal = np.einsum("mii->mi", normal[active])
        largest = np.max(diagonal, axis=1, keepdims=True)
        # An epoch without any channel has no information at all: it stays where it is.
        floor = np.where(largest > 0.0, 1e-9 * largest, 1.0)
        added = damping[active, None] * np.maximum(diagonal, floor)
        damped = normal[active] + added[..., None] * np.eye(added.shape[1])
        step = -np.linalg.solve(damped, gradient[active][..., None])[..., 0]
        angle = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
        step *= np.minimum(1.0, 1.0 / np.maximum(angle, 1e-12))
        trial = _moved(rotation[active], position[active], phase[active], step, free)
        error, jacobian, new_cost = _residual(flat.subset(active), *trial)
        better = new_cost < cost[active]
        moved = active[better]
        gain = cost[moved] - new_cost[better]
        rotation[moved], position[moved], phase[moved] = (x[better] for x in trial)
        normal[moved] = np.swapaxes(jacobian[better], 1, 2) @ jacobian[better]
        gradient[moved] = np.einsum("mij,mi->mj", jacobian[better], error[better])
        cost[moved] = new_cost[better]
        damping[active] *= np.where(better, 0.2, 10.0)
        done = damping[active] > 1e8
        done[better] |= gain < 1e-4 * (1.0 + 1e-3 * new_cost[better])
        active = active[~done]
    rows = np.maximum(1, error.shape[1])
    return (rotation, position, phase), cost, normal, np.sqrt(cost / rows)


def _ranked(
    problem: _Problem,
    rotation: Array,
    position: Array,
    phase: Array,
    cost: Array,
    information: Array,
    rms: Array,
) -> Fixes:
    order = np.argsort(cost, axis=1)
    rotation = np.take_along_axis(rotation, order[..., None, None], axis=1)
    position = np.take_along_axis(position, order[..., None], axis=1)
    cost = np.take_along_axis(cost, order, axis=1)
    cost = np.where(_repeated(rotation, position), np.inf, cost)
    again = np.argsort(cost, axis=1, kind="stable")[:, :HYPOTHESES]
    order = np.take_along_axis(order, again, axis=1)
    information = np.take_along_axis(information, order[..., None, None], axis=1)
    rotation = np.take_along_axis(rotation, again[..., None, None], axis=1)
    position = np.take_along_axis(position, again[..., None], axis=1)
    phase = np.take_along_axis(phase, order[..., None], axis=1)
    inverse, determined = _inverse(information)
    if problem.noise is not None:
        carried = _with_survey(problem, rotation, position, phase, information, inverse)
        # Where a direction is open there is nothing for the survey to make worse.
        inverse = np.where(determined[..., None, None], carried, inverse)
    return Fixes(
        time=problem.time,
        world_from_body=rotation,
        position_world=position,
        pose_cov=inverse[..., :6, :6],
        cost=np.take_along_axis(cost, again, axis=1),
        residual_rms=np.take_along_axis(rms, order, axis=1),
        phase=phase,
        determined=determined,
    )


def _with_survey(
    problem: _Problem,
    rotation: Array,
    position: Array,
    phase: Array,
    information: Array,
    inverse: Array,
) -> Array:
    """Covariance with the error of the survey carried through, rather than taken for noise."""
    assert problem.noise is not None
    count, shape = rotation.shape[1], information.shape
    epoch = np.repeat(np.arange(len(problem.time)), count)
    flat_phase = phase.reshape(len(epoch), -1)
    calibration = replace(problem.calibration, phase=problem.calibration.phase + flat_phase)
    by_found, by_survey = survey_jacobians(
        calibration,
        problem.time[epoch],
        rotation.reshape(-1, 3, 3),
        position.reshape(-1, 3),
        problem.root[epoch],
    )
    cov = honest_covariance(
        by_found,
        by_survey,
        block_diagonal(problem.noise)[epoch],
        inverse.reshape(-1, *shape[2:]),
        information.reshape(-1, *shape[2:]),
    )
    return cov.reshape(shape)


def _repeated(rotation: Array, position: Array) -> BoolArray:
    """Which hypotheses, sorted by cost, repeat an earlier one."""
    repeated = np.zeros(rotation.shape[:2], dtype=bool)
    for j in range(1, rotation.shape[1]):
        for i in range(j):
            near = np.linalg.norm(position[:, i] - position[:, j], axis=1) < SAME_POSITION
            turn = np.swapaxes(rotation[:, i], 1, 2) @ rotation[:, j]
            angle = Rotation.from_matrix(turn).magnitude()
            repeated[:, j] |= near & (angle < SAME_ROTATION)
    return repeated


def _inverse(information: Array) -> tuple[Array, BoolArray]:
    """Return the covariance of pose and phases; flat directions are wide, not infinite."""
    value, vector = np.linalg.eigh(information)
    largest = value[..., -1:]
    # The phase of a channel that is missing is open too, but is no direction of the pose.
    in_pose = np.sum(vector[..., :6, :] ** 2, axis=-2) > 1e-6
    open_direction = (value <= 1e-10 * largest) & in_pose
    safe = np.maximum(value, 1e-10 * largest + 1e-300)
    cov = (vector / safe[..., None, :]) @ np.swapaxes(vector, -1, -2)
    return cov, ~np.any(open_direction, axis=-1)
