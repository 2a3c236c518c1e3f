"""Position, attitude and moments of a beacon from magnetometers at known poses.

The exact alternative to paper 002 (`scenarios/beacon_methods.py`).  The phasors are
linear in the moments.  Of nine unknowns (centre and two moments, imbalance and angle between the
coils included) only the centre needs a search: variable projection from a grid, because every
second fit from a single start ends in a local minimum.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage

from magfusion.errors import InputError
from magfusion.estimation.solve.batched import NormalEquations, minimise, normal_equations
from magfusion.model.field import observe_from
from magfusion.model.site import Beacon, Magnetometer
from magfusion.units import Array, BoolArray, ComplexArray, IntArray

SPACING = 0.5  # m; of the grid that seeds the search
REACH = 1.5  # m; half the width of the grid
CLEARANCE = 0.25  # m; nearer than this to a magnetometer no beacon is looked for
STARTS = 4  # minima on the grid that are followed
MAX_NUMBERS = 100_000  # of grid and phasors that are worked on at once
SAME = 0.01  # m; fits nearer to each other than this are one
MAX_CONDITION = 1e7  # of the scaled Jacobian


@dataclass(frozen=True, eq=False)
class BeaconMeasurements:
    """Measurements of one beacon by magnetometers at known poses."""

    beacon: Beacon  # as declared
    magnetometer: Magnetometer
    world_from_body: Array  # (points, 3, 3)
    position_world: Array  # (points, 3), origin of the body (m)
    phasor_sensor: ComplexArray  # (T), measured axes; NaN where one is missing
    # (points, tones, 2), of each component of the real and of the imaginary part, in all runs (T)
    sigma: Array

    @property
    def real_tones(self) -> tuple[bool, ...]:
        """Which tones have one coil of known drive phase, hence a real moment."""
        coils = np.count_nonzero(self.beacon.excitation, axis=0)
        return tuple(bool(self.beacon.synchronised and count == 1) for count in coils)

    @property
    def unit_moments(self) -> ComplexArray:
        """The moments of all tones per unit of each unknown, shape (unknowns, tones, 3), world."""
        units: list[ComplexArray] = []
        for tone, real in enumerate(self.real_tones):
            drive = self.beacon.excitation[:, tone].sum()
            for turn in (drive,) if real else (1.0, 1j):
                unit = np.zeros((3, len(self.real_tones), 3), dtype=np.complex128)
                unit[:, tone] = turn * np.eye(3)
                units.append(unit)
        return np.concatenate(units)

    @property
    def weight(self) -> Array:
        """One over sigma, shape (points, tones, 2); zero where a phasor is missing."""
        return np.where(self.valid[..., None], 1.0 / self.sigma, 0.0)

    @property
    def valid(self) -> BoolArray:
        """Which points and tones are present in all runs, shape (points, tones)."""
        return np.all(np.isfinite(self.phasor_sensor), axis=(0, 3))


@dataclass(frozen=True, eq=False)
class BeaconFits:
    """The best fit of each run, and other local minima."""

    centre_world: Array  # (runs, 3), of the beacon's origin (m)
    moments_world: ComplexArray  # (runs, tones, 3), of each tone, drive phase included (A m^2)
    chi_square: Array  # (runs,)
    # (runs, unknowns, unknowns), of the centre, then of each tone's moment: its real part, then its
    # imaginary part unless that is known (`BeaconMeasurements.real_tones`)
    cov: Array
    # (runs, rivals, 3), centres of other minima (m), best first; NaN where there are no more
    rivals_world: Array
    rival_chi_square: Array  # (runs, rivals)


def calibrate_beacon(measured: BeaconMeasurements, reach: float = REACH) -> BeaconFits:
    """Find centre and moments of a beacon by variable projection, seeded on a grid.

    Its coils are points: the field of a coil of finite size is linear in its current, but not in
    its axis; `magfusion.calibration.beacon_refined.calibrate_one` models the size. `reach`: maximum
    distance of the beacon from its declared position (m). Raises InputError where there are fewer
    than two magnetometers, or they do not determine the unknowns.
    """
    _refuse_too_few(measured)
    seen = whitened_parts(measured, np.nan_to_num(measured.phasor_sensor)[..., None])[..., 0]
    starts = _grid_starts(measured, seen, reach)  # (runs, starts, 3)
    runs, count = starts.shape[:2]
    owner = np.repeat(np.arange(runs), count)

    def model(rows: IntArray, centre: Array) -> NormalEquations:
        return normal_equations(*_projected(measured, seen[owner[rows]], centre)[:2])

    result = minimise(model, starts.reshape(-1, 3))
    costs = result.cost.reshape(runs, count)
    order = np.argsort(costs, axis=1)
    centres = np.take_along_axis(result.state.reshape(runs, count, 3), order[..., None], axis=1)
    costs = np.take_along_axis(costs, order, axis=1)
    best = centres[:, 0]
    _, _, moments, jacobian = _projected(measured, seen, best)
    rival = np.linalg.norm(centres[:, 1:] - best[:, None], axis=-1) > SAME
    return BeaconFits(
        centre_world=best,
        moments_world=np.einsum("ru,uta->rta", moments, measured.unit_moments),
        chi_square=costs[:, 0],
        cov=_inverse(jacobian, reach),
        rivals_world=np.where(rival[..., None], centres[:, 1:], np.nan),
        rival_chi_square=np.where(rival, costs[:, 1:], np.nan),
    )


def _refuse_too_few(measured: BeaconMeasurements) -> None:
    name, valid = measured.beacon.name, measured.valid
    points = int(np.count_nonzero(valid.any(axis=1)))
    if points < 2:
        raise InputError(
            f"beacon {name} was measured at {points} point{'s' * (points != 1)}; its range and"
            " moments require at least two magnetometers"
        )
    silent = np.flatnonzero(~valid.any(axis=0))
    if len(silent):
        raise InputError(f"beacon {name}: tone {silent[0]} was not measured; measure every coil")
    beacon = measured.beacon
    for tone in range(len(beacon.tones)):
        centres = beacon.centres_beacon[beacon.excitation[:, tone] != 0.0]
        if np.any(np.ptp(centres, axis=0) > 0.0):
            raise InputError(
                f"beacon {name}: the coils of tone {tone} have separate centres; drive them in"
                " separate tones or slots to calibrate them"
            )


def whitened_parts(measured: BeaconMeasurements, columns: ComplexArray) -> Array:
    """Stack columns (..., points, tones, 3, n) as (..., numbers, n), weighted; zero if missing."""
    weight = measured.weight[..., None, None]
    parts = np.stack([columns.real * weight[:, :, 0], columns.imag * weight[:, :, 1]], axis=-5)
    return parts.reshape(*columns.shape[:-4], -1, columns.shape[-1])


def _columns(measured: BeaconMeasurements, centre: Array) -> tuple[Array, Array]:
    """Return the whitened phasors of unit moments, world axes, and their derivative by the centre.

    `centre` (k, 3). Returns `value` (k, numbers, moments); `by_centre` (k, numbers, moments, 3).
    """
    beacon, rotated = measured.beacon, measured.world_from_body
    offset = measured.position_world - centre[:, None]
    bodies = np.broadcast_to(rotated, (*offset.shape[:2], 3, 3))
    units = measured.unit_moments
    shape = (*offset.shape[:2], len(beacon.tones), 3, len(units))
    value = np.zeros(shape, dtype=np.complex128)
    slope = np.zeros((*shape, 3), dtype=np.complex128)
    for tone in range(len(beacon.tones)):
        own = np.flatnonzero(units[:, tone].any(axis=-1))
        coil = beacon.coils[int(np.flatnonzero(beacon.excitation[:, tone])[0])]
        # The field of a moment along each axis of the world, as if in separate slots.
        axes = tuple(
            replace(coil, moment_beacon=axis, phase=0.0, slot=slot, radius=None, length=None)
            for slot, axis in enumerate(beacon.world_from_beacon)
        )
        alone = replace(beacon, position_world=np.zeros(3), coils=axes, field_map=None, steel=None)
        seen, by_pose = observe_from(alone, measured.magnetometer, bodies, offset)
        by_place = -by_pose[..., 3:] @ np.swapaxes(rotated, -1, -2)[:, None]
        value[:, :, tone][..., own] = np.einsum("ua,kpai->kpiu", units[own, tone], seen)
        slope[:, :, tone][..., own, :] = np.einsum("ua,kpaij->kpiuj", units[own, tone], by_place)
    flat = slope.reshape(*shape[:-1], -1)
    stacked = whitened_parts(measured, flat)
    return whitened_parts(measured, value), stacked.reshape(*stacked.shape[:-1], -1, 3)


def _projected(
    measured: BeaconMeasurements, seen: Array, centre: Array
) -> tuple[Array, Array, Array, Array]:
    """Return residuals of the best moments, their derivative by the centre, moments, all slopes."""
    design, by_centre = _columns(measured, centre)
    basis, upper = np.linalg.qr(design)
    across = np.swapaxes(basis, -1, -2) @ seen[..., None]
    moments = np.linalg.solve(upper, across)[..., 0]
    slope = -np.einsum("kdmc,km->kdc", by_centre, moments)
    residual = seen - (basis @ across)[..., 0]
    # Kaufman: the derivative, less its projection on the moments.
    kept = slope - basis @ (np.swapaxes(basis, -1, -2) @ slope)
    return residual, kept, moments, np.concatenate([slope, -design], axis=-1)


def _grid_starts(measured: BeaconMeasurements, seen: Array, reach: float) -> Array:
    steps = int(np.ceil(reach / SPACING))
    line = np.linspace(-reach, reach, 2 * steps + 1)
    cube = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    places = (measured.beacon.position_world + cube).reshape(-1, 3)
    lever = measured.world_from_body @ measured.magnetometer.position_body
    gap = np.linalg.norm(places[:, None] - measured.position_world - lever, axis=-1)
    clear = np.min(gap, axis=1) > CLEARANCE
    if not clear.any():
        raise InputError(
            f"beacon {measured.beacon.name}: every magnetometer is at the declared position;"
            " correct position_m"
        )
    cost = np.full((len(seen), len(places)), np.inf)
    indices = np.flatnonzero(clear)
    for some in np.array_split(indices, 1 + len(indices) * seen.shape[1] // MAX_NUMBERS):
        basis, _ = np.linalg.qr(_columns(measured, places[some])[0])
        explained = np.einsum("gdm,rd->rgm", basis, seen)
        cost[:, some] = np.sum(seen**2, axis=-1)[:, None] - np.sum(explained**2, axis=-1)
    box = cost.reshape(len(seen), *cube.shape[:3])
    lowest = scipy.ndimage.minimum_filter(box, size=(1, 3, 3, 3), mode="nearest")
    ranked = np.where(box == lowest, box, np.inf).reshape(cost.shape)
    # Where there are fewer minima, use the next lowest points.
    order = np.lexsort((cost, ranked), axis=-1)[:, :STARTS]
    return places[order]


def _inverse(jacobian: Array, reach: float) -> Array:
    """Return the covariance of all unknowns of each run.

    Raises InputError where a combination of unknowns, or the position itself, is not determined.
    """
    scale = np.linalg.norm(jacobian, axis=-2)
    safe = np.where(scale > 0.0, scale, 1.0)
    _, size, right = np.linalg.svd(jacobian / safe[..., None, :], full_matrices=False)
    short = jacobian.shape[-2] < jacobian.shape[-1]
    if short or np.any(size[..., -1] * MAX_CONDITION < size[..., 0]):
        raise InputError(
            "the magnetometers do not determine the centre and the moments of the beacon; measure"
            " at more points, not along one line from it"
        )
    root = right / size[..., :, None] / safe[..., None, :]
    cov = np.swapaxes(root, -1, -2) @ root
    worst = np.sqrt(np.max(np.linalg.eigvalsh(cov[..., :3, :3]), axis=-1))
    if np.any(worst > reach):
        raise InputError(
            f"the magnetometers determine the centre of the beacon to {np.max(worst):.2g} m only;"
            " measure closer to it, or at more points"
        )
    return cov
