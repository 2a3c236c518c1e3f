"""Fix of a receiver of one axis: position and direction of its coil.

The most probable positions of a grid are refined together with the axis on the measurement model.
The roll about the coil has no effect.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.estimation.snapshot.coil_starts import (
    CoilEpochs,
    CoilGrid,
    at_point,
    grid_about,
    middle_of,
    mirror,
    softened,
)
from magfusion.estimation.snapshot.place import SOFT_EDGE
from magfusion.estimation.solve.batched import (
    Model,
    NormalEquations,
    minimise,
    normal_equations,
    open_inverse,
)
from magfusion.model.coil_field import as_points
from magfusion.model.noise import calibration_error, model_error
from magfusion.model.parameters import Calibration, linearize_channels, predict_channels
from magfusion.model.site import Magnetometer, Site
from magfusion.units import Array, BoolArray, IntArray

DUPLICATE_DISTANCE = 1e-3  # of the distance; hypotheses closer to one another are one
RIVAL = 25.0  # chi square above the best, from which a hypothesis is dropped
MIN_GAIN_SIGMA = 1e-4  # lower bound of a declared sigma
UNKNOWNS = 6  # of position, direction and gain
CHUNK = 200  # epochs refined at once
REFINED, MIRRORED = 12, 3  # rough starts that are refined, and results whose mirrors are tried
ROUGH_ITERATIONS = 20
ROUGH = 1e-4  # relative decrease of the cost below which a start has converged


class Gain(NamedTuple):
    """Prior of a coil's gain."""

    nominal: float = 1.0
    sigma: float = np.inf  # standard deviation of its logarithm; infinite if it is unknown

    @staticmethod
    def of(sensor: Magnetometer, *, free_parameters: bool) -> "Gain":
        """Return the gain of the one axis of a magnetometer, as declared or unknown."""
        row = "xyz".index(sensor.axes)
        nominal = float(np.linalg.norm(sensor.matrix[row]))
        sigma = float(sensor.sigma.matrix[row, row]) / nominal
        return Gain(nominal, np.inf if free_parameters else max(sigma, MIN_GAIN_SIGMA))


@dataclass(frozen=True, eq=False)
class CoilFixes:
    """Hypotheses of a coil at each epoch, the most probable first."""

    position_world: Array  # (n, hypotheses, 3), of the coil (m)
    # (n, hypotheses, 3), its axis times its gain; of unknown sign if the amplitudes have none
    axis_world: Array
    cov: Array  # (n, hypotheses, 6, 6), of position and axis
    # (n, hypotheses), minus twice the logarithm of their likelihood, the first of each epoch its
    # chi square; infinite if an epoch has fewer
    cost: Array
    determined: BoolArray  # (n, hypotheses), False where position, direction or gain is open
    freedom: Array  # (n,), degrees of freedom of the chi square


def fix_coil(epochs: CoilEpochs, calibration: Calibration, gain: Gain) -> CoilFixes:
    """Return position and direction of the coil at each epoch.

    `epochs`: at least one. `gain`: of the coil. Raises EstimationError where the declared region
    contains no position to test.
    """
    known = at_point(calibration)
    places = grid_about(known.site)
    grid = CoilGrid.of(known, float(epochs.time[0]), places, signed=epochs.signed)
    parts = [
        _refined(epochs.rows(slice(start, start + CHUNK)), known, gain, grid)
        for start in range(0, len(epochs), CHUNK)
    ]
    every = _Refined(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    return _ranked(every, middle_of(known.site.beacons)[0])


class _Refined(NamedTuple):
    """Refined states of the starts of epochs."""

    state: Array  # (n, starts, 6)
    cov: Array  # (n, starts, 6, 6)
    cost: Array  # (n, starts)
    chi_square: Array  # (n, starts)
    determined: BoolArray  # (n, starts)
    freedom: Array  # (n,)

    def joined_with(self, other: "_Refined") -> "_Refined":
        """Return these results and others of the same epochs."""
        return _Refined(
            np.concatenate([self.state, other.state], axis=1),
            np.concatenate([self.cov, other.cov], axis=1),
            np.concatenate([self.cost, other.cost], axis=1),
            np.concatenate([self.chi_square, other.chi_square], axis=1),
            np.concatenate([self.determined, other.determined], axis=1),
            self.freedom,
        )


def _refined(epochs: CoilEpochs, known: Calibration, gain: Gain, grid: CoilGrid) -> _Refined:
    place, axis = grid.starts(epochs)
    count = place.shape[1]
    if np.isfinite(gain.sigma):
        axis = axis * (gain.nominal / np.linalg.norm(axis, axis=-1, keepdims=True))
    problem, points = _Problem(epochs, known, gain), _Problem(epochs, _of_points(known), gain)
    start = np.concatenate([place, axis], axis=2).reshape(-1, 6)
    owner = np.repeat(np.arange(len(epochs)), count)
    # Grid positions are approximate: with full weights some converge to the wrong minimum, and
    # there dipoles are as good as coils of finite size.
    soft = points.of(owner, softened(epochs)[owner])
    rough = minimise(soft, start, relative=ROUGH, max_iterations=ROUGH_ITERATIONS)
    order = np.argsort(rough.cost.reshape(-1, count), axis=1, kind="stable")[:, :REFINED]
    best = np.take_along_axis(rough.state.reshape(-1, count, 6), order[..., None], axis=1)
    result = _solved(problem, best)
    # One outside of the region is tried by its mirror, which is inside.
    outside = _outside(known.site, result.state[..., :3], result.cov[..., :3, :3])
    order = np.argsort(result.cost - outside, axis=1, kind="stable")[:, :MIRRORED]
    best = np.take_along_axis(result.state, order[..., None], axis=1)
    # An amplitude with a wrong sign keeps it in a false minimum, which is shallow.
    owner = np.repeat(np.arange(len(epochs)), best.shape[1])
    soft = problem.of(owner, softened(epochs)[owner])
    relaxed = minimise(soft, best.reshape(-1, 6), relative=ROUGH, max_iterations=ROUGH_ITERATIONS)
    best = relaxed.state.reshape(best.shape)
    other = _solved(problem, np.concatenate([best, _mirrored(best, known.site)], axis=1))
    return result.joined_with(other)


def _solved(problem: "_Problem", start: Array) -> _Refined:
    """Refine starts, shape (n, starts, 6), with their weights."""
    epochs, site, count = problem.epochs, problem.calibration.site, start.shape[1]
    start = start.reshape(-1, 6)
    owner = np.repeat(np.arange(len(epochs)), count)
    sigma = problem.sigma(owner, start)
    solved = minimise(problem.of(owner, sigma), start)
    state, chi_square = solved.state.reshape(-1, count, 6), solved.cost.reshape(-1, count)
    # Weights differ by position: where they are small, a small residual is no evidence.
    share = np.sum(np.log(sigma / problem.sigma(owner, None)), axis=1).reshape(-1, count)
    cost = chi_square + share * (4.0 if epochs.signed else 2.0)
    # In units of the gain, which may have any value: openness then depends on direction alone.
    unit = np.ones((len(solved.state), 6))
    unit[:, 3:] = np.linalg.norm(solved.state[:, 3:], axis=1, keepdims=True)
    square = unit[:, :, None] * unit[:, None, :]
    inverse, determined = open_inverse(solved.information * square)
    cov = (inverse * square).reshape(-1, count, 6, 6)
    cost = cost + _outside(site, state[..., :3], cov[..., :3, :3])
    if not epochs.signed:  # of both signs, the one that points up
        sign = np.ones_like(state)
        sign[..., 3:] = np.where(state[..., 5:] < 0.0, -1.0, 1.0)
        state, cov = sign * state, sign[..., :, None] * cov * sign[..., None, :]
    there = np.sum(np.isfinite(epochs.measured), axis=1) * (2.0 if epochs.signed else 1.0)
    freedom = np.asarray(there - UNKNOWNS + float(np.isfinite(problem.gain.sigma)))
    return _Refined(state, cov, cost, chi_square, determined.reshape(-1, count), freedom)


def _mirrored(state: Array, site: Site) -> Array:
    """Return states mirrored in the plane to which the beacons are nearest."""
    middle, turn = mirror(site)
    return np.concatenate([middle - (state[..., :3] - middle) @ turn, state[..., 3:] @ turn], -1)


def _of_points(calibration: Calibration) -> Calibration:
    beacons = tuple(as_points(beacon) for beacon in calibration.site.beacons)
    return replace(calibration, site=replace(calibration.site, beacons=beacons))


def _outside(site: Site, place: Array, cov: Array) -> Array:
    """Return the cost of hypotheses outside of the region, shape (n, hypotheses)."""
    if site.bounds is None:
        return np.zeros(place.shape[:-1])
    margin, normal = site.bounds.margin(place), site.bounds.normal_world
    variance = np.einsum("ki,nhij,kj->nhk", normal, cov, normal)
    away = np.min(_distances(site, place), axis=-1)[..., None]
    score = margin / np.sqrt(np.maximum(variance, 0.0) + (SOFT_EDGE * away) ** 2)
    return np.asarray(np.sum(np.minimum(score, 0.0) ** 2, axis=-1))


def _distances(site: Site, place: Array) -> Array:
    centres = np.array([beacon.position_world for beacon in site.beacons])
    return np.asarray(np.linalg.norm(place[..., None, :] - centres, axis=-1))


@dataclass(frozen=True, eq=False)
class _Problem:
    """Position and axis of the coil at every epoch."""

    epochs: CoilEpochs
    calibration: Calibration
    gain: Gain

    def of(self, owner: IntArray, sigma: Array) -> Model:
        """Return the model of starts, each of an epoch, with the errors of its channels."""

        def model(rows: IntArray, state: Array) -> NormalEquations:
            return self.normal(owner[rows], state, sigma[rows])

        return model

    def sigma(self, epoch: IntArray, state: Array | None) -> Array:
        """Return the errors of channels at states, or noise alone, shape (k, channels) (T)."""
        there = np.isfinite(self.epochs.measured[epoch])
        noise = np.where(there, self.epochs.sigma[epoch], 1.0)
        if state is None:
            return noise
        place, axis = state[:, :3], state[:, 3:]
        attitude = np.broadcast_to(np.eye(3), (len(state), 3, 3))
        field = predict_channels(self.calibration, self.epochs.time[epoch], attitude, place)
        size = np.linalg.norm(field, axis=2) * np.linalg.norm(axis, axis=1, keepdims=True)
        error = self._error(place) * size / np.sqrt(3.0)
        if self.epochs.swing is not None:  # in an unknown direction, as the roll is open
            error = np.hypot(error, self.epochs.swing[epoch] * size / np.sqrt(2.0))
        if self.epochs.shift is not None:  # a dipole's field falls with the third power
            away = _distances(self.calibration.site, place)[:, self.calibration.site.owner]
            error = np.hypot(error, 3.0 * self.epochs.shift[epoch] / away * size / np.sqrt(3.0))
        return np.asarray(np.where(there, np.hypot(noise, error), 1.0))

    def normal(self, epoch: IntArray, state: Array, sigma: Array) -> NormalEquations:
        """Return the normal equations at states of position and axis, shape (k, 6)."""
        place, axis, count = state[:, :3], state[:, 3:], len(state)
        attitude = np.broadcast_to(np.eye(3), (count, 3, 3))
        value, by_pose, _ = linearize_channels(
            self.calibration, (), self.epochs.time[epoch], attitude, place
        )
        field = value[..., :3] + 1j * value[..., 3:]
        slope = by_pose[..., :3, 3:] + 1j * by_pose[..., 3:, 3:]
        seen = np.einsum("kcx,kx->kc", field, axis)
        by_place = np.einsum("kcxy,kx->kcy", slope, axis)
        measured = self.epochs.measured[epoch]
        there = np.isfinite(measured)
        weight = np.where(there, 1.0 / sigma, 0.0)
        jacobian = np.concatenate([by_place, field], axis=2)
        remaining = seen - np.where(there, measured, 0.0)
        if self.epochs.signed:
            rows = np.concatenate([jacobian.real, jacobian.imag], axis=1)
            residual = np.concatenate([remaining.real, remaining.imag], axis=1)
            weight = np.concatenate([weight, weight], axis=1)
        else:
            size = np.abs(seen)
            rows = ((np.conj(seen) / np.maximum(size, 1e-300))[..., None] * jacobian).real
            residual = size - np.where(there, measured.real, 0.0)
        residual, rows = residual * weight, rows * weight[..., None]
        if np.isfinite(self.gain.sigma):
            gain = np.linalg.norm(axis, axis=1)
            prior = np.log(gain / self.gain.nominal) / self.gain.sigma
            by_axis = axis / (self.gain.sigma * gain**2)[:, None]
            own = np.concatenate([np.zeros((count, 3)), by_axis], axis=1)
            residual = np.column_stack([residual, prior])
            rows = np.concatenate([rows, own[:, None]], axis=1)
        return normal_equations(residual, rows)

    def _error(self, place: Array) -> Array:
        """Return the relative model and survey error of each channel, (k, channels)."""
        site = self.calibration.site
        survey = calibration_error(site, _distances(site, place))[:, site.owner]
        return np.hypot(model_error(site, place[:, None]), survey)


def _ranked(result: _Refined, middle: Array) -> CoilFixes:
    """Return the distinct hypotheses that are not much less probable than the best."""
    kept: list[list[int]] = []
    for row, costs in zip(result.state, result.cost, strict=True):
        own: list[int] = []
        for k in np.argsort(costs, kind="stable").tolist():
            near = DUPLICATE_DISTANCE * float(np.linalg.norm(row[k, :3] - middle))
            separate = all(np.linalg.norm(row[k, :3] - row[o, :3]) > near for o in own)
            if separate and (not own or costs[k] <= costs[own[0]] + RIVAL):
                own.append(k)
        kept.append(own)
    maximum = max(map(len, kept))
    index = np.array([[*own, *[own[0]] * (maximum - len(own))] for own in kept])
    there = np.arange(maximum) < np.array([len(own) for own in kept])[:, None]
    rows = np.arange(len(index))[:, None]
    cost = result.cost[rows, index]
    cost = cost - cost[:, :1] + result.chi_square[rows, index[:, :1]]
    return CoilFixes(
        position_world=result.state[rows, index, :3],
        axis_world=result.state[rows, index, 3:],
        cov=result.cov[rows, index],
        cost=np.where(there, cost, np.inf),
        determined=result.determined[rows, index] & there,
        freedom=result.freedom,
    )
