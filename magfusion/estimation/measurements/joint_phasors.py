"""Close tones as a measurement: joint information of short windows on all of them."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.estimation.graph.measurement import Loss, Measurement, Rows
from magfusion.estimation.graph.state import MOTION, State, States, states_of
from magfusion.estimation.measurements.phasors import FieldPhasors
from magfusion.model.field import skew
from magfusion.model.parameters import Block, Calibration
from magfusion.units import Array, BoolArray

NOTHING_LEFT = 1e-6  # of a channel's information, after exclusion of others


@dataclass(frozen=True, eq=False)
class JointPhasors(Measurement):
    """Directions of the samples of short windows, each of all phasors; one group an epoch."""

    time: Array  # (n,), centres of the windows (s)
    # (n, 3 directions), residual of the prediction plus its value at the nodes (T); axes of the
    # centre
    measured: Array
    # (n, directions, nodes, 2 channels), by real and imaginary part of each channel's phasor; zero
    # for channels not predicted
    basis: Array
    whitening: Array  # (n, 3 directions, 3 directions)
    elapsed: Array  # (n, nodes), of the nodes, from the centre (s)
    # (n, nodes, 3), displacement of the sensor beyond a steady velocity, axes of the centre (m)
    shift_body: Array
    strength: Array  # (n, nodes, channels), of each channel's field, relative to that at the centre
    rate_body: Array  # (n, 3), as of `FieldPhasors`, as are the next two (rad/s)
    applied_offset: Array  # (n,)
    moving: BoolArray  # (n,)
    is_predicted: BoolArray  # (n, channels), channels that are predicted
    robust: str | None = None  # loss of each window: 'huber' or 'cauchy'

    @property
    def loss(self) -> Loss | None:
        """Robust loss of each window."""
        return None if self.robust is None else Loss(self.robust)

    def alone(self) -> "JointPhasors":
        """Return the measurement unchanged, as no sample is in two epochs."""
        return self

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate, a group for each window."""
        nodes = self._at_nodes(states)
        value, by_pose, _, by_calibration = self._phasors.unwhitened(nodes, calibration, blocks)
        by_place = by_pose[..., 3:]
        shift = self.shift_body.reshape(-1, 1, 3)
        by_pose[..., :3] -= by_place @ skew(shift)
        body_from_world = np.swapaxes(nodes.world_from_body, 1, 2)[:, None]
        by_velocity = self.elapsed.reshape(-1, 1, 1, 1) * by_place @ body_from_world
        parts = by_pose, by_velocity, by_calibration
        by = (self.whitening @ self._directions(part) for part in parts)
        by_pose, by_velocity, by_calibration = (part[:, None] for part in by)
        return Rows(
            error=self._error(value)[:, None],
            by_pose=by_pose,
            by_velocity=by_velocity,
            by_calibration=by_calibration,
        )

    def error(self, states: States, calibration: Calibration) -> Array:
        """Return the whitened error, shape (n, 1, 3 directions), without a derivative."""
        phasors, nodes = self._phasors, self._at_nodes(states)
        unit = np.broadcast_to(np.eye(6), (len(nodes), self.is_predicted.shape[1], 6, 6))
        value = replace(phasors, sqrt_information=unit).error(nodes, calibration)
        return self._error(value)[:, None]

    @property
    def _phasors(self) -> FieldPhasors:
        """Phasors at the nodes, from which the directions are computed."""
        nothing = np.zeros((self.elapsed.size, self.is_predicted.shape[1], 6))
        every = np.repeat(np.arange(len(self.time)), self.elapsed.shape[1])
        return FieldPhasors(
            epoch=self.epoch[every],
            time=self.time[every],
            measured=nothing,
            sqrt_information=nothing[..., None],
            rate_body=self.rate_body[every],
            by_time_offset=nothing,
            applied_offset=self.applied_offset[every],
            moving=self.moving[every],
            detected=self.is_predicted[every],
        )

    def _at_nodes(self, states: States) -> States:
        """Return states with the attitude of the centre, and the sensor's position at the nodes."""
        every = np.repeat(np.arange(len(states)), self.elapsed.shape[1])
        turn, velocity = states.world_from_body[every], states.velocity_world[every]
        shift = (turn @ self.shift_body.reshape(-1, 3, 1))[..., 0]
        moved = states.position_world[every] + self.elapsed.reshape(-1, 1) * velocity + shift
        return States(turn, moved, velocity, lambda: states.read_bias()[every])

    def _error(self, value: Array) -> Array:
        off = self._directions(value[..., None])[..., 0] - self.measured
        return (self.whitening @ off[..., None])[..., 0]

    def _directions(self, by: Array) -> Array:
        """Transform columns of phasors (n nodes, channels, 6, k) to the directions."""
        return in_directions(self.basis, by)

    # Channel by channel, as far as they are separable

    def of_channels(self) -> Array:
        """Return the effect of a phasor's parts on the whitened rows, (n, channels, rows, 6)."""
        n, directions, nodes, _ = self.basis.shape
        parts = self.basis.reshape(n, directions, nodes, -1, 2)
        whole = np.einsum("nrkcp,nkc->ncrp", parts, self.strength)
        unit = np.einsum("ncrp,ab->ncrapb", whole, np.eye(3))
        return np.asarray(self.whitening[:, None] @ unit.reshape(n, -1, 3 * directions, 6))

    def distances(
        self, state: State, blocks: tuple[Block, ...], limit: Array | float = np.inf
    ) -> Array:
        """Return the squared distance of each channel's innovation of an epoch, (channels,).

        Decrease of the total distance by an arbitrary phasor of that channel.  As neighbours are
        only partly separable, the worst beyond its limit is excluded before the others are
        evaluated, and so on.
        """
        result, out = (
            self._distances(state, blocks),
            np.zeros(self.is_predicted.shape[1], dtype=bool),
        )
        excess = result / limit
        while np.max(excess) > 1.0 and 2 * np.sum(out) < np.sum(self.is_predicted):
            out[np.argmax(excess)] = True
            remaining = self.without(out)._distances(state, blocks)
            result = np.where(out, result, remaining)
            excess = np.where(out, 0.0, remaining / limit)
        return result

    def _distances(self, state: State, blocks: tuple[Block, ...]) -> Array:
        rows = self.linearize(states_of([state]), state.calibration, blocks)
        jacobian = rows.jacobian(len(state.cov) - MOTION)[0, 0]
        error, by = rows.error[0, 0], self.of_channels()[0]
        spread = jacobian @ state.cov @ jacobian.T + np.eye(len(error))
        solved = np.linalg.solve(spread, np.column_stack([error, *by]))
        own, across = solved[:, 0], solved[:, 1:].reshape(len(error), -1, 6)
        reported = np.swapaxes(by, 1, 2) @ np.swapaxes(across, 0, 1)
        seen = np.einsum("crk,r->ck", by, own)
        size = np.trace(reported, axis1=1, axis2=2)
        least = NOTHING_LEFT * np.max(size, initial=0.0)
        affected = self.is_predicted[0] & (size > least)
        safe = np.where(
            affected[:, None, None], reported + 1e-9 * size[:, None, None] * np.eye(6), np.eye(6)
        )
        result = np.einsum("ck,ck->c", seen, np.linalg.solve(safe, seen[..., None])[..., 0])
        return np.where(affected, result, 0.0)

    def spanned(self, channels: BoolArray) -> Array:
        """Return an orthonormal basis of the whitened rows spanned by phasors of channels.

        `channels` (n, channels). Returns (n, rows, k): padded with zero columns.
        """
        by = np.where(channels[..., None, None], self.of_channels(), 0.0)
        by = np.moveaxis(by, 1, 2).reshape(len(by), by.shape[2], -1)
        basis, size, _ = np.linalg.svd(by, full_matrices=False)
        reported = (size > NOTHING_LEFT * size[:, :1]) & (size > 0.0)
        return np.where(reported[:, None], basis, 0.0)

    def without(self, rejected: BoolArray) -> "JointPhasors":
        """Return the measurement with arbitrary phasors for some channels, shape (channels,)."""
        return self.leaving_out(np.broadcast_to(rejected, self.is_predicted.shape))

    def leaving_out(self, rejected: BoolArray) -> "JointPhasors":
        """Return the measurement without some channels, shape (n, channels), at each epoch."""
        rows = np.any(rejected & self.is_predicted, axis=1)
        if not np.any(rows):
            return self
        some = self.rows(rows)
        basis, whitening = some.spanned(rejected[rows]), self.whitening.copy()
        whitening[rows] -= basis @ (np.swapaxes(basis, 1, 2) @ some.whitening)
        return replace(self, whitening=whitening)


def at_nearest(time: Array, seen: BoolArray, wanted: Array) -> BoolArray:
    """Return the flags of epochs at the times nearest to them, shape (m, channels)."""
    middle = 0.5 * (time[1:] + time[:-1])
    return np.asarray(seen[np.searchsorted(middle, wanted)])


def in_directions(basis: Array, by: Array) -> Array:
    """Transform columns of phasors to those of directions.

    `basis` (n, directions, nodes, 2 channels), `by` (n nodes, channels, 6, k). Returns
    (n, 3 directions, k).
    """
    n, directions, nodes, parts = basis.shape
    width = by.shape[-1]
    flat = by.reshape(n, nodes * parts, 3 * width)
    result = basis.reshape(n, directions, nodes * parts) @ flat
    return np.asarray(result.reshape(n, 3 * directions, width))
