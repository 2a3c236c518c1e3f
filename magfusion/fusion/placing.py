"""Where a beacon of unknown pose may be, from its phasors along a known trajectory.

The field is linear in the drive in world axes once the centre is given, so that centres are
searched on a grid with all else solved in closed form (variable projection; the ranges that bound
the grid need no attitude).  The drive in world axes then gives the attitude (Wahba's problem), and
every place that is left over is refined by the one measurement model.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.ndimage import minimum_filter
from scipy.optimize import least_squares

from magfusion.errors import EstimationError
from magfusion.fixes.candidates import beacon_directions, wahba
from magfusion.observation import model_error_cov
from magfusion.parameters import (
    Calibration,
    choose_blocks,
    difference,
    initial_calibration,
    linearize_channels,
    prior_sigma,
    retract,
)
from magfusion.records.samples import FieldSamples
from magfusion.site import Beacon, MagnetometerSigma, Site
from magfusion.trajectory import Trajectory
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray
from magfusion.weights import paired_whitening, sensor_positions, stacked

TRAJECTORY_ERROR = 0.03  # relative; of a field predicted from a trajectory of the known beacons
FEWEST_EPOCHS = 10
EPOCHS_SEARCHED = 120
GRID = 24  # points along each axis
MINIMA = 12  # of the grid that are followed
MOST_REFINED = 4  # of the places to which they lead
EQUALLY_GOOD = 0.9  # of the best agreement of an attitude with the drive
RANGE_MARGIN = 1.4  # of a range from the field's strength alone
SAME_PLACE = 0.05  # m
NO_PRIOR = (100.0, 10.0)  # m, rad; sigmas that are no information
DRIFT_SEARCH = 6e-5  # relative; three sigma of an ordinary oscillator
STEPS, SETTLED = 40, 1e-8  # of the refinement; relative decrease that ends it


@dataclass(frozen=True, eq=False)
class Heard:
    """One beacon as it was heard along a trajectory.

    Parameters
    ----------
    alone : Calibration
        Of this beacon alone, with the magnetometer of the trajectory taken for exact.
    poses : Trajectory
        Where it was heard.
    sensor_world : ndarray, shape (n, 3)
        (m)
    measured : ndarray, shape (n, tones, 6)
        Real parts, then imaginary parts (T), measured axes.
    phasor_world : complex ndarray, shape (n, tones, 3)
        (T), world axes.
    root : ndarray, shape (n, tones, 6, 6)
        Whitening (1/T).
    """

    alone: Calibration
    poses: Trajectory
    sensor_world: Array
    measured: Array
    phasor_world: ComplexArray
    root: Array

    @property
    def beacon(self) -> Beacon:
        """The beacon, NaN where it is unknown."""
        return self.alone.site.beacons[0]

    @property
    def weight(self) -> Array:
        """Inverse variance of a component at each epoch, shape (n,) (1/T^2)."""
        return np.asarray(np.mean(np.square(self.root).sum(axis=-2).mean(axis=-1), axis=1))

    def thinned(self) -> tuple[Array, Array, Array, ComplexArray]:
        """Return time since the reference, sensor positions, weights and phasors of some epochs."""
        count = min(EPOCHS_SEARCHED, len(self.poses))
        rows = np.unique(np.linspace(0, len(self.poses) - 1, count).astype(int))
        elapsed = self.poses.time[rows] - self.alone.reference_time
        return elapsed, self.sensor_world[rows], self.weight[rows], self.phasor_world[rows]


def heard_along(
    beacon: Beacon,
    calibration: Calibration,
    samples: FieldSamples,
    states: Trajectory,
    windows_per_sample: float,
) -> Heard:
    """Return a beacon's phasors with the poses at which they were measured.

    Parameters
    ----------
    beacon : Beacon
    calibration : Calibration
        Of the trajectory; its magnetometer and its time offset are taken over.
    samples : FieldSamples
    states : Trajectory
    windows_per_sample : float
        How often the information of a sample is counted.

    Raises
    ------
    EstimationError
        Where it was hardly heard.
    """
    columns = np.array([name == beacon.name for name, _ in samples.channels], dtype=bool)
    _, ours, theirs = np.intersect1d(samples.time, states.time, return_indices=True)
    usable = samples.valid[ours][:, columns].all(axis=1)
    ours, theirs = ours[usable], theirs[usable]
    if len(ours) < FEWEST_EPOCHS:
        raise EstimationError(
            f"beacon {beacon.name} was heard at {len(ours)} epochs, too few to place it: record it"
            " for longer, nearer to it"
        )
    phasor = samples.phasor_sensor[ours][:, columns]
    cov = samples.phasor_cov[ours][:, columns] * windows_per_sample
    cov = cov + model_error_cov(phasor, TRAJECTORY_ERROR)
    poses = Trajectory(
        states.time[theirs], states.world_from_body[theirs], states.position_world[theirs]
    )
    alone = initial_calibration(_alone(beacon, calibration.site), float(np.mean(poses.time)))
    sensor = calibration.site.platform.magnetometer
    body_from_measured = sensor.body_from_sensor @ np.linalg.inv(sensor.matrix)
    world_from_measured = poses.world_from_body @ body_from_measured
    return Heard(
        alone=alone,
        poses=poses,
        sensor_world=sensor_positions(alone.site, poses),
        measured=stacked(phasor),
        phasor_world=phasor @ np.swapaxes(world_from_measured, 1, 2),
        root=paired_whitening(cov, np.ones(cov.shape[:2], dtype=bool)),
    )


def _alone(beacon: Beacon, site: Site) -> Site:
    """Return a site of one beacon, of whose pose no more is known than it declares."""
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


def places(heard: Heard) -> list[tuple[float, Beacon]]:
    """Return every place that is a minimum of the misfit, with its chi square, best first.

    Parameters
    ----------
    heard : Heard

    Returns
    -------
    list of (float, Beacon)
    """
    starts = [start for centre in _centres(heard) for start in _starts(heard, *centre)]
    found = [_refined(heard, start) for start in starts]
    found.sort(key=lambda one: one[0])
    kept: list[tuple[float, Beacon]] = []
    for chi_square, placed in found:
        apart = [np.linalg.norm(placed.position_world - b.position_world) for _, b in kept]
        if min(apart, default=np.inf) > SAME_PLACE:
            kept.append((chi_square, placed))
    return kept


def _centres(heard: Heard) -> list[tuple[Array, float]]:
    """Return centres, with the clock's error, about which the misfit has a minimum."""
    beacon = heard.beacon
    drifts = _drifts(heard)
    if beacon.unknown == "attitude":
        misfit = _misfit(heard, beacon.position_world[None], drifts)[:, 0]
        return [(beacon.position_world, float(drifts[int(np.argmin(misfit))]))]
    axes = _search_axes(heard)
    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    misfit = _misfit(heard, mesh.reshape(-1, 3), drifts)
    least = np.min(misfit, axis=0).reshape(mesh.shape[:3])
    lowest = np.argwhere(minimum_filter(least, 3, mode="nearest") == least)
    lowest = lowest[np.argsort(least[tuple(lowest.T)])][:MINIMA]
    rows = [int(np.ravel_multi_index(tuple(index), mesh.shape[:3])) for index in lowest]
    polished = [
        _polished(heard, mesh.reshape(-1, 3)[row], float(drifts[int(np.argmin(misfit[:, row]))]))
        for row in rows
    ]
    polished.sort(key=lambda one: one[0])
    apart: list[tuple[Array, float]] = []
    for _, centre, drift in polished:
        if all(np.linalg.norm(centre - other) > SAME_PLACE for other, _ in apart):
            apart.append((centre, drift))
    return apart[:MOST_REFINED] + _mirrors(heard)


def _mirrors(heard: Heard) -> list[tuple[Array, float]]:
    """Return what one epoch allows of a beacon of known attitude: its place and its mirrors.

    A platform that hardly moves leaves them all, where the misfit of a free drive has no minimum.
    """
    if heard.beacon.unknown != "position":
        return []
    row = len(heard.poses) // 2
    phasor_beacon = heard.phasor_world[row] @ heard.beacon.world_from_beacon
    direction, distance = beacon_directions(heard.beacon, phasor_beacon[None])
    if direction.shape[1] > MOST_REFINED:  # a cone or a sphere of them
        return []
    offset_world = (direction[0] * distance[0][:, None]) @ heard.beacon.world_from_beacon.T
    return [(heard.sensor_world[row] - offset, 0.0) for offset in offset_world]


def _search_axes(heard: Heard) -> list[Array]:
    """Return a grid about the places whose distances the strength of the field allows."""
    _, sensor_world, _, phasor = heard.thinned()
    _, distance = beacon_directions(heard.beacon, phasor)
    reach = RANGE_MARGIN * np.max(distance, axis=1)[:, None]
    low, high = np.max(sensor_world - reach, axis=0), np.min(sensor_world + reach, axis=0)
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 0.5)
    return [np.linspace(m - h, m + h, GRID) for m, h in zip(middle, half, strict=True)]


def _drifts(heard: Heard) -> Array:
    """Return clock errors close enough that a phase is missed by less than half a radian."""
    if heard.beacon.synchronised:
        return np.zeros(1)
    turns = 2.0 * np.pi * float(np.max(heard.beacon.tone_frequencies_hz))
    swept = turns * float(np.ptp(heard.poses.time)) * 2.0 * DRIFT_SEARCH
    count = int(np.ceil(swept)) | 1
    return np.linspace(-DRIFT_SEARCH, DRIFT_SEARCH, count) if count > 1 else np.zeros(1)


def _undrifted(heard: Heard, elapsed: Array, phasor: ComplexArray, drift: float) -> ComplexArray:
    turn = 2.0 * np.pi * drift * elapsed[:, None] * heard.beacon.tone_frequencies_hz
    return np.asarray(phasor * np.exp(-1j * turn)[..., None])


def _tensors(centres: Array, sensor_world: Array) -> Array:
    """Return the field of unit moments (T/(A m^2)), shape (centres, n, 3, 3)."""
    offset = sensor_world - centres[:, None]
    distance = np.linalg.norm(offset, axis=-1)[..., None, None] + 1e-3
    unit = offset[..., None] / distance
    outer = unit * np.swapaxes(unit, -1, -2)
    return np.asarray(MU0_OVER_4PI * (3.0 * outer - np.eye(3)) / distance**3)


def _drive_at(tensor: Array, weight: Array, phasor: ComplexArray) -> tuple[ComplexArray, Array]:
    """Return the drive in world axes that fits best, (..., 3, tones), and what each explains."""
    weighed = tensor * weight[:, None, None]
    rows = (*tensor.shape[:-3], -1, 3)
    across = np.swapaxes(weighed.reshape(rows), -1, -2)  # the tensors are symmetric
    normal = across @ tensor.reshape(rows)
    right = across @ np.swapaxes(phasor, 1, 2).reshape(-1, phasor.shape[1])
    drive: ComplexArray = np.asarray(np.linalg.solve(normal, right), dtype=np.complex128)
    return drive, np.asarray(np.sum(np.conj(right) * drive, axis=-2).real)


def _misfit(heard: Heard, centres: Array, drifts: Array) -> Array:
    """Return what no drive explains, shape (drifts, centres)."""
    elapsed, sensor_world, weight, phasor = heard.thinned()
    told = [_undrifted(heard, elapsed, phasor, drift) for drift in drifts]
    columns = np.concatenate(told, axis=1)  # each clock's phasors side by side
    total = float(np.sum(weight[:, None, None] * np.abs(phasor) ** 2))
    explained = [
        _drive_at(_tensors(some, sensor_world), weight, columns)[1]
        for some in np.array_split(centres, max(1, len(centres) // 500))
    ]
    by_drift = np.concatenate(explained).reshape(len(centres), len(drifts), -1)
    return np.asarray(total - np.sum(by_drift, axis=-1).T)


def _polished(heard: Heard, centre: Array, drift: float) -> tuple[float, Array, float]:
    """Return the misfit at the minimum near a centre, the centre there, and the clock's error."""
    elapsed, sensor_world, weight, phasor = heard.thinned()
    free = not heard.beacon.synchronised

    def residual(found: Array) -> Array:
        told = _undrifted(heard, elapsed, phasor, found[3] * DRIFT_SEARCH if free else 0.0)
        tensor = _tensors(found[None, :3], sensor_world)[0]
        drive, _ = _drive_at(tensor, weight, told)
        error = np.sqrt(weight)[:, None, None] * (told - np.swapaxes(tensor @ drive, 1, 2))
        return np.concatenate([error.real.ravel(), error.imag.ravel()])

    start = np.append(centre, drift / DRIFT_SEARCH) if free else centre
    solved = least_squares(residual, start, max_nfev=30)
    there = float(solved.x[3] * DRIFT_SEARCH) if free else 0.0
    return float(solved.cost), solved.x[:3], there


def _starts(heard: Heard, centre: Array, drift: float) -> Iterator[Calibration]:
    """Yield the beacon at a centre in the attitudes that its drive there allows."""
    beacon = heard.beacon
    elapsed, sensor_world, weight, phasor = heard.thinned()
    told = _undrifted(heard, elapsed, phasor, drift)
    world, _ = _drive_at(_tensors(centre[None], sensor_world)[0], weight, told)
    declared = beacon.moments_beacon.T @ beacon.excitation
    if beacon.unknown == "position":
        lag = np.angle(np.sum(np.conj(beacon.world_from_beacon @ declared) * world, axis=0))
        phase = np.zeros(len(lag)) if beacon.synchronised else lag
        pairs = [(beacon.world_from_beacon, phase)]
    else:
        pairs = _attitudes(beacon, world, declared)
    for attitude, phase in pairs:
        placed = replace(beacon, position_world=centre, world_from_beacon=attitude, unknown=None)
        site = replace(heard.alone.site, beacons=(placed,))
        yield replace(heard.alone, site=site, phase=phase, drift=np.array([drift]))


def _attitudes(
    beacon: Beacon, world: ComplexArray, declared: ComplexArray
) -> list[tuple[Array, Array]]:
    """Return the attitudes and drive phases that take a declared drive to that in the world.

    A free phase is undone by making the tone's ellipse lie as it does in the beacon, which leaves
    its polarity: with several tones the coils' own centres may tell.
    """
    tones = len(beacon.tones)
    if beacon.synchronised:
        lags = [np.zeros(tones)]
    else:
        squares = [np.angle(np.sum(drive**2, axis=0)) for drive in (world, declared)]
        lag = 0.5 * (squares[0] - squares[1])
        signs = product((0.0, np.pi), repeat=tones) if tones > 1 else [(0.0,)]
        lags = [lag + np.array(turned) for turned in signs]
    correlation = np.stack([(world * np.exp(-1j * lag) @ np.conj(declared).T).real for lag in lags])
    attitude = wahba(correlation)
    score = np.sum(attitude * correlation, axis=(1, 2))
    kept = np.flatnonzero(score > EQUALLY_GOOD * np.max(score))
    return [(attitude[k], lags[k]) for k in kept]


def _refined(heard: Heard, start: Calibration) -> tuple[float, Beacon]:
    """Return the chi square and the beacon where the measurement model fits best."""
    blocks = choose_blocks(start.site, ("beacons", "moments", "phase"))
    share = 1.0 / prior_sigma(blocks)
    poses, found, damping = heard.poses, start, 1e-3

    def whitened(at: Calibration) -> tuple[Array, Array]:
        value, _, jacobian = linearize_channels(
            at, blocks, poses.time, poses.world_from_body, poses.position_world
        )
        error = (heard.root @ (heard.measured - value)[..., None]).ravel()
        error = np.concatenate([error, -share * difference(start, at, blocks)])
        columns = (heard.root @ jacobian).reshape(-1, len(share))
        return error, np.concatenate([columns, np.diag(share)])

    error, columns = whitened(found)
    for _ in range(STEPS):
        normal = columns.T @ columns
        scale = np.diag(damping * np.diagonal(normal))
        step: Array = np.asarray(np.linalg.solve(normal + scale, columns.T @ error))
        trial = retract(found, blocks, step)
        new_error, new_columns = whitened(trial)
        gain = float(error @ error - new_error @ new_error)
        if not gain >= 0.0:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        settled = gain <= SETTLED * float(error @ error)
        found, error, columns, damping = trial, new_error, new_columns, damping / 10.0
        if settled:
            break
    return float(error @ error), found.site.beacons[0]
