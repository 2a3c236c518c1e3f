"""Pending epochs of the online score test, processed in batches.

Results are only requested every few seconds, and a batch costs little more than one epoch.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.graph.measurement import Measurement, Rows, joined, kind_of
from magfusion.estimation.graph.state import MOTION, State, States, states_of
from magfusion.estimation.measurements.earth import EarthField
from magfusion.estimation.measurements.joint_phasors import JointPhasors
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.estimation.measurements.steel import SteelModes
from magfusion.estimation.measurements.zero_velocity import ZeroVelocity
from magfusion.estimation.online_integrity.score_targets import ScoreTargets
from magfusion.estimation.solve.sparse_rows import sparse_if_wide
from magfusion.model.parameters import Block, Calibration, dimension
from magfusion.model.parameters.inertial import Inertial, Stream
from magfusion.model.samples import ImuSamples
from magfusion.units import Array, BoolArray

MEMORY = 60.0  # s; older innovations count less, as faults may change


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over the innovations up to now, in typical errors of the fixed parameters.

    After these h parameters follow those of `magfusion.estimation.online_integrity.recent_steps`.
    A filter whose gain considers uncertain parameters has correlated innovations.  Those that are
    summed are of the *exact* filter, which takes every fixed parameter as declared exactly: given
    the parameters they are white, and the sums those of a batch solution.
    """

    information: Array  # (h + k, h + k)
    gradient: Array  # (h + k,)
    response: Array  # (15 + estimated, h + k), effect of a unit error of these on the state
    time: float  # (s)
    exact_response: Array  # (15 + estimated, h + k), the same of the exact filter's state
    exact_offset: Array  # (15 + estimated,), from the state to that of the exact filter
    exact_cov: Array  # (15 + estimated, 15 + estimated), of the latter
    onsets: tuple[float, ...] = ()  # times of the tested steps (s)


class EpochTransition(NamedTuple):
    """Propagation to an epoch."""

    transition: Array  # (n, n), of the tangent
    world_from_body: tuple[Array, Array]  # (3, 3) each, before and after
    # gyro_body, accel_body: (3,), their means (rad/s, m/s^2); zero where nothing was measured
    gyro_body: Array
    accel_body: Array
    noise: Array  # (n, n), covariance that the interval adds


class Epoch(NamedTuple):
    """A pending epoch."""

    predicted: State
    passed: EpochTransition | None  # None where the state was not propagated
    measurements: tuple[Measurement, ...] = ()  # after the gate
    rejected: tuple[Measurement, ...] = ()  # innovations that did not update the state


def passed(
    before: State, after: State, transition: Array, noise: Array, imu: ImuSamples
) -> EpochTransition:
    """Return the propagation to a prediction, from the inertial samples of the interval."""
    gyro = accel = np.zeros(3)
    if len(imu):
        share = np.full(len(imu), 1.0 / len(imu))
        gyro, accel = share @ imu.gyro_body, share @ imu.accel_body
    turn = before.world_from_body, after.world_from_body
    return EpochTransition(transition, turn, gyro, accel, noise)


def add_epochs(sums: Sums, epochs: Sequence[Epoch], targets: ScoreTargets) -> Sums:
    """Return the sums with the innovations of some consecutive epochs."""
    own, fixed = slice(0, targets.size), slice(0, len(targets.unit))
    error, jacobian, is_used = _rows(epochs, targets)
    # Of hundreds of beacons few are detected: the rows of the others are empty.
    filled = np.any(error, axis=0) | np.any(jacobian, axis=(0, 2))
    error, jacobian, is_used = error[:, filled], jacobian[:, filled], is_used[:, filled]
    by_state = jacobian[..., : targets.whole]
    by_held = jacobian[..., targets.columns] * targets.unit
    by_own, gain = by_state[..., own], _gain(epochs, by_state, is_used, own)
    pushed, response = _pushed(epochs, targets), sums.response
    time = np.maximum.accumulate([sums.time, *(epoch.predicted.time for epoch in epochs)])
    kept = np.exp((time - time[-1]) / MEMORY)
    exact_cov, information, gradient = sums.exact_cov, sums.information, sums.gradient
    information, gradient = kept[0] * information, kept[0] * gradient
    exact = np.column_stack([sums.exact_response, sums.exact_offset])
    for k, epoch in enumerate(epochs):
        if (propagation := epoch.passed) is not None:
            transition = propagation.transition[own, own]
            response, exact = transition @ response, transition @ exact
            response[:, fixed] -= pushed[k]
            exact[:, fixed] -= pushed[k]
            exact_cov = transition @ exact_cov @ transition.T + propagation.noise[own, own]
        shown, innovation = by_own[k] @ response, by_own[k] @ exact
        shown[:, fixed] -= by_held[k]
        innovation[:, fixed] -= by_held[k]
        innovation[:, -1] += error[k]
        white = innovation - by_own[k] @ _updated(exact_cov, by_own[k], innovation)
        reported = kept[k + 1] * (innovation[:, :-1].T @ white)
        information, gradient = information + reported[:, :-1], gradient + reported[:, -1]
        response = response - gain[k] @ shown
        used = by_own[k] * is_used[k, :, None]
        exact = exact - _updated(exact_cov, used, innovation)
        exact[:, -1] += gain[k] @ error[k]
        exact_cov = exact_cov - _updated(exact_cov, used, used @ exact_cov)
    return replace(
        sums,
        information=information,
        gradient=gradient,
        response=response,
        time=float(time[-1]),
        exact_response=exact[:, :-1],
        exact_offset=exact[:, -1],
        exact_cov=0.5 * (exact_cov + exact_cov.T),
    )


def _updated(cov: Array, jacobian: Array, innovation: Array) -> Array:
    """Return the gain of whitened rows (m, n) times columns of innovations, shape (n, columns)."""
    across = cov @ jacobian.T
    inner = np.eye(len(cov)) + across @ jacobian
    return np.asarray(np.linalg.solve(inner, across @ innovation))


def _gain(epochs: Sequence[Epoch], by_state: Array, is_used: BoolArray, own: slice) -> Array:
    """Return the gain of each update of the estimate, shape (epochs, n, m).

    Rejected rows have no gain, and no part in that of the others.
    """
    cov = [epoch.predicted.cov for epoch in epochs]
    sparse = [sparse_if_wide(rows) for rows in by_state]
    across = np.array([rows @ one for rows, one in zip(sparse, cov, strict=True)])
    spread = np.array([rows @ one.T for rows, one in zip(sparse, across, strict=True)])
    both_used = is_used[:, :, None] * is_used[:, None, :]
    updating = spread * both_used + np.eye(by_state.shape[1])
    by_used = across[..., own] * is_used[..., None]
    return np.asarray(np.swapaxes(np.linalg.solve(updating, by_used), 1, 2))


def new_sums(information: Array, gradient: Array, response: Array, time: float, cov: Array) -> Sums:
    """Return sums at a state of a known response, (n, h), whose filter is the exact one.

    `cov` (n, n): of the state, given the parameters.
    """
    offset = np.zeros(len(response))
    return Sums(information, gradient, response, time, response, offset, cov)


def _pushed(epochs: Sequence[Epoch], targets: ScoreTargets) -> Array:
    """Return the effect of a unit error of the inertial sensors, to subtract, (epochs, n, h)."""
    out = np.zeros((len(epochs), targets.size, len(targets.unit)))
    rows = [k for k, epoch in enumerate(epochs) if epoch.passed is not None]
    led = [epoch.passed for epoch in epochs if epoch.passed is not None]
    if not led:
        return out
    gyro, accel = (
        np.array([getattr(p, name) for p in led]) for name in ("gyro_body", "accel_body")
    )
    turns = np.array([turn for p in led for turn in p.world_from_body])
    stream = Stream(ImuSamples(np.arange(len(led), dtype=np.float64), gyro, accel), turns)
    by_bias = np.array([p.transition[:9, 9:MOTION] for p in led])
    for block in targets.fixed_blocks:
        if isinstance(block.parameter, Inertial):
            bias = block.parameter.as_bias(stream)
            bias = bias[::2] if block.parameter.of_states else bias
            out[rows, :9, block.columns] = by_bias @ (bias * targets.unit[block.columns])
    return out


def _rows(epochs: Sequence[Epoch], targets: ScoreTargets) -> tuple[Array, Array, BoolArray]:
    """Return errors (epochs, m), Jacobians by `targets.parameters`, and which rows are used.

    They are padded with zeros; rows without information on the state are zero.
    """
    width, parts = dimension(targets.parameters), [list[_Row]() for _ in epochs]
    shared: dict[object, list[tuple[int, bool, Measurement]]] = {}
    for k, epoch in enumerate(epochs):
        for number, measurement in enumerate((*epoch.measurements, *epoch.rejected)):
            key = _linearization_key(measurement, epoch.predicted.calibration, (k, number))
            used = number < len(epoch.measurements)
            shared.setdefault(key, []).append((k, used, measurement))
    for group in shared.values():
        states = [epochs[k].predicted for k, *_ in group]
        rows = _linearized([measurement for *_, measurement in group], states, targets)
        jacobian = rows.jacobian(width).reshape(len(group), -1, MOTION + width)
        error = rows.error.reshape(len(group), -1)
        for (k, used, _), own_error, own_jacobian in zip(group, error, jacobian, strict=True):
            parts[k].append(_Row(own_error, own_jacobian, used))
    maximum = max((sum(len(one.error) for one in own) for own in parts), default=0)
    errors, jacobians = (
        np.zeros((len(epochs), maximum)),
        np.zeros((len(epochs), maximum, MOTION + width)),
    )
    is_used = np.zeros((len(epochs), maximum), dtype=bool)
    for k, own in enumerate(parts):
        begin = 0
        for one in own:
            rows_of = slice(begin, begin := begin + len(one.error))
            errors[k, rows_of], jacobians[k, rows_of] = one.error, one.jacobian
            is_used[k, rows_of] = one.is_used
    unreported = ~np.any(jacobians[..., : targets.whole], axis=2)
    errors[unreported], jacobians[unreported] = 0.0, 0.0
    return errors, jacobians, is_used


class _Row(NamedTuple):
    error: Array
    jacobian: Array
    is_used: bool


_OFFSET = (FieldPhasors, JointPhasors, EarthField)  # that depend on the applied IMU time offset


def _linearization_key(
    measurement: Measurement, calibration: Calibration, alone: tuple[int, int]
) -> object:
    """Return a key of the measurements that can be linearised together."""
    if isinstance(measurement, ZeroVelocity):  # independent of the calibration
        return kind_of(measurement)
    if not isinstance(measurement, _OFFSET):
        return alone
    own = (calibration.site, calibration.phase, calibration.drift, calibration.log_gain)
    return kind_of(measurement), *map(id, own), id(calibration.others), calibration.imu_begin


def _linearized(parts: list[Measurement], states: list[State], targets: ScoreTargets) -> Rows:
    """Return the weighted rows of measurements of one kind, one epoch each."""
    calibration = states[0].calibration
    (whole,) = parts if len(parts) == 1 else joined(parts, range(len(parts)))
    if len(parts) > 1 and isinstance(whole, _OFFSET):
        # Excess of each time offset over that of the first.
        own = (s.calibration.imu_offset(t) for s, t in zip(states, whole.time, strict=True))
        more = calibration.imu_offset(whole.time) - np.array(list(own))
        whole = replace(whole, applied_offset=whole.applied_offset + more)
    at = states_of(states)
    rows = whole.linearize(at, calibration, targets.parameters)
    if isinstance(whole, FieldPhasors):
        for block in targets.steel:
            rows = _with_steel(rows, whole, at, calibration, block)
    rows, predicted = rows.weighed(whole.loss)[0], whole.predicted_groups()
    return rows if predicted is None else rows.of_groups(np.any(predicted, axis=0))


def _with_steel(
    rows: Rows, measured: FieldPhasors, states: States, calibration: Calibration, block: Block
) -> Rows:
    """Return rows with the last columns of the calibration filled by those of steel."""
    assert isinstance(block.parameter, SteelModes)
    assert rows.by_calibration is not None
    place = states.world_from_body, states.position_world
    phasors = block.parameter.basis.phasors(calibration, measured.time, *place)
    by = measured.sqrt_information @ np.concatenate([phasors.real, phasors.imag], axis=2)
    others = rows.by_calibration[..., : -by.shape[-1]]
    return replace(rows, by_calibration=np.concatenate([others, by], axis=-1))
