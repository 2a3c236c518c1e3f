"""Map the deviation of a beacon's field from its model over a room.

Model-based fingerprinting: the model where it is valid, a map where it is not.  The logarithm of
the gain and a small rotation are a Gaussian process of position.  A survey measures both through
the phasors, linearly except for a small step, so that the posterior is exact for any number of
coils and tones, whatever components they leave unobservable.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from magfusion.errors import EstimationError
from magfusion.estimation.solve.bounded import minimise_bounded
from magfusion.model.field import predict, skew
from magfusion.model.field_map import COMPONENTS, FieldMap, correlation, posterior_system
from magfusion.model.site import Site
from magfusion.units import Array, ComplexArray, IntArray

MIN_POINTS = 8
LEARNT_FROM = 100  # points, at most, that decide on the process; the map itself takes all
RELINEARISATIONS = 6  # at most
CONVERGED_STEP = 1e-4  # change of log-gain and rotation (rad) at which there is no need of another
_WEAKEST = 0.1  # gain that a relinearisation starts from, and its inverse the strongest
FOLDS = 5  # parts of the survey, each predicted from the others
_FREEDOM = 4.0  # of Student's t
_START = (1.0, 0.07, 0.05, 0.02)  # length scale (m), gain, rotation (rad), residual
_LIMITS = ((0.1, 30.0), (1e-4, 2.0), (1e-4, 0.6), (1e-4, 0.3))


@dataclass(frozen=True, eq=False)
class MapPoints:
    """Measurements of every beacon at known poses."""

    world_from_body: Array  # (n, 3, 3)
    position_world: Array  # (n, 3), of the body (m)
    # (n, channels, 3), measured axes (T), channels in the site's order; NaN where missing
    phasor_sensor: ComplexArray
    sigma: Array  # (n, channels), of each component (T)
    # (n, channels), drive phase in addition to the coils' own (rad). If None, the phase of
    # unsynchronised beacons is estimated at each point
    phase: Array | None = None

    def __len__(self) -> int:
        return len(self.position_world)

    def rows(self, rows: IntArray) -> "MapPoints":
        """Return a subset of the points."""
        phase = None if self.phase is None else self.phase[rows]
        return MapPoints(
            self.world_from_body[rows],
            self.position_world[rows],
            self.phasor_sensor[rows],
            self.sigma[rows],
            phase,
        )


@dataclass(frozen=True, eq=False)
class MapFit:
    """A site with its map, and the map's accuracy."""

    site: Site
    # error_without, error_with: relative error of each beacon's modelled field at points not used
    # for the map, root mean square over the points
    error_without: dict[str, float]
    error_with: dict[str, float]
    points: dict[str, int]  # number of points used for the map of each beacon


class _DetectedFields(NamedTuple):
    """One beacon at the points where it was detected, world axes."""

    sensor_world: Array  # (m, 3)
    model: Array  # (m, 2 tones, 3), real parts, then imaginary parts
    measured: Array
    variance: Array  # (m, 2 tones), of each component


class _Process(NamedTuple):
    length_scale: float
    gain_sigma: float
    rotation_sigma: float
    residual: float

    @property
    def sigma(self) -> Array:
        return np.array([self.gain_sigma, *[self.rotation_sigma] * 3])


def learn_field_map(site: Site, points: MapPoints) -> MapFit:
    """Estimate the map of every beacon; all beacons share the process.

    `site`: existing maps are replaced. Raises EstimationError where a beacon was detected at too
    few points.
    """
    detected = _all_detected(site, points)
    for beacon, result in zip(site.beacons, detected, strict=True):
        if len(result.sensor_world) < MIN_POINTS:
            raise EstimationError(
                f"beacon {beacon.name} was detected at {len(result.sensor_world)} points; a map"
                f" requires {MIN_POINTS}; survey more of the room"
            )
    process = _best_process(detected)
    maps = [_conditioned(result, process) for result in detected]
    beacons = tuple(replace(b, field_map=m) for b, m in zip(site.beacons, maps, strict=True))
    names = [b.name for b in site.beacons]
    errors = [_cross_validated(result, process) for result in detected]
    return MapFit(
        site=replace(site, beacons=beacons),
        error_without={n: e[0] for n, e in zip(names, errors, strict=True)},
        error_with={n: e[1] for n, e in zip(names, errors, strict=True)},
        points={n: len(result.sensor_world) for n, result in zip(names, detected, strict=True)},
    )


def _all_detected(site: Site, points: MapPoints) -> list[_DetectedFields]:
    sensor = site.platform.magnetometer
    world_from_sensor = points.world_from_body @ sensor.body_from_sensor
    sensor_world = points.position_world + points.world_from_body @ sensor.position_body
    reverted = np.swapaxes(world_from_sensor @ np.linalg.inv(sensor.matrix), -1, -2)
    result, start = [], 0
    for beacon in site.beacons:
        tones = slice(start, start + len(beacon.tones))
        start = tones.stop
        phase = None if points.phase is None else points.phase[:, tones]
        plain = predict(
            replace(beacon, field_map=None),
            sensor,
            points.world_from_body,
            points.position_world,
            phase,
        )
        measured = points.phasor_sensor[:, tones]
        if phase is None and not beacon.synchronised:
            plain = _aligned(plain, measured)
        there = np.isfinite(measured).all(axis=(1, 2))
        # A near-identity matrix leaves white noise white.
        variance = np.tile(points.sigma[:, tones] ** 2, 2)
        result.append(
            _DetectedFields(
                sensor_world[there],
                _stacked(plain @ reverted)[there],
                _stacked(measured @ reverted)[there],
                variance[there],
            )
        )
    return result


def _aligned(plain: ComplexArray, measured: ComplexArray) -> ComplexArray:
    """Return the model with the measured drive phase of each tone."""
    lag = np.angle(np.sum(np.conj(plain) * measured, axis=-1, keepdims=True))
    return plain * np.exp(1j * lag)


def _stacked(phasor: ComplexArray) -> Array:
    return np.concatenate([phasor.real, phasor.imag], axis=1)


def _reduced(detected: _DetectedFields, state: Array, residual: float) -> tuple[Array, Array]:
    """Return each point's information on gain and rotation (m, 4, 4), and its vector (m, 4).

    Linear about ``state`` (m, 4): gain and rotation at each point.
    """
    gain = np.exp(state[:, :1, None])
    turn = skew(state[:, 1:])
    rotated = gain * (detected.model + detected.model @ np.swapaxes(turn, -1, -2))
    by_rotation = -gain[..., None] * skew(detected.model)
    design = np.concatenate([rotated[..., None], by_rotation], axis=-1)  # (m, tones, 3, 4)
    strength = np.mean(np.sum(detected.model**2, axis=2), axis=1)[:, None]
    weight = 1.0 / (detected.variance + residual**2 * strength / 3.0)
    error = detected.measured - rotated + (design @ state[:, None, :, None])[..., 0]
    weighted = design * weight[..., None, None]
    information = np.einsum("mtia,mtib->mab", weighted, design)
    vector = np.einsum("mtia,mti->ma", weighted, error)
    return information, vector


def _plain_gain(detected: _DetectedFields) -> Array:
    """Return the log-gain of each point on its own, shape (m,).

    For a gain between a half and two, one step from a gain of one errs by at most a fifth.
    """
    gain = np.sum(detected.measured * detected.model, axis=(1, 2)) / np.sum(
        detected.model**2, axis=(1, 2)
    )
    return np.log(np.clip(gain, _WEAKEST, 1.0 / _WEAKEST))


def _conditioned(detected: _DetectedFields, process: _Process) -> FieldMap:
    count = len(detected.sensor_world)
    near = correlation(detected.sensor_world, detected.sensor_world, process.length_scale)
    state = np.zeros((count, COMPONENTS))
    state[:, 0] = _plain_gain(detected)
    for _ in range(RELINEARISATIONS):
        information, vector = _reduced(detected, state, process.residual)
        system = posterior_system(near, process.sigma, information)
        weights = np.asarray(np.linalg.solve(system, vector.ravel())).reshape(count, COMPONENTS)
        before, state = state, near @ (process.sigma**2 * weights)
        # Where a survey is of other beacons, steps would diverge.
        state[:, 0] = np.clip(state[:, 0], np.log(_WEAKEST), -np.log(_WEAKEST))
        if np.max(np.abs(state - before)) < CONVERGED_STEP:
            break
    return FieldMap(
        points_world=detected.sensor_world,
        weights=weights,
        information=information,
        length_scale=process.length_scale,
        gain_sigma=process.gain_sigma,
        rotation_sigma=process.rotation_sigma,
        residual=process.residual,
    )


def _best_process(detected: Sequence[_DetectedFields]) -> _Process:
    """Return the process that predicts left-out points best, by Student's t.

    The maximum likelihood would be dominated by the few points near iron and explain all as noise.
    """
    parts = [_folds(_evenly(h, LEARNT_FROM), FOLDS) for h in detected]
    count = sum(requested.model.size for folds in parts for _, requested in folds)

    def cost(log_process: Array) -> float:
        process = _Process(*np.exp(log_process))
        return sum(_surprise(*fold, process) for folds in parts for fold in folds) / count

    result = minimise_bounded(cost, np.log(_START), np.log(_LIMITS))
    return _Process(*(float(v) for v in np.exp(result)))


def _folds(detected: _DetectedFields, folds: int) -> list[tuple[_DetectedFields, _DetectedFields]]:
    """Return pairs of known points and query points."""
    fold = np.arange(len(detected.sensor_world)) % folds
    return [
        (
            _DetectedFields(*(p[fold != k] for p in detected)),
            _DetectedFields(*(p[fold == k] for p in detected)),
        )
        for k in range(folds)
    ]


def _surprise(known: _DetectedFields, requested: _DetectedFields, process: _Process) -> float:
    """Return the negative log-score of a map's predictions, up to a constant."""
    result = _conditioned(known, process)
    strength = np.mean(np.sum(requested.model**2, axis=2), axis=1)
    error = result.relative_variance(requested.sensor_world)
    variance = np.mean(requested.variance, axis=1) + error * strength / 3.0
    square = np.sum((requested.measured - _mapped(result, requested)) ** 2, axis=(1, 2)) / variance
    size = requested.model[0].size
    spread = 0.5 * size * np.log(variance / strength)
    tail = 0.5 * (_FREEDOM + size) * np.log1p(square / _FREEDOM)
    return float(np.sum(spread + tail))


def _mapped(result: FieldMap, requested: _DetectedFields) -> Array:
    value, _ = result.mean(requested.sensor_world)
    rotated = requested.model + np.cross(value[:, None, 1:], requested.model)
    return np.exp(value[:, :1, None]) * rotated


def _evenly(detected: _DetectedFields, maximum: int) -> _DetectedFields:
    count = len(detected.sensor_world)
    if count <= maximum:
        return detected
    rows = np.unique(np.linspace(0, count - 1, maximum).astype(np.int64))
    return _DetectedFields(*(part[rows] for part in detected))


def _cross_validated(detected: _DetectedFields, process: _Process) -> tuple[float, float]:
    """Return the relative error at left-out points, without the map and with it."""
    without, residual = [], []
    for known, requested in _folds(detected, FOLDS):
        without.append(_relative(requested.model, requested.measured))
        residual.append(
            _relative(_mapped(_conditioned(known, process), requested), requested.measured)
        )
    return _rms(np.concatenate(without)), _rms(np.concatenate(residual))


def _relative(model: Array, measured: Array) -> Array:
    error = np.sum((model - measured) ** 2, axis=(1, 2))
    return np.sqrt(error / np.sum(measured**2, axis=(1, 2)))


def _rms(value: Array) -> float:
    return float(np.sqrt(np.mean(value**2)))


def thinned(points: MapPoints, site: Site, spacing: float) -> MapPoints:
    """Return one point per cube of a grid: the one with the least noise.

    `points`: e.g. the epochs of a smoothed log. `spacing`: edge of the cubes (m).
    """
    sensor = site.platform.magnetometer
    sensor_world = points.position_world + points.world_from_body @ sensor.position_body
    cell = np.floor(sensor_world / spacing).astype(np.int64)
    detected = np.sum(np.isfinite(points.phasor_sensor).all(axis=2), axis=1)
    noise = np.nanmean(np.where(np.isfinite(points.sigma), points.sigma, np.nan), axis=1)
    best = np.lexsort((noise, -detected))
    _, first = np.unique(cell[best], axis=0, return_index=True)
    return points.rows(np.sort(best[first]))
