"""Candidate poses of an unknown beacon, from its phasors along a known trajectory.

The field is linear in the drive in world axes once the centre is given, so that centres are
searched on a grid with all else solved in closed form (variable projection; the ranges that bound
the grid need no attitude).  The drive in world axes then gives the attitude (Wahba's problem), and
every remaining candidate is refined with the full measurement model.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from magfusion.errors import EstimationError
from magfusion.estimation.snapshot.candidates import beacon_directions, wahba
from magfusion.estimation.solve.batched import (
    NormalEquations,
    by_differences,
    minimise,
    normal_equations,
)
from magfusion.model.noise import model_error_cov, paired_whitening, sensor_positions, stacked
from magfusion.model.parameters import (
    Calibration,
    choose_blocks,
    difference,
    initial_calibration,
    linearize_channels,
    prior_sigma,
    retract,
)
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, MagnetometerSigma, Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray, IntArray

TRAJECTORY_ERROR = 0.03  # relative; of a field predicted from a trajectory of the known beacons
MIN_EPOCHS = 10
EPOCHS_SEARCHED = 120
GRID = 24  # points along each axis
MINIMA = 12  # of the grid that are refined
MAX_REFINED = 4  # of the resulting places
EQUALLY_GOOD = 0.9  # of the best agreement of an attitude with the drive
RANGE_MARGIN = 1.4  # of a range from the field's strength alone
SAME_PLACE = 0.05  # m
NO_PRIOR = (100.0, 10.0)  # m, rad; sigmas without information
STEPS, MIN_COST_DECREASE = 40, 1e-8  # of the refinement; relative decrease that ends it


class DetectedFields(NamedTuple):
    """Phasors of one beacon along a trajectory."""

    alone: Calibration  # of this beacon alone; the magnetometer of the trajectory is assumed exact
    poses: Trajectory  # at the epochs of its detection
    sensor_world: Array  # (n, 3) (m)
    measured: Array  # (n, tones, 6), real parts, then imaginary parts (T), measured axes
    phasor_world: ComplexArray  # (n, tones, 3) (T), world axes
    sqrt_information: Array  # (n, tones, 6, 6), whitening (1/T)

    @property
    def beacon(self) -> Beacon:
        """Beacon with NaN for its unknown parameters."""
        return self.alone.site.beacons[0]

    @property
    def weight(self) -> Array:
        """Inverse variance of a component at each epoch, shape (n,) (1/T^2)."""
        return np.asarray(
            np.mean(np.square(self.sqrt_information).sum(axis=-2).mean(axis=-1), axis=1)
        )

    def thinned(self) -> tuple[Array, Array, Array, ComplexArray]:
        """Return time since the reference, sensor positions, weights and phasors of some epochs."""
        count = min(EPOCHS_SEARCHED, len(self.poses))
        rows = np.unique(np.linspace(0, len(self.poses) - 1, count).astype(int))
        elapsed = self.poses.time[rows] - self.alone.reference_time
        return elapsed, self.sensor_world[rows], self.weight[rows], self.phasor_world[rows]


def detected_along(
    beacon: Beacon,
    calibration: Calibration,
    samples: FieldSamples,
    states: Trajectory,
    windows_per_sample: float,
) -> DetectedFields:
    """Return a beacon's phasors with the poses at which they were measured.

    `calibration`: of the trajectory; its magnetometer and its time offset are used.
    `windows_per_sample`: number of windows that contain each sample. Raises EstimationError where
    it was detected at too few epochs.
    """
    columns = np.array([name == beacon.name for name, _ in samples.channels], dtype=bool)
    _, ours, others = np.intersect1d(samples.time, states.time, return_indices=True)
    usable = samples.valid[ours][:, columns].all(axis=1)
    ours, others = ours[usable], others[usable]
    if len(ours) < MIN_EPOCHS:
        raise EstimationError(
            f"beacon {beacon.name} was detected at {len(ours)} epochs, too few to place it: record"
            " it for longer, at a smaller distance"
        )
    phasor = samples.phasor_sensor[ours][:, columns]
    cov = samples.phasor_cov[ours][:, columns] * windows_per_sample
    cov = cov + model_error_cov(phasor, TRAJECTORY_ERROR)
    poses = states.rows(others)
    alone = initial_calibration(_alone(beacon, calibration.site), float(np.mean(poses.time)))
    sensor = calibration.site.platform.magnetometer
    body_from_measured = sensor.body_from_sensor @ np.linalg.inv(sensor.matrix)
    world_from_measured = poses.world_from_body @ body_from_measured
    return DetectedFields(
        alone=alone,
        poses=poses,
        sensor_world=sensor_positions(alone.site, poses)[:, 0],
        measured=stacked(phasor),
        phasor_world=phasor @ np.swapaxes(world_from_measured, 1, 2),
        sqrt_information=paired_whitening(cov, np.ones(cov.shape[:2], dtype=bool)),
    )


def _alone(beacon: Beacon, site: Site) -> Site:
    """Return a site of one beacon, with a wide prior for the pose that it does not declare."""
    sigma = beacon.sigma
    if beacon.unknown in ("pose", "position"):
        sigma = replace(sigma, position_world=np.full(3, NO_PRIOR[0]))
    if beacon.unknown in ("pose", "attitude"):
        sigma = replace(sigma, rotation_beacon=np.full(3, NO_PRIOR[1]))
    none = np.zeros(3)
    exact = MagnetometerSigma(np.zeros((3, 3)), none, none, none)
    sensor = replace(site.platform.magnetometer, sigma=exact)
    platform = replace(site.platform, magnetometer=sensor)
    return replace(site, beacons=(replace(beacon, sigma=sigma),), platform=platform)


def places(detected: DetectedFields) -> list[tuple[float, Beacon]]:
    """Return every place at a minimum of the misfit, with its chi square, best first."""
    starts = [start for centre in _centres(detected) for start in _starts(detected, *centre)]
    kept: list[tuple[float, Beacon]] = []
    for chi_square, placed in sorted(_refined(detected, starts), key=lambda one: one[0]):
        separate = [np.linalg.norm(placed.position_world - b.position_world) for _, b in kept]
        if min(separate, default=np.inf) > SAME_PLACE:
            kept.append((chi_square, placed))
    return kept


def _centres(detected: DetectedFields) -> list[tuple[Array, float]]:
    """Return centres and clock errors at minima of the misfit."""
    beacon = detected.beacon
    drifts = _drifts(detected)
    if beacon.unknown == "attitude":
        misfit = _misfit(detected, beacon.position_world[None], drifts)[:, 0]
        return [(beacon.position_world, float(drifts[int(np.argmin(misfit))]))]
    axes = _search_axes(detected)
    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    misfit = _misfit(detected, mesh.reshape(-1, 3), drifts)
    least = np.min(misfit, axis=0).reshape(mesh.shape[:3])
    lowest = np.argwhere(minimum_filter(least, 3, mode="nearest") == least)
    lowest = lowest[np.argsort(least[tuple(lowest.T)])][:MINIMA]
    rows = np.ravel_multi_index(tuple(lowest.T), mesh.shape[:3])
    cost, centres, there = _polished(
        detected, mesh.reshape(-1, 3)[rows], drifts[np.argmin(misfit[:, rows], axis=0)]
    )
    separate: list[tuple[Array, float]] = []
    for one in np.argsort(cost):
        if all(np.linalg.norm(centres[one] - other) > SAME_PLACE for other, _ in separate):
            separate.append((centres[one], float(there[one])))
    return separate[:MAX_REFINED] + _mirrors(detected)


def _mirrors(detected: DetectedFields) -> list[tuple[Array, float]]:
    """Return the centres that one epoch allows for a beacon of known attitude, with mirrors.

    These all remain for a platform that hardly moves, where the misfit of a free drive has no
    minimum.
    """
    if detected.beacon.unknown != "position":
        return []
    row = len(detected.poses) // 2
    phasor_beacon = detected.phasor_world[row] @ detected.beacon.world_from_beacon
    direction, distance = beacon_directions(detected.beacon, phasor_beacon[None])
    if direction.shape[1] > MAX_REFINED:  # a cone or a sphere of them
        return []
    offset_world = (direction[0] * distance[0][:, None]) @ detected.beacon.world_from_beacon.T
    return [(detected.sensor_world[row] - offset, 0.0) for offset in offset_world]


def _search_axes(detected: DetectedFields) -> list[Array]:
    """Return a grid about the places whose distances agree with the strength of the field."""
    _, sensor_world, _, phasor = detected.thinned()
    _, distance = beacon_directions(detected.beacon, phasor)
    reach = RANGE_MARGIN * np.max(distance, axis=1)[:, None]
    low, high = np.max(sensor_world - reach, axis=0), np.min(sensor_world + reach, axis=0)
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 0.5)
    return [np.linspace(m - h, m + h, GRID) for m, h in zip(middle, half, strict=True)]


def _drifts(detected: DetectedFields) -> Array:
    """Return clock errors spaced for a phase error below half a radian."""
    if detected.beacon.synchronised:
        return np.zeros(1)
    turns = 2.0 * np.pi * float(np.max(detected.beacon.tone_frequencies_hz))
    largest = detected.alone.site.relative_clock.drift_largest
    swept = turns * float(np.ptp(detected.poses.time)) * 2.0 * largest
    count = int(np.ceil(swept)) | 1
    return np.linspace(-largest, largest, count) if count > 1 else np.zeros(1)


def _undrifted(
    detected: DetectedFields, elapsed: Array, phasor: ComplexArray, drift: float
) -> ComplexArray:
    turn = 2.0 * np.pi * drift * elapsed[:, None] * detected.beacon.tone_frequencies_hz
    return np.asarray(phasor * np.exp(-1j * turn)[..., None])


def _tensors(centres: Array, sensor_world: Array) -> Array:
    """Return the field of unit moments (T/(A m^2)), shape (centres, n, 3, 3)."""
    offset = sensor_world - centres[:, None]
    distance = np.linalg.norm(offset, axis=-1)[..., None, None] + 1e-3
    unit = offset[..., None] / distance
    outer = unit * np.swapaxes(unit, -1, -2)
    return np.asarray(MU0_OVER_4PI * (3.0 * outer - np.eye(3)) / distance**3)


def _drive_at(tensor: Array, weight: Array, phasor: ComplexArray) -> tuple[ComplexArray, Array]:
    """Return the best-fitting drive in world axes, (..., 3, tones), and the explained squares."""
    weighed = tensor * weight[:, None, None]
    rows = (*tensor.shape[:-3], -1, 3)
    tones = phasor.shape[-2]
    across = np.swapaxes(weighed.reshape(rows), -1, -2)  # the tensors are symmetric
    normal = across @ tensor.reshape(rows)
    right = across @ np.swapaxes(phasor, -1, -2).reshape(*phasor.shape[:-3], -1, tones)
    drive: ComplexArray = np.asarray(np.linalg.solve(normal, right), dtype=np.complex128)
    return drive, np.asarray(np.sum(np.conj(right) * drive, axis=-2).real)


def _misfit(detected: DetectedFields, centres: Array, drifts: Array) -> Array:
    """Return the sum of squares that no drive explains, shape (drifts, centres)."""
    elapsed, sensor_world, weight, phasor = detected.thinned()
    steady = [_undrifted(detected, elapsed, phasor, drift) for drift in drifts]
    columns = np.concatenate(steady, axis=1)  # each clock's phasors side by side
    total = float(np.sum(weight[:, None, None] * np.abs(phasor) ** 2))
    explained = [
        _drive_at(_tensors(some, sensor_world), weight, columns)[1]
        for some in np.array_split(centres, max(1, len(centres) // 500))
    ]
    by_drift = np.concatenate(explained).reshape(len(centres), len(drifts), -1)
    return np.asarray(total - np.sum(by_drift, axis=-1).T)


def _polished(
    detected: DetectedFields, centres: Array, drifts: Array
) -> tuple[Array, Array, Array]:
    """Return the misfit at the minimum near each centre, with its centre and clock error."""
    elapsed, sensor_world, weight, phasor = detected.thinned()
    free_parameters, largest = (
        not detected.beacon.synchronised,
        detected.alone.site.relative_clock.drift_largest,
    )
    turns = 2.0 * np.pi * elapsed[:, None] * detected.beacon.tone_frequencies_hz

    def residual(result: Array) -> Array:
        drift = result[:, 3:] if free_parameters else np.zeros((len(result), 1))
        lag = largest * drift[..., None] * turns
        steady = phasor * np.exp(-1j * lag)[..., None]
        tensor = _tensors(result[:, :3], sensor_world)
        drive, _ = _drive_at(tensor, weight, steady)
        seen = np.swapaxes(tensor @ drive[:, None], -1, -2)
        error = np.sqrt(weight)[:, None, None] * (steady - seen)
        return np.concatenate([error.real, error.imag], axis=1).reshape(len(result), -1)

    def model(_: IntArray, result: Array) -> NormalEquations:
        return normal_equations(*by_differences(residual, result))

    start = np.column_stack([centres, drifts / largest]) if free_parameters else centres
    solved = minimise(model, start, max_iterations=30, relative=MIN_COST_DECREASE)
    there = largest * solved.state[:, 3] if free_parameters else np.zeros(len(centres))
    return solved.cost, solved.state[:, :3], there


def _starts(detected: DetectedFields, centre: Array, drift: float) -> Iterator[Calibration]:
    """Yield the beacon at a centre in the attitudes that its drive there allows."""
    beacon = detected.beacon
    elapsed, sensor_world, weight, phasor = detected.thinned()
    steady = _undrifted(detected, elapsed, phasor, drift)
    world, _ = _drive_at(_tensors(centre[None], sensor_world)[0], weight, steady)
    declared = beacon.moments_beacon.T @ beacon.excitation
    if beacon.unknown == "position":
        lag = np.angle(np.sum(np.conj(beacon.world_from_beacon @ declared) * world, axis=0))
        phase = np.zeros(len(lag)) if beacon.synchronised else lag
        pairs = [(beacon.world_from_beacon, phase)]
    else:
        pairs = _attitudes(beacon, world, declared)
    for attitude, phase in pairs:
        placed = replace(beacon, position_world=centre, world_from_beacon=attitude, unknown=None)
        site = replace(detected.alone.site, beacons=(placed,))
        yield replace(detected.alone, site=site, phase=phase, drift=np.array([drift]))


def _attitudes(
    beacon: Beacon, world: ComplexArray, declared: ComplexArray
) -> list[tuple[Array, Array]]:
    """Return the attitudes and drive phases that rotate a declared drive to that in the world.

    An unknown phase is removed by aligning the tone's ellipse with its declared one.  The polarity
    remains ambiguous, but with several tones the coils' own centres may determine it.
    """
    tones = len(beacon.tones)
    if beacon.synchronised:
        lags = [np.zeros(tones)]
    else:
        squares = [np.angle(np.sum(drive**2, axis=0)) for drive in (world, declared)]
        lag = 0.5 * (squares[0] - squares[1])
        signs = product((0.0, np.pi), repeat=tones) if tones > 1 else [(0.0,)]
        lags = [lag + np.array(rotated) for rotated in signs]
    correlation = np.stack([(world * np.exp(-1j * lag) @ np.conj(declared).T).real for lag in lags])
    attitude = wahba(correlation)
    score = np.sum(attitude * correlation, axis=(1, 2))
    kept = np.flatnonzero(score > EQUALLY_GOOD * np.max(score))
    return [(attitude[k], lags[k]) for k in kept]


def _refined(detected: DetectedFields, starts: list[Calibration]) -> list[tuple[float, Beacon]]:
    """Return chi square and beacon of the measurement model's best fit from each start."""
    if not starts:
        return []
    blocks = choose_blocks(starts[0].site, ("beacons", "moments", "phase"))
    share, poses = 1.0 / prior_sigma(blocks), detected.poses

    def whitened(start: Calibration, at: Calibration) -> tuple[Array, Array]:
        value, _, jacobian = linearize_channels(
            at, blocks, poses.time, poses.world_from_body, poses.position_world
        )
        error = (detected.sqrt_information @ (value - detected.measured)[..., None]).ravel()
        columns = (detected.sqrt_information @ jacobian).reshape(-1, len(share))
        return (
            np.concatenate([error, share * difference(start, at, blocks)]),
            np.concatenate([columns, np.diag(share)]),
        )

    def model(rows: IntArray, state: Array) -> NormalEquations:
        pairs = [whitened(starts[row], at) for row, at in zip(rows, state, strict=True)]
        error, columns = zip(*pairs, strict=True)
        return normal_equations(np.array(error), np.array(columns))

    def moved(state: Array, step: Array) -> Array:
        return _objects([retract(at, blocks, s) for at, s in zip(state, step, strict=True)])

    result = minimise(
        model, _objects(starts), moved, max_iterations=STEPS, relative=MIN_COST_DECREASE
    )
    pairs = zip(result.cost, result.state, strict=True)
    return [(float(cost), at.site.beacons[0]) for cost, at in pairs]


def _objects(calibrations: list[Calibration]) -> Array:
    out = np.empty(len(calibrations), dtype=object)
    out[:] = calibrations
    return out
