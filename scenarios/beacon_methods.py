"""Calibrations of a rotating beacon to compare: as printed in paper 002, and of known moments.

The paper converts the normals of the field's plane to directions (Eq 4), computes the distances
from the angles between them (Eq 9-11), the centre from the distances (Eq 12), and the attitude from
measured and known directions (Eq 18-21).  That is right only where the normals are given in beacon
axes, which the calibration is to estimate, and each direction in its hemisphere; the paper's
argument that the centre does not depend on the attitude (Eq 13-17) is false.  Given normals in the
magnetometers' axes, one degree of tilt moves the centre by 0.2 m.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from magfusion.calibration.beacon import BeaconMeasurements, whitened_parts
from magfusion.estimation.snapshot.candidates import wahba
from magfusion.estimation.solve.batched import (
    NormalEquations,
    minimise,
    moved_poses,
    normal_equations,
)
from magfusion.model.field import observe
from magfusion.papers.p002_beacon.equations import (
    eq_04_direction,
    eq_09_cosines,
    eq_10_lengths,
    eq_11_misfit,
    eq_18_direction,
    eq_19_attitude,
    eq_21_angles,
    pairs,
)
from magfusion.papers.p004_fingerprints.rssi import trilaterate
from magfusion.receiver.ellipse import plane_normal, semi_axes
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray, IntArray


@dataclass(frozen=True, eq=False)
class PrintedCalibration:
    """Results of the paper's equations, per run.

    Parameters
    ----------
    centre_world : ndarray, shape (runs, 3)
        (m)
    world_from_beacon : ndarray, shape (runs, 3, 3)
        Transpose of the least-squares matrix of Eq 19, in general no rotation.
    angles : ndarray, shape (runs, 3)
        psi, gamma, lambda of Eq 21 (rad).
    distance : ndarray, shape (runs, magnetometers)
        From the centre (m); a negative one shows that the directions fit no beacon.
    alarm : ndarray, shape (runs,)
        RMS residual of the law of cosines (m^2); zero for three magnetometers.
    """

    centre_world: Array
    world_from_beacon: Array
    angles: Array
    distance: Array
    alarm: Array


def distances_from_angles(
    direction: Array, position_world: Array, start: Array
) -> tuple[Array, Array]:
    """Return distances (runs, m) (m) and residuals of Eq 11 (runs, pairs) (m^2), by least squares.

    Directions (runs, m, 3) from the beacon in any axes, magnetometers (m, 3) (m); the start
    (runs, m) selects among up to four solutions that fit three magnetometers.
    """
    first, second = pairs(len(position_world))
    cosine, length = eq_09_cosines(direction), eq_10_lengths(position_world)
    pair = np.arange(len(first))

    def rows_at(rows: IntArray, distance: Array) -> tuple[Array, Array]:
        a, b, c = distance[:, first], distance[:, second], cosine[rows]
        slope = np.zeros((len(rows), len(pair), len(position_world)))
        slope[:, pair, first] = 2.0 * (a - b * c)
        slope[:, pair, second] = 2.0 * (b - a * c)
        return eq_11_misfit(distance, c, length), slope

    distance = minimise(lambda *at: normal_equations(*rows_at(*at)), start).state
    return distance, eq_11_misfit(distance, cosine, length)


def centre_by_rays(direction: Array, distance: Array, position_world: Array) -> Array:
    """Return the centres (runs, 3) (m) of rays aligned rigidly with their known ends.

    Unlike the distances (runs, m) alone, the directions (runs, m, 3), beacon axes, determine on
    which side of the magnetometers' plane (m, 3) the beacon is.
    """
    rays = distance[..., None] * direction
    mean_ray, mean_place = rays.mean(axis=1), position_world.mean(axis=0)
    world_from_beacon = wahba(
        np.einsum("mi,rmj->rij", position_world - mean_place, rays - mean_ray[:, None])
    )
    return mean_place - (world_from_beacon @ mean_ray[..., None])[..., 0]


def calibrate_as_printed(
    phasor: ComplexArray,
    position_world: Array,
    moment: float,
    hemisphere: Array | None = None,
) -> PrintedCalibration:
    """Calibrate a beacon by the equations of paper 002.

    Parameters
    ----------
    phasor : complex ndarray, shape (runs, magnetometers, 3)
        (T).  In beacon axes the equations are right; in world axes, as measured by magnetometers
        aligned with the world, they are the paper's.
    position_world : ndarray, shape (magnetometers, 3)
        Three at least, not on a line (m).
    moment : float
        Of both coils (A m^2); only the start of the distances depends on it.
    hemisphere : ndarray, shape (magnetometers,), optional
        The sign of each direction's third component, which the normal does not determine; by
        default positive, as in the paper.
    """
    direction = eq_04_direction(plane_normal(phasor))
    if hemisphere is not None:
        direction = direction * hemisphere[:, None]
    start = np.cbrt(MU0_OVER_4PI * moment / semi_axes(phasor)[..., 0])
    distance, residual = distances_from_angles(direction, position_world, start)
    by_rays = centre_by_rays(direction, distance, position_world)
    centre = trilaterate(distance, position_world, by_rays)  # the minimum of Eq 12
    known = eq_18_direction(centre, position_world)
    world_from_beacon = np.swapaxes(eq_19_attitude(direction, known), -1, -2)
    return PrintedCalibration(
        centre_world=centre,
        world_from_beacon=world_from_beacon,
        angles=eq_21_angles(world_from_beacon),
        distance=distance,
        alarm=np.sqrt(np.mean(residual**2, axis=-1)),
    )


def consistent_centres(
    direction: Array, position_world: Array, tolerance: float
) -> list[tuple[tuple[int, ...], Array]]:
    """Return every centre that fits directions (m, 3) of unknown hemisphere, with its signs.

    The normals do not determine each direction's sign (one of them is the choice of the beacon's
    own z axis), and the law of cosines, with a residual up to the tolerance (m^2), has up to four
    roots for three magnetometers.
    """
    count = len(position_world)
    size = float(np.max(np.linalg.norm(position_world[:, None] - position_world, axis=-1)))
    starts = size * np.array(list(product((0.2, 0.6, 1.2), repeat=count)))
    result: list[tuple[tuple[int, ...], Array]] = []
    for signs in product((1, -1), repeat=count - 1):
        rotated = np.broadcast_to(
            direction * np.array([1, *signs])[:, None], (len(starts), count, 3)
        )
        distance, residual = distances_from_angles(rotated, position_world, starts)
        fits = (np.max(np.abs(residual), axis=-1) < tolerance) & np.all(distance > 0.0, axis=-1)
        for centre in centre_by_rays(rotated[fits], distance[fits], position_world):
            known = [c for s, c in result if s == (1, *signs)]
            if not any(np.linalg.norm(centre - other) < 1e-3 * size for other in known):
                result.append(((1, *signs), centre))
    return result


def fit_known_moments(
    measured: BeaconMeasurements, centre_world: Array, world_from_beacon: Array
) -> tuple[Array, Array, Array]:
    """Find centre and attitude of a synchronised beacon whose moments are as declared.

    Parameters
    ----------
    centre_world : ndarray, shape (runs, 3)
        Start (m), e.g. from `calibrate_beacon`.
    world_from_beacon : ndarray, shape (runs, 3, 3)

    Returns
    -------
    centre_world : ndarray, shape (runs, 3)
    world_from_beacon : ndarray, shape (runs, 3, 3)
    cov : ndarray, shape (runs, 6, 6)
        Of rotation and position, beacon axes: the Cramér-Rao bound.
    """
    seen = np.nan_to_num(measured.phasor_sensor)

    def model(rows: IntArray, pose: Array) -> NormalEquations:
        rotation, centre = pose[:, :9].reshape(-1, 3, 3), pose[:, 9:]
        # The beacon is fixed; magnetometers move with the frame in which it has the requested pose.
        back = measured.beacon.world_from_beacon @ np.swapaxes(rotation, -1, -2)
        position = (measured.position_world - centre[:, None]) @ np.swapaxes(back, -1, -2)
        result = observe(
            replace(measured.beacon, field_map=None),
            measured.magnetometer,
            back[:, None] @ measured.world_from_body,
            position + measured.beacon.position_world,
        )
        error = (result.phasor_sensor - seen[rows])[..., None]
        return normal_equations(
            whitened_parts(measured, error)[..., 0], whitened_parts(measured, result.beacon_pose)
        )

    start = np.concatenate([world_from_beacon.reshape(-1, 9), centre_world], axis=-1)
    result = minimise(model, start, moved_poses)
    pose = result.state
    return pose[:, 9:], pose[:, :9].reshape(-1, 3, 3), np.asarray(np.linalg.inv(result.information))
