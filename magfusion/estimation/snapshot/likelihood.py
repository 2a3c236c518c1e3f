"""Maximum-likelihood fix of one epoch: pose with covariance, and all probable hypotheses.

Started without a prior guess from `candidates`, refined on the measurement model by `refine`, all
epochs and hypotheses at once.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.snapshot.axis_starts import mirrored, starts_on_grid, with_least_roll
from magfusion.estimation.snapshot.candidates import attitudes, positions
from magfusion.estimation.snapshot.fix import Fixes, Gravity
from magfusion.estimation.snapshot.many import fix_parts, parts_detected
from magfusion.estimation.snapshot.place import outside
from magfusion.estimation.snapshot.problem import (
    GAIN_SIGMA,
    FixEpochs,
    FixProblem,
    FixState,
    epochs_of,
)
from magfusion.estimation.snapshot.refine import RefinedFixes, as_fixes, cost, joined, solved_from
from magfusion.estimation.snapshot.single_source_starts import is_single_source, starts_about_one
from magfusion.estimation.snapshot.within_cycle import MIN_EPOCHS, fixed_in_motion, velocities
from magfusion.model.arguments import check_arguments
from magfusion.model.channel_effects import of_all_sensors
from magfusion.model.coil_field import is_sized
from magfusion.model.detection_range import are_many
from magfusion.model.parameters import Calibration, seen_by, without_response
from magfusion.model.samples import FieldSamples
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray

CANDIDATES = 10  # positions that get an attitude
REFINED = 6  # of these, how many are refined
REFINED_OF_AXES = 8  # if components are missing; and as many mirrors of them
HYPOTHESES = 4  # of these, how many are returned
SOFT = 0.03  # relative error of a phasor, in the first refinement near coils of finite size
SAME_POSITION = 0.02  # m; two solutions closer than this and SAME_ROTATION are one
SAME_ROTATION = 0.02  # rad


def fix_epochs(
    samples: FieldSamples,
    calibration: Calibration,
    *,
    gravity: Gravity | None = None,
    prior: Trajectory | None = None,
    survey_error: bool = True,
    free_parameters: tuple[str, ...] = (),
    gain_sigma: float = GAIN_SIGMA,
) -> Fixes:
    """Fix the pose at every epoch, without a guess.

    Parameters
    ----------
    samples : FieldSamples
        Of n epochs, channels in the site's order.
    calibration : Calibration
        As of `magfusion.model.parameters.initial_calibration`.
    gravity : Gravity, optional
        Direction of gravity at the epochs, which excludes poses.
    prior : Trajectory, optional
        With ``pose_cov``, at the same times: one more candidate, and a term of the posterior.
    survey_error : bool
        Include the site's calibration sigmas in the weights.
    free_parameters : tuple of str
        Parameters estimated with the pose: ``phase``, including the drive phase of synchronised
        beacons; ``gain``, one of each beacon.
    gain_sigma : float
        Prior of the logarithm of a gain.

    Returns
    -------
    Fixes
        Of n epochs, each with its hypotheses, the most probable first: ``position_world`` (m),
        ``world_from_body``, ``pose_cov`` (body axes; rad^2, m^2).

    Raises
    ------
    TypeError
        Where the arguments are not samples and a calibration, in this order.
    EstimationError
        Where there is no epoch.
    """
    check_arguments(
        "fix_epochs", samples=(samples, FieldSamples), calibration=(calibration, Calibration)
    )
    parts_of = partial(
        epochs_of,
        prior=prior,
        survey_error=survey_error,
        free_parameters=free_parameters,
        gain_sigma=gain_sigma,
    )
    if are_many(calibration.site) and prior is None and len(samples):

        def fixed(
            _rows: slice, some: FieldSamples, known: Calibration, up: Gravity | None
        ) -> Fixes:
            return joined([_solve(epochs) for epochs in parts_of(some, known, gravity=up)])

        return fix_parts(parts_detected(samples, calibration, gravity), calibration, fixed)
    parts = list(parts_of(samples, calibration, gravity=gravity))
    result = joined([_solve(epochs) for epochs in parts])
    if samples.ahead is None or prior is not None or len(result) < MIN_EPOCHS:
        return result
    return _in_motion(parts, result)


def _in_motion(parts: list[FixEpochs], fixes: Fixes) -> Fixes:
    """Repeat fixes of coils driven in turn, with the platform's position at each measurement."""
    rotated = parts[0].samples.channel_rotation is not None
    velocity, sigma = velocities(fixes, parts[0].problem.calibration.site, rotated=rotated)
    result, first = [], 0
    for epochs in parts:
        rows = slice(first, first + len(epochs.samples))
        result.append(fixed_in_motion(epochs, fixes.rows(rows), velocity[rows], sigma[rows]))
        first = rows.stop
    return joined(result)


def _solve(epochs: FixEpochs) -> Fixes:
    lacking = _lacking(epochs.samples)
    if not np.any(lacking):
        return _solved(epochs)
    parts = [(rows, _solved(epochs.rows(rows))) for rows in (lacking, ~lacking) if np.any(rows)]
    order = np.argsort(np.concatenate([np.flatnonzero(rows) for rows, _ in parts]))
    maximum = max(part.cost.shape[1] for _, part in parts)
    return joined([part.padded(maximum) for _, part in parts]).rows(order)


def _lacking(samples: FieldSamples) -> BoolArray:
    """Return which epochs have more channels that lack a component than complete ones."""
    partial = np.sum(samples.partial, axis=1)
    return np.asarray(partial > np.sum(samples.valid, axis=1) - partial)


def _solved(epochs: FixEpochs) -> Fixes:
    problem = epochs.problem
    if _lacking(epochs.samples)[0]:
        start, count = _starts_of_axes(epochs)
    else:
        start, count = _starts(problem)
    epoch = np.repeat(np.arange(len(problem.time)), count)
    if any(is_sized(beacon) for beacon in problem.calibration.site.beacons):
        # Candidates are those of dipoles: with full weights some stop short of the minimum.
        start = solved_from(_softened(problem).rows(epoch), start).state
    solved = solved_from(problem.rows(epoch), start)
    best = np.argmin(solved.cost.reshape(-1, count), axis=1) + count * np.arange(len(problem.time))
    again = epochs.reweighed(solved.state.rotation[best], solved.state.position[best])
    if again is not None:
        problem, solved = again, solved_from(again.rows(epoch), solved.state)
    if np.any(epochs.samples.partial):
        rolled = with_least_roll(problem.rows(epoch), solved.state)
        solved = solved_from(problem.rows(epoch), rolled)
    order, ranked = _ranked(
        solved.state.rotation.reshape(-1, count, 3, 3),
        solved.state.position.reshape(-1, count, 3),
        solved.cost.reshape(-1, count) + outside(problem, solved, count),
    )
    kept = (order + count * np.arange(len(order))[:, None]).ravel()
    result = RefinedFixes(solved.state.rows(kept), solved.cost[kept], solved.information[kept])
    return replace(as_fixes(problem.rows(epoch[kept]), result, order.shape[1]), cost=ranked)


def _starts_of_axes(epochs: FixEpochs) -> tuple[FixState, int]:
    """Return the most likely states of epochs that lack components, so many rows an epoch."""
    if is_single_source(epochs.problem.calibration.site):
        return _single_source_starts(epochs.problem)
    start, count = starts_on_grid(epochs.problem)
    n = len(epochs.samples)
    epoch = np.repeat(np.arange(n), count)
    soft = _softened(epochs.problem)
    rough = solved_from(soft.rows(epoch), start)
    order = np.argsort(rough.cost.reshape(n, count), axis=1, kind="stable")[:, :REFINED_OF_AXES]
    kept = (order + count * np.arange(n)[:, None]).ravel()
    ahead = rough.state.rows(kept)
    behind = mirrored(epochs.problem, ahead)
    again = solved_from(soft.rows(np.repeat(np.arange(n), order.shape[1])), behind).state
    both = (np.stack(pair, axis=1) for pair in zip(ahead, again, strict=True))
    return FixState(*(part.reshape(-1, *part.shape[2:]) for part in both)), 2 * order.shape[1]


def _single_source_starts(problem: FixProblem) -> tuple[FixState, int]:
    """Return the distinct states consistent with a single source."""
    start, count = starts_about_one(problem)
    n = len(problem.time)
    rough = solved_from(_softened(problem).rows(np.repeat(np.arange(n), count)), start)
    turn, place = rough.state.rotation, rough.state.position
    parts = turn.reshape(n, count, 3, 3), place.reshape(n, count, 3)
    order, _ = _ranked(*parts, rough.cost.reshape(n, count))
    kept = (order + count * np.arange(n)[:, None]).ravel()
    return rough.state.rows(kept), order.shape[1]


def _softened(problem: FixProblem) -> FixProblem:
    """Return the problem with an error of `SOFT` in each phasor, relative to its magnitude."""
    parts = np.stack([problem.measured[..., :3], problem.measured[..., 3:]], axis=-1)
    square = np.sum((problem.sqrt_information @ parts) ** 2, axis=(-1, -2))[..., None, None]
    share = 1.0 / np.sqrt(1.0 + SOFT**2 / 6.0 * square)
    return replace(problem, sqrt_information=share * problem.sqrt_information)


def _starts(problem: FixProblem) -> tuple[FixState, int]:
    """Return the most probable candidates of any magnetometer, so many rows an epoch."""
    site = problem.calibration.site
    result = [_candidates(problem, k) for k in range(len(site.platform.magnetometers))]
    rotation, position, phase = (
        np.concatenate(parts, axis=1) for parts in zip(*result, strict=True)
    )
    phase = of_all_sensors(site, phase)
    if problem.prior is not None:
        rotation = np.concatenate([problem.prior.rotation[:, None], rotation], axis=1)
        position = np.concatenate([problem.prior.position[:, None], position], axis=1)
        phase = np.concatenate([phase[:, :1], phase], axis=1)
    n, count = rotation.shape[:2]
    epoch = np.repeat(np.arange(n), count)
    every = problem.start(
        rotation.reshape(-1, 3, 3), position.reshape(-1, 3), phase.reshape(n * count, -1)
    )
    order = np.argsort(cost(problem.rows(epoch), every).reshape(n, count), axis=1)[:, :REFINED]
    best = (order + count * np.arange(n)[:, None]).ravel()
    return every.rows(best), order.shape[1]


def _candidates(problem: FixProblem, which: int) -> tuple[Array, Array, Array]:
    """Return poses (n, candidates) and drive phases consistent with one magnetometer."""
    calibration, mine = (
        seen_by(problem.calibration, which),
        problem.calibration.site.of_sensor(which),
    )
    measured = problem.measured[:, mine]
    raw = measured[..., :3] + 1j * measured[..., 3:]
    raw, calibration = without_response(raw, calibration)
    site, sensor = calibration.site, calibration.site.platform.magnetometer
    raw = raw / calibration.gain_at(problem.time)[..., None]
    phasor = raw @ np.linalg.inv(sensor.matrix).T
    weight = np.sum(problem.sqrt_information[:, mine] ** 2, axis=(-1, -2)) / 3.0
    beacons = {b.name: b.synchronised for b in site.beacons}
    free_parameters = np.array([not beacons[name] for name, _ in site.channels])
    up = up_weight = None
    if problem.gravity is not None:
        up = problem.gravity.up_body @ sensor.body_from_sensor
        up_weight = 1.0 / problem.gravity.sigma**2
    spots = positions(calibration, phasor, weight, CANDIDATES)
    world_from_sensor, phase = attitudes(
        calibration, spots, phasor, weight, free_parameters, up, up_weight
    )
    rotation = world_from_sensor @ sensor.body_from_sensor.T
    position = spots - rotation @ sensor.position_body
    return (
        rotation,
        position,
        phase - calibration.drive_phase(problem.time)[:, None] * free_parameters,
    )


def _ranked(rotation: Array, position: Array, cost: Array) -> tuple[IntArray, Array]:
    """Return the hypotheses to keep, best first, and their cost, infinite for duplicates."""
    order = np.argsort(cost, axis=1)
    rotation = np.take_along_axis(rotation, order[..., None, None], axis=1)
    position = np.take_along_axis(position, order[..., None], axis=1)
    cost = np.take_along_axis(cost, order, axis=1)
    cost = np.where(_repeated(rotation, position), np.inf, cost)
    again = np.argsort(cost, axis=1, kind="stable")[:, :HYPOTHESES]
    return np.take_along_axis(order, again, axis=1), np.take_along_axis(cost, again, axis=1)


def _repeated(rotation: Array, position: Array) -> BoolArray:
    """Return which hypotheses, sorted by cost, duplicate an earlier one."""
    repeated = np.zeros(rotation.shape[:2], dtype=bool)
    for j in range(1, rotation.shape[1]):
        for i in range(j):
            near = np.linalg.norm(position[:, i] - position[:, j], axis=1) < SAME_POSITION
            turn = np.swapaxes(rotation[:, i], 1, 2) @ rotation[:, j]
            angle = Rotation.from_matrix(turn).magnitude()
            repeated[:, j] |= near & (angle < SAME_ROTATION)
    return repeated
