"""Initial states for the fix of a receiver with one or two axes, or with missing components.

The Gram matrix of three components, which gives the range, is then not available.  An axis ``s``
measures ``s . B_j(p)`` of a beacon, so that a grid of positions around the beacons is evaluated in
closed form, as for a single coil (`magfusion.estimation.snapshot.coil_starts`).  The axes that fit
best there must then have the lengths and angles of the receiver's axes.
"""

from dataclasses import dataclass, field

import numpy as np

from magfusion.estimation.snapshot.candidates import wahba
from magfusion.estimation.snapshot.coil_starts import (
    FLAT,
    FLOOR,
    LIKELY,
    SOFT,
    CoilGrid,
    at_point,
    grid_about,
    mirror,
    roots,
)
from magfusion.estimation.snapshot.problem import FixProblem, FixState
from magfusion.model.one_axis import least_turn
from magfusion.model.parameters import predict_channels
from magfusion.units import TINY, Array, BoolArray, ComplexArray, IntArray

KEPT = 24  # positions of the grid that are refined roughly
SHAPE = 0.2  # error of the axes fitted there, relative to their length
MIN_ROTATION = 1e-6  # weight of the world's axes, to select the smallest of the open rotations


def starts_on_grid(problem: FixProblem) -> tuple[FixState, int]:
    """Return the most probable states of epochs that lack components, so many rows an epoch.

    `problem`: its whitening is zero where a component is missing. Raises EstimationError where no
    grid can be built around the beacons.
    """
    requested = _AxisGrid.of(problem)
    result = [requested.starts(row) for row in range(len(problem.time))]
    rotation, place = (np.stack(part) for part in zip(*result, strict=True))
    position = place - rotation @ problem.calibration.site.platform.magnetometer.position_body
    if problem.prior is not None:
        rotation = np.concatenate([problem.prior.rotation[:, None], rotation], axis=1)
        position = np.concatenate([problem.prior.position[:, None], position], axis=1)
    n, count = rotation.shape[:2]
    state = problem.start(rotation.reshape(-1, 3, 3), position.reshape(-1, 3))
    if np.any(requested.free_parameters):
        own = problem.rows(np.repeat(np.arange(n), count))
        state = state._replace(phase=phases_of(own, state, requested.free_parameters))
    return state, count


def mirrored(problem: FixProblem, state: FixState) -> FixState:
    """Return states mirrored in the plane that the beacons are nearest to."""
    middle, turn = mirror(problem.calibration.site)
    lever = problem.calibration.site.platform.magnetometer.position_body
    place, rotation = state.position + state.rotation @ lever, turn @ state.rotation
    position = middle - (place - middle) @ turn - rotation @ lever
    return state._replace(rotation=rotation, position=position)


def with_least_roll(problem: FixProblem, state: FixState) -> FixState:
    """Return states with the smallest rotation if the roll about the received axis is open.

    Equal epochs then have equal poses, whatever the start. `problem`: for the same rows.
    """
    informed = problem.prior is not None and problem.prior.sqrt_information is not None
    detected = np.any(np.einsum("...ii->...i", problem.sqrt_information) > 0.0, axis=1)
    rows = np.sum(detected, axis=1) == 1
    if problem.gravity is not None:
        rows &= ~np.isfinite(problem.gravity.sigma)
    if informed or not np.any(rows):
        return state
    sensor = problem.calibration.site.platform.magnetometer
    axes = (sensor.matrix @ sensor.body_from_sensor.T)[np.argmax(detected[rows], axis=1)]
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    rotation, position = state.rotation.copy(), state.position.copy()
    rotation[rows] = least_turn(axes, (state.rotation[rows] @ axes[..., None])[..., 0])
    position[rows] += (state.rotation[rows] - rotation[rows]) @ sensor.position_body
    return state._replace(rotation=rotation, position=position)


def phases_of(problem: FixProblem, state: FixState, free_parameters: BoolArray) -> Array:
    """Return the drive phases that fit the phasors best at each state, (m, channels)."""
    seen = predict_channels(problem.at(state), problem.time, state.rotation, state.position)
    measured = problem.measured[..., :3] + 1j * problem.measured[..., 3:]
    there = np.einsum("...ii->...i", problem.sqrt_information) > 0.0
    lag = np.angle(np.sum(np.where(there, np.conj(seen) * measured, 0.0), axis=-1))
    return np.where(free_parameters, lag, 0.0)


@dataclass(frozen=True, eq=False)
class _AxisGrid:
    """Grid, and the measurements of each axis at every epoch."""

    problem: FixProblem
    grid: CoilGrid
    phasor: ComplexArray  # (n, channels, 3) (T)
    there: BoolArray  # (n, channels, 3)
    sigma: Array  # (n, channels, 3), of the real and of the imaginary part (T)
    axes_body: Array  # (3, 3), the receiver's axes, row by row, each times its gain
    # (channels,), channels of unknown drive phase: with any, the grid ignores signs
    free_parameters: BoolArray
    bases: dict[bytes, tuple[Array, Array]] = field(default_factory=dict)

    @staticmethod
    def of(problem: FixProblem) -> "_AxisGrid":
        """Return the grid and measurements of a problem."""
        site, known = problem.calibration.site, at_point(problem.calibration)
        sensor = site.platform.magnetometer
        free_parameters = np.concatenate(
            [np.full(len(b.tones), not b.synchronised) for b in site.beacons]
        )
        places, time = grid_about(site), float(np.mean(problem.time))
        inverse = np.einsum("...ii->...i", problem.sqrt_information)
        there = inverse > 0.0
        return _AxisGrid(
            problem,
            CoilGrid.of(known, time, places, signed=not np.any(free_parameters)),
            problem.measured[..., :3] + 1j * problem.measured[..., 3:],
            there,
            np.divide(1.0, inverse, out=np.ones_like(inverse), where=there),
            sensor.matrix @ sensor.body_from_sensor.T,
            free_parameters,
        )

    @property
    def signed(self) -> bool:
        """Whether phases determine signs."""
        return not np.any(self.free_parameters)

    def starts(self, row: int) -> tuple[Array, Array]:
        """Return the most probable attitudes of the body and receiver positions at an epoch."""
        own = np.flatnonzero(np.any(self.there[row], axis=0))
        cost = np.zeros(len(self.grid.places_world))
        for k in own:
            cost += self._misfit(row, int(k))
        best = np.argsort(cost, kind="stable")[:LIKELY]
        axes, misfit = np.empty((len(best), len(own), 3)), np.zeros(len(best))
        for i, k in enumerate(own):
            axes[:, i], part = self._axes(row, int(k), best)
            misfit += part
        misfit += _misshapen(axes, self.axes_body[own])
        again = np.argsort(misfit, kind="stable")[:KEPT]
        axes, place = axes[again], self.grid.places_world[best[again]]
        if self.signed:
            return self._turns(row, own, axes), place
        axes = self._one_sign(row, own, axes, best[again])
        turns = [self._turns(row, own, sign * axes) for sign in (1.0, -1.0)]
        return np.concatenate(turns), np.concatenate([place, place])

    def _rows(self, row: int, k: int) -> tuple[Array, BoolArray]:
        """Return the measurements of an axis as rows of the grid's design, and which exist."""
        value, there = self.phasor[row, :, k], self.there[row, :, k]
        if not self.signed:
            return np.abs(value) ** 2, there
        return np.concatenate([value.real, value.imag]), np.concatenate([there, there])

    def _misfit(self, row: int, k: int) -> Array:
        """Return the relative residual of the best axis at each position, shape (g,)."""
        given, there = self._rows(row, k)
        scale, basis = self._basis(there)
        target = np.where(there, given, 0.0) * scale
        along = (target[:, None] @ basis)[:, 0]
        total = np.sum(target**2, axis=1)
        return np.asarray(1.0 - np.sum(along**2, axis=1) / np.maximum(total, TINY))

    def _basis(self, there: BoolArray) -> tuple[Array, Array]:
        """Return the weights of rows at each position, and a basis of all predictions there."""
        if there.tobytes() not in self.bases:
            scale = np.where(there, self.grid.scale, 0.0)
            residual, size, _ = np.linalg.svd(
                self.grid.design * scale[..., None], full_matrices=False
            )
            affected = (size > FLAT * size[:, :1])[:, None]
            self.bases.clear()  # cache the latest pattern only
            self.bases[there.tobytes()] = scale, np.where(affected, residual, 0.0)
        return self.bases[there.tobytes()]

    def _axes(self, row: int, k: int, best: IntArray) -> tuple[Array, Array]:
        """Return the axis that fits best at positions, shape (m, 3), and its chi square."""
        given, there = self._rows(row, k)
        size = np.abs(self.phasor[row, :, k]) * self.there[row, :, k]
        noise = np.where(self.there[row, :, k], self.sigma[row, :, k], 1.0)
        soft = np.sqrt(noise**2 + (SOFT * size) ** 2 + (FLOOR * np.max(size)) ** 2)
        soft = np.concatenate([soft, soft]) if self.signed else 2.0 * soft * np.maximum(size, soft)
        weight = np.where(there, 1.0 / soft, 0.0)
        design, target = self.grid.design[best] * weight[:, None], np.where(there, given, 0.0)
        result = np.linalg.pinv(design, rcond=1e-6) @ (target * weight)
        residual = (design @ result[..., None])[..., 0] - target * weight
        axes = result if self.signed else roots(result)
        return axes, np.sum(residual**2, axis=1)

    def _one_sign(self, row: int, own: IntArray, axes: Array, places: IntArray) -> Array:
        """Return axes with signs consistent with the first: their phasors have equal phase."""
        seen = np.einsum("gcx,gax->gac", self.grid.field[places], axes)
        measured = np.where(self.there[row], self.phasor[row], 0.0).T[own]
        ours = np.real(seen[:, :1] * np.conj(seen))
        others = np.real(measured[:1] * np.conj(measured))
        sign = np.where(np.sum(ours * others, axis=-1) < 0.0, -1.0, 1.0)
        return np.asarray(sign[..., None] * axes)

    def _turns(self, row: int, own: IntArray, axes: Array) -> Array:
        """Return the attitudes that align the body's axes with those fitted, shape (m, 3, 3)."""
        length = np.linalg.norm(axes, axis=-1, keepdims=True)
        body = self.axes_body[own]
        body = body / np.linalg.norm(body, axis=-1, keepdims=True)
        along = np.einsum("gki,kj->gij", axes / np.maximum(length, TINY), body)
        gravity = self.problem.gravity
        if gravity is not None and np.isfinite(gravity.sigma[row]):
            along[:, 2] += gravity.up_body[row]
        return wahba(along + MIN_ROTATION * np.eye(3))


def _misshapen(axes: Array, body: Array) -> Array:
    """Return the chi square of axes (m, k, 3) against rotated axes of the body."""
    gain = np.linalg.norm(body, axis=-1)
    unit, own = axes / gain[:, None], body / gain[:, None]
    product = unit @ np.swapaxes(unit, 1, 2) - own @ own.T
    pairs = np.triu_indices(len(body))
    return np.asarray(np.sum((product[:, *pairs] / (2.0 * SHAPE)) ** 2, axis=1))
