"""Calibration of a rotating beacon as paper 002 prints it, to compare with.

The paper turns the normals of the field's plane into directions (Eq 4), finds the distances from
the angles between them (Eq 9-11), the centre from the distances (Eq 12), and the attitude from
directions seen and directions known (Eq 18-21).  That is right only where the normals are given in
the axes of the beacon, which is what the calibration is to find, and each direction in its
hemisphere; the paper's argument that the centre does not depend on the attitude (Eq 13-17) is
false.  Given normals in the magnetometers' axes, one degree of tilt moves the centre by 0.2 m.
"""

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from magfusion.calibration.least_squares import minimise
from magfusion.fixes.candidates import wahba
from magfusion.fixes.direction import (
    angles_as_printed,
    attitude_as_printed,
    direction_from_normal,
)
from magfusion.receiver.ellipse import plane_normal, semi_axes
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray, IntArray


@dataclass(frozen=True, eq=False)
class PrintedCalibration:
    """What the paper's equations give, run by run.

    Parameters
    ----------
    centre_world : ndarray, shape (runs, 3)
        (m)
    world_from_beacon : ndarray, shape (runs, 3, 3)
        Transpose of the least-squares matrix of Eq 19, in general no rotation.
    angles : ndarray, shape (runs, 3)
        psi, gamma, lambda of Eq 21 (rad).
    distance : ndarray, shape (runs, magnetometers)
        From the centre (m); one below zero tells that the directions fit no beacon.
    alarm : ndarray, shape (runs,)
        What the law of cosines leaves (m^2), root of the mean square; zero for three magnetometers.
    """

    centre_world: Array
    world_from_beacon: Array
    angles: Array
    distance: Array
    alarm: Array


def directions(phasor: ComplexArray, hemisphere: Array | None = None) -> Array:
    """Return the directions that Eq 4 makes of phasors, shape (..., 3), in the same axes.

    Parameters
    ----------
    phasor : complex ndarray, shape (..., 3)
        (T); beacon axes, or, with the paper, whatever axes the magnetometer has.
    hemisphere : ndarray, shape (...), optional
        The sign of the direction's third component, which the normal does not tell; positive, as
        the paper has it, where it is not given.
    """
    found = direction_from_normal(plane_normal(phasor))
    return found if hemisphere is None else found * np.asarray(hemisphere)[..., None]


def distances_from_angles(
    direction: Array, position_world: Array, start: Array
) -> tuple[Array, Array]:
    """Solve the law of cosines for the distances to a beacon (Eq 9-11), by least squares.

    Parameters
    ----------
    direction : ndarray, shape (runs, magnetometers, 3)
        From the beacon, in any axes.
    position_world : ndarray, shape (magnetometers, 3)
        (m)
    start : ndarray, shape (runs, magnetometers)
        Distances to start from (m): up to four solutions fit three magnetometers.

    Returns
    -------
    distance : ndarray, shape (runs, magnetometers)
        (m)
    residual : ndarray, shape (runs, pairs)
        (m^2)
    """
    first, second = np.array(list(combinations(range(len(position_world)), 2))).T
    cosine = np.einsum("rpi,rpi->rp", direction[:, first], direction[:, second])
    square = np.sum((position_world[first] - position_world[second]) ** 2, axis=-1)
    pair = np.arange(len(first))

    def model(rows: IntArray, distance: Array) -> tuple[Array, Array]:
        a, b, c = distance[:, first], distance[:, second], cosine[rows]
        slope = np.zeros((len(rows), len(pair), len(position_world)))
        slope[:, pair, first] = 2.0 * (a - b * c)
        slope[:, pair, second] = 2.0 * (b - a * c)
        return a**2 + b**2 - 2.0 * a * b * c - square, slope

    distance, _ = minimise(model, start)
    return distance, model(np.arange(len(distance)), distance)[0]


def centre_from_distances(position_world: Array, distance: Array, start: Array) -> Array:
    """Minimise Eq 12, the errors of the distances to known places, shape (runs, 3) (m).

    Of magnetometers in a plane both sides fit alike: the result is that of ``start`` (runs, 3).
    """

    def model(rows: IntArray, centre: Array) -> tuple[Array, Array]:
        offset = centre[:, None] - position_world
        length = np.linalg.norm(offset, axis=-1)
        return length - distance[rows], offset / length[..., None]

    return minimise(model, start)[0]


def centre_by_rays(direction: Array, distance: Array, position_world: Array) -> Array:
    """Return the centre that rays of known lengths have when moved rigidly onto their ends.

    Unlike the distances alone it knows on which side of the magnetometers' plane the beacon is.

    Parameters
    ----------
    direction : ndarray, shape (runs, magnetometers, 3)
        Beacon axes.
    distance : ndarray, shape (runs, magnetometers)
        (m)
    position_world : ndarray, shape (magnetometers, 3)
        (m)
    """
    rays = distance[..., None] * direction
    mean_ray, mean_place = rays.mean(axis=1), position_world.mean(axis=0)
    world_from_beacon = wahba(
        np.einsum("mi,rmj->rij", position_world - mean_place, rays - mean_ray[:, None])
    )
    return np.asarray(mean_place - (world_from_beacon @ mean_ray[..., None])[..., 0])


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
        (T).  In beacon axes the equations are right; in world axes, which is what magnetometers
        that are aligned with the world measure, they are the paper's.
    position_world : ndarray, shape (magnetometers, 3)
        Three at least, not on a line (m).
    moment : float
        Of both coils (A m^2); only the start of the distances depends on it.
    hemisphere : ndarray, shape (magnetometers,), optional
        As in `directions`.
    """
    direction = directions(phasor, hemisphere)
    start = np.cbrt(MU0_OVER_4PI * moment / semi_axes(phasor)[..., 0])
    distance, residual = distances_from_angles(direction, position_world, start)
    by_rays = centre_by_rays(direction, distance, position_world)
    centre = centre_from_distances(position_world, distance, by_rays)
    offset = position_world - centre[:, None]
    known = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    world_from_beacon = np.swapaxes(attitude_as_printed(direction, known), -1, -2)
    return PrintedCalibration(
        centre_world=centre,
        world_from_beacon=world_from_beacon,
        angles=angles_as_printed(world_from_beacon),
        distance=distance,
        alarm=np.sqrt(np.mean(residual**2, axis=-1)),
    )


def angle_variances(world_from_beacon: Array, element_variance: Array) -> Array:
    """Return the variances of psi, gamma and lambda as printed (Eq 30-32).

    ``psi`` from the arcsine of element (3, 1), ``gamma`` and ``lambda`` from arccosines of (1, 1)
    and (3, 3): hence they grow without bound where cos gamma or cos lambda is one, which the
    arctangents of `calibrate_as_printed` do not.

    Parameters
    ----------
    world_from_beacon : ndarray, shape (3, 3)
    element_variance : ndarray, shape (3, 3)
        Of the elements of the estimated matrix.

    Returns
    -------
    ndarray, shape (3,)
        (rad^2)
    """
    psi, gamma, lamda = angles_as_printed(world_from_beacon)
    upright = np.cos(psi) ** 2
    return np.array(
        [
            element_variance[2, 0] / upright,
            element_variance[0, 0] / (upright * np.sin(gamma) ** 2),
            element_variance[2, 2] / (upright * np.sin(lamda) ** 2),
        ]
    )


def consistent_centres(
    direction: Array, position_world: Array, tolerance: float
) -> list[tuple[tuple[int, ...], Array]]:
    """Return every centre that fits directions of unknown hemisphere, with the signs it takes.

    The normals leave each direction's sign open (one of them is the choice of the beacon's own
    z axis), and the law of cosines has up to four roots for three magnetometers.

    Parameters
    ----------
    direction : ndarray, shape (magnetometers, 3)
        Beacon axes.
    position_world : ndarray, shape (magnetometers, 3)
        (m)
    tolerance : float
        What the law of cosines may leave (m^2).
    """
    count = len(position_world)
    size = float(np.max(np.linalg.norm(position_world[:, None] - position_world, axis=-1)))
    starts = size * np.array(list(product((0.2, 0.6, 1.2), repeat=count)))
    found: list[tuple[tuple[int, ...], Array]] = []
    for signs in product((1, -1), repeat=count - 1):
        turned = np.broadcast_to(
            direction * np.array([1, *signs])[:, None], (len(starts), count, 3)
        )
        distance, residual = distances_from_angles(turned, position_world, starts)
        fits = (np.max(np.abs(residual), axis=-1) < tolerance) & np.all(distance > 0.0, axis=-1)
        for centre in centre_by_rays(turned[fits], distance[fits], position_world):
            known = [c for s, c in found if s == (1, *signs)]
            if not any(np.linalg.norm(centre - other) < 1e-3 * size for other in known):
                found.append(((1, *signs), centre))
    return found


def geometric_centre(corner_world: Array) -> Array:
    """Return the traditional calibration: the mean of the corners of the beacon's box.

    Parameters
    ----------
    corner_world : ndarray, shape (8, 3)
        (m)
    """
    return np.asarray(corner_world.mean(axis=0))
