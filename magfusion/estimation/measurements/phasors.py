"""Phasors of the beacons as a measurement."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import NamedTuple

import numpy as np

from magfusion.estimation.graph.measurement import Loss, Measurement, Rows, group_distances
from magfusion.estimation.graph.state import State, States, pose_steps, states_of
from magfusion.estimation.measurements.signs import whitened_along
from magfusion.model.detection_range import are_many
from magfusion.model.field import skew
from magfusion.model.noise import paired_whitening, sensor_positions, stacked, weighed_and_alone
from magfusion.model.parameters import (
    CLOCK_RATE,
    TIME_OFFSET,
    BeaconParameter,
    Block,
    Calibration,
    dimension,
    linearize_channels,
    predict_channels,
)
from magfusion.model.quaternion import cross, matrices, of_vectors
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

MIN_SPARSE_COLUMNS = 64  # of parameters, most of which belong to one beacon


@dataclass(frozen=True, eq=False)
class FieldPhasors(Measurement):
    """Phasors of all channels, one group each."""

    time: Array  # (n,) (s)
    measured: Array  # (n, channels, 6), real, then imaginary part (T); zero where missing
    sqrt_information: Array  # (n, channels, 6, 6), whitening; zero where missing
    rate_body: Array  # (n, 3), angular rate, for the time offset (rad/s)
    # (n, channels, 6), effect of its change on the lock-in at fixed states (T/s)
    by_time_offset: Array
    applied_offset: Array  # (n,), IMU time offset used to cut the inertial data (s)
    # (n,), where the clocks have an effect: not for a stationary platform, where noise of rate and
    # velocity would be taken for information on them
    moving: BoolArray
    # (n, channels), time of the measurement after that of the row (s), as of `FieldSamples`
    ahead: Array | None = None
    robust: str | None = None  # loss of each channel: 'huber' or 'cauchy'
    # (n, channels), ratio of the variance used to that of an independent epoch, as epochs close by
    # share a model error
    excess: Array | None = None
    detected: BoolArray | None = None  # (n, channels), channels that are predicted; None for all
    # world_from_body, position_world: (n, 3, 3) and (n, 3), pose at which the fields are linearised
    # instead of the states': for an iterated update
    world_from_body: Array | None = None
    position_world: Array | None = None
    # shared by all measurements that differ in their weights alone
    predicted: "Predictions" = field(default_factory=lambda: Predictions(), compare=False)

    @property
    def loss(self) -> Loss | None:
        """Robust loss of each channel; a channel weighted in part is still an outlier."""
        if self.robust is None:
            return None
        return Loss(self.robust, 1.0 if self.excess is None else self.excess)

    def predicted_groups(self) -> BoolArray | None:
        """Return which channels are predicted, shape (n, channels); None for all."""
        return self.detected

    def alone(self) -> "FieldPhasors":
        """Return the measurement whitened as if epochs shared no model error."""
        if self.excess is None:
            return self
        scale = np.sqrt(self.excess)[..., None, None]
        return replace(self, sqrt_information=scale * self.sqrt_information, excess=None)

    def error(self, states: States, calibration: Calibration) -> Array:
        """Return the whitened error, shape (n, channels, 6), without a derivative."""
        if self.world_from_body is not None:
            return self.linearize(states, calibration, ()).error
        if self.ahead is not None or np.any(calibration.clock_offsets):
            value, _, _, _ = self.unwhitened(states, calibration, ())
            return (self.sqrt_information @ (value - self.measured)[..., None])[..., 0]
        lag, world_from_body, position_world = self._at_field(states, calibration)
        phasor = predict_channels(calibration, self.time, world_from_body, position_world)
        value = np.concatenate([phasor.real, phasor.imag], axis=-1)
        value += lag[:, None, None] * self.by_time_offset
        return (self.sqrt_information @ (value - self.measured)[..., None])[..., 0]

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate, a group for each channel."""
        at = self._linearization_points(states)
        value, by_pose, by_velocity, by_calibration = self.predicted.of(
            self, at, calibration, blocks
        )
        if at is not states:
            value = value + (by_pose @ pose_steps(at, states)[:, None, :, None])[..., 0]
        return Rows(
            error=(self.sqrt_information @ (value - self.measured)[..., None])[..., 0],
            by_pose=self.sqrt_information @ by_pose,
            by_velocity=None if by_velocity is None else self.sqrt_information @ by_velocity,
            by_calibration=self._whitened(by_calibration, calibration.site, blocks),
        )

    def linearized_at(self, world_from_body: Array, position_world: Array) -> "FieldPhasors":
        """Return the measurement of one epoch linearised at a pose, (3, 3) and (3,) (m)."""
        return replace(
            self, world_from_body=world_from_body[None], position_world=position_world[None]
        )

    def at_states(self) -> "FieldPhasors":
        """Return the measurement linearised at its states."""
        if self.world_from_body is None:
            return self
        return replace(self, world_from_body=None, position_world=None)

    def _linearization_points(self, states: States) -> States:
        if self.world_from_body is None or self.position_world is None:
            return states
        return replace(
            states, world_from_body=self.world_from_body, position_world=self.position_world
        )

    def _whitened(self, by_blocks: Array, site: Site, blocks: tuple[Block, ...]) -> Array:
        """Return whitened columns of blocks; of many, only those that affect each channel."""
        if by_blocks.shape[-1] < MIN_SPARSE_COLUMNS:
            return np.asarray(self.sqrt_information @ by_blocks)
        out, root = np.zeros(by_blocks.shape), self.sqrt_information
        detected = np.flatnonzero(np.any(root, axis=(0, 2, 3))).tolist()
        owner = {k: site.channels[k][0] for k in detected}
        affected = _affected_columns(blocks, set(owner.values()))
        for k, name in owner.items():
            for begin, end in affected[name]:
                out[:, k, :, begin:end] = root[:, k] @ by_blocks[:, k, :, begin:end]
        return out

    def unwhitened(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> tuple[Array, Array, Array | None, Array]:
        """Return the prediction, and its derivatives by poses, velocities and calibration."""
        velocity_body = np.swapaxes(states.world_from_body, 1, 2) @ states.velocity_world[..., None]
        twist_body = np.concatenate([self.rate_body, velocity_body[..., 0]], axis=1)
        lag, world_from_body, position_world = self._at_field(states, calibration)
        twist_body = np.where(self.moving[:, None], twist_body, 0.0)
        place = world_from_body, position_world, twist_body
        by_velocity = None
        if self.ahead is not None:
            value, by_pose, by_velocity, by_calibration = self._sequential_prediction(
                self.ahead, calibration, blocks, *place
            )
        else:
            value, by_pose, by_calibration = linearize_channels(
                calibration, blocks, self.time, *place, self.detected
            )
        value += lag[:, None, None] * self.by_time_offset
        if calibration.others and np.any(calibration.clock_offsets):
            later = calibration.clock_offsets[calibration.site.sensor]
            value += later[:, None] * (by_pose @ twist_body[:, None, :, None])[..., 0]
        by_lag = np.where(self.moving[:, None, None], self.by_time_offset, 0.0)
        for block in blocks:
            if block.parameter == TIME_OFFSET:
                by_calibration[..., block.columns.start] += by_lag
            elif block.parameter == CLOCK_RATE:
                run = self.time - calibration.imu_begin
                by_calibration[..., block.columns.start] += run[:, None, None] * by_lag
        return value, by_pose, by_velocity, by_calibration

    def _sequential_prediction(
        self,
        ahead: Array,
        calibration: Calibration,
        blocks: tuple[Block, ...],
        world_from_body: Array,
        position_world: Array,
        twist_body: Array,
    ) -> tuple[Array, Array, Array, Array]:
        """Return prediction and derivatives at the sensor's pose of each measurement."""
        count, channels = ahead.shape
        site = calibration.site
        levers = np.array([sensor.position_body for sensor in site.platform.magnetometers])
        swing = cross(twist_body.T[:3, :, None], levers.T[:, None])
        swing_body = np.moveaxis(swing, 0, -1)[:, site.sensor]
        velocity_body = twist_body[:, None, 3:] + swing_body
        velocity_world = (world_from_body[:, None] @ velocity_body[..., None])[..., 0]
        shift_world = ahead[..., None] * velocity_world
        result = linearize_channels(
            calibration,
            blocks,
            np.repeat(self.time, channels),
            np.repeat(world_from_body, channels, axis=0),
            (position_world[:, None] + shift_world).reshape(-1, 3),
            np.repeat(twist_body, channels, axis=0),
        )
        own = np.arange(count * channels), np.arange(count * channels) % channels
        value, by_pose, by_calibration = (
            part[own].reshape(count, channels, *part.shape[2:]) for part in result
        )
        by_place = ahead[..., None, None] * by_pose[..., 3:]
        by_velocity = by_place @ np.swapaxes(world_from_body, 1, 2)[:, None]
        by_pose[..., :3] -= by_place @ skew(swing_body)
        return value, by_pose, by_velocity, by_calibration

    def distances(
        self, state: State, blocks: tuple[Block, ...], _limit: Array | float = np.inf
    ) -> Array:
        """Return the squared distance of each channel's innovation of an epoch, (channels,)."""
        rows = self.linearize(states_of([state]), state.calibration, blocks)
        return group_distances(rows, state.cov)[0]

    def without(self, rejected: BoolArray) -> "FieldPhasors":
        """Return the measurement without some channels, shape (channels,)."""
        kept = np.where(rejected[:, None, None], 0.0, self.sqrt_information)
        return replace(self, sqrt_information=kept)

    def _at_field(self, states: States, calibration: Calibration) -> tuple[Array, Array, Array]:
        """Return lag, attitude and position at the measurement of the field.

        The states use the IMU's clock: the measurement was a little before or after.
        """
        lag = np.where(self.moving, calibration.imu_offset(self.time) - self.applied_offset, 0.0)
        turn = matrices(of_vectors((-lag[:, None] * self.rate_body).T))
        return (
            lag,
            states.world_from_body @ turn,
            states.position_world - lag[:, None] * states.velocity_world,
        )


def _affected_columns(
    blocks: tuple[Block, ...], names: set[str]
) -> dict[str, list[tuple[int, int]]]:
    """Return ranges of columns that affect the phasors of each beacon."""
    result: dict[str, list[tuple[int, int]]] = {name: [] for name in names}
    every = list(result.values())
    for parameter, owner, columns, _ in blocks:
        alone = isinstance(parameter, BeaconParameter)
        for own in [result[owner]] if alone and owner in result else () if alone else every:
            begin = own.pop()[0] if own and own[-1][1] == columns.start else columns.start
            own.append((begin, columns.stop))
    return result


class Predictions:
    """Cache of the last two predictions of a single epoch, for gate, score, filter and subsets.

    Shared by measurements that differ in weights alone, or use a leading part of the parameters.
    """

    def __init__(self) -> None:
        self._kept: list[_Prediction] = []

    def of(
        self,
        phasors: FieldPhasors,
        states: States,
        calibration: Calibration,
        blocks: tuple[Block, ...],
    ) -> "_Unwhitened":
        """Return `FieldPhasors.unwhitened`."""
        if len(states) != 1:
            return phasors.unwhitened(states, calibration, blocks)
        pose = states.world_from_body, states.position_world, states.velocity_world
        at = tuple(part.tobytes() for part in pose)
        clocks = phasors.rate_body, phasors.by_time_offset, phasors.applied_offset, phasors.moving
        of = (calibration, *clocks, phasors.ahead)
        for known in self._kept:
            if at == known.at and all(a is b for a, b in zip(of, known.of, strict=True)):
                if known.blocks is blocks:
                    return known.unwhitened
                if all(a is b for a, b in zip_longest(blocks, known.blocks[: len(blocks)])):
                    value, by_pose, by_velocity, by_calibration = known.unwhitened
                    return value, by_pose, by_velocity, by_calibration[..., : dimension(blocks)]
        result = phasors.unwhitened(states, calibration, blocks)
        self._kept = [*self._kept[-1:], _Prediction(at, of, blocks, result)]
        return result


_Unwhitened = tuple[Array, Array, Array | None, Array]


class _Prediction(NamedTuple):
    """A prediction with the state and other inputs that it depends on."""

    at: tuple[bytes, ...]
    of: tuple[object, ...]
    blocks: tuple[Block, ...]
    unwhitened: _Unwhitened


def field_phasors(
    site: Site,
    samples: FieldSamples,
    epoch: IntArray,
    poses: Trajectory,
    rate_body: Array,
    applied_offset: Array,
    repeats: float,
    by_time_offset: ComplexArray | None = None,
    shared_by: Array | float = 1.0,
    standing: BoolArray | None = None,
    others: bool = True,
) -> FieldPhasors:
    """Return phasors as a measurement, weighted at approximate poses.

    Parameters
    ----------
    epoch : int ndarray, shape (n,)
        Indices of their states.
    poses : Trajectory
        At the same epochs.
    rate_body : ndarray, shape (n, 3)
        Angular rate without its bias (rad/s).
    applied_offset : ndarray, shape (n,)
        IMU time offset used to cut the inertial data (s).
    repeats : float
        Number of epochs that contain each sample of overlapping windows, to count it once.
    by_time_offset : complex ndarray, shape (n, channels, 3), optional
        As of `magfusion.estimation.demodulation.motion_compensation.WaveFields`.
    shared_by : ndarray, shape (n,), or float
        Number of epochs with the same model error; at least the number of windows of a sample.
    standing : bool ndarray, shape (n,), optional
        Where the platform is known to be stationary.
    others : bool
        As of `magfusion.model.noise.measurement_cov`.
    """
    place = sensor_positions(site, poses)
    together = np.maximum(shared_by, repeats)
    cov, single = weighed_and_alone(site, samples, place, repeats, together, neighbours=others)
    more, own = (np.trace(c, axis1=2, axis2=3) for c in (cov, repeats * single))
    excess = np.divide(more, own, out=np.ones_like(own), where=samples.valid)
    measured = stacked(samples.phasor_sensor)
    by_lag = np.zeros_like(measured) if by_time_offset is None else stacked(by_time_offset)
    return FieldPhasors(
        epoch=epoch,
        time=samples.time,
        measured=measured,
        sqrt_information=whitened_along(paired_whitening(cov, samples.there), samples),
        rate_body=rate_body,
        by_time_offset=by_lag,
        applied_offset=applied_offset,
        moving=np.ones(len(epoch), dtype=bool) if standing is None else ~standing,
        ahead=samples.ahead,
        excess=excess,
        detected=samples.valid if are_many(site) else None,
    )


def leaves_out(measurements: Sequence[Measurement]) -> bool:
    """Return whether some channels are not predicted, with zero rows."""
    return any(isinstance(m, FieldPhasors) and m.detected is not None for m in measurements)


def alone(measurement: Measurement) -> Measurement:
    """Return a measurement whitened as independent epochs, without shared weights."""
    return measurement.alone() if isinstance(measurement, FieldPhasors) else measurement
