"""The fields of a beacon's coils as they are declared: dipoles, loops, current sheets.

A coil without a size is a dipole.  One with a radius is a thin loop, one with a length as well a
uniform current sheet, one with a length alone a line of dipoles: those with a
length are as many loops, or dipoles, as Gauss and Legendre's rule has nodes.  The relative error
is below 1e-9 from half a length off the axis, and below 1e-6 from three tenths of it.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from magfusion.model.physics.dipole import dipole_field, dipole_field_along, dipole_gradient
from magfusion.model.physics.loop import loop_field, loop_field_and_gradient
from magfusion.model.site import Beacon, Coil
from magfusion.units import Array, IntArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


class _Loops(NamedTuple):
    """What stands for the coils of a beacon."""

    centre: Array  # (loops, 3), beacon axes (m)
    moment: Array  # (loops, 3), beacon axes (A m^2)
    radius: Array  # (loops,), zero for a dipole (m)
    first: IntArray  # (coils,), the first loop of each


def is_sized(beacon: Beacon) -> bool:
    """Tell whether a coil of the beacon is declared with a size."""
    return any(coil.radius is not None or coil.length is not None for coil in beacon.coils)


def as_points(beacon: Beacon) -> Beacon:
    """Return the beacon with a dipole in place of each coil."""
    points = tuple(replace(coil, radius=None, length=None) for coil in beacon.coils)
    return replace(beacon, coils=points)


def _loops(coils: tuple[Coil, ...]) -> _Loops:
    nodes, weights = zip(*(_slices(coil) for coil in coils), strict=True)
    count = [len(weight) for weight in weights]
    moment = np.repeat([coil.moment_beacon for coil in coils], count, axis=0)
    axis = moment / np.linalg.norm(moment, axis=1, keepdims=True)
    centre = np.repeat([coil.centre_beacon for coil in coils], count, axis=0)
    return _Loops(
        centre=centre + np.concatenate(nodes)[:, None] * axis,
        moment=np.concatenate(weights)[:, None] * moment,
        radius=np.repeat([coil.radius or 0.0 for coil in coils], count),
        first=np.concatenate([[0], np.cumsum(count[:-1])]).astype(np.int64),
    )


def _slices(coil: Coil) -> tuple[Array, Array]:
    """Return positions along the axis (m) and weights that sum to one."""
    if coil.length is None:
        return np.zeros(1), np.ones(1)
    return 0.5 * coil.length * _NODES, 0.5 * _WEIGHTS


def coil_fields(beacon: Beacon, offset_beacon: Array) -> Array:
    """Return the field of each coil at its peak current.

    Parameters
    ----------
    offset_beacon : ndarray, shape (..., 3)
        From the beacon's origin, beacon axes (m).

    Returns
    -------
    ndarray, shape (..., coils, 3)
        Beacon axes (T).
    """
    if not is_sized(beacon):
        offset = offset_beacon[..., None, :] - beacon.centres_beacon
        return dipole_field(offset, beacon.moments_beacon)
    loops = _loops(beacon.coils)
    field = loop_field(offset_beacon[..., None, :] - loops.centre, loops.moment, loops.radius)
    return np.asarray(np.add.reduceat(field, loops.first, axis=-2))


def coil_fields_and_gradients(beacon: Beacon, offset_beacon: Array) -> tuple[Array, Array]:
    """Return the field of each coil at its peak current, with its gradient.

    Parameters
    ----------
    offset_beacon : ndarray, shape (..., 3)
        From the beacon's origin, beacon axes (m).

    Returns
    -------
    field : ndarray, shape (..., coils, 3)
        Beacon axes (T).
    gradient : ndarray, shape (..., coils, 3, 3)
        ``[i, j] = d field_i / d offset_j`` (T/m).
    """
    if not is_sized(beacon):
        offset, moments = offset_beacon[..., None, :] - beacon.centres_beacon, beacon.moments_beacon
        return dipole_field(offset, moments), dipole_gradient(offset, moments)
    loops = _loops(beacon.coils)
    field, gradient = loop_field_and_gradient(
        offset_beacon[..., None, :] - loops.centre, loops.moment, loops.radius
    )
    return (
        np.asarray(np.add.reduceat(field, loops.first, axis=-2)),
        np.asarray(np.add.reduceat(gradient, loops.first, axis=-3)),
    )


class Driven(NamedTuple):
    """The field of coils that carry known currents.

    Parameters
    ----------
    field : ndarray, shape (n, 3)
        (T)
    along : ndarray, shape (n, 3), optional
        Its derivative along a displacement (T a unit of it).
    """

    field: Array
    along: Array | None


def driven_dipoles(
    beacon: Beacon, offset_beacon: Array, current: Array, along_beacon: Array | None
) -> Driven:
    """Return the field of coils without a size: of those at one place that of one moment.

    Parameters
    ----------
    offset_beacon : ndarray, shape (n, 3)
        From the beacon's origin, beacon axes (m).
    current : ndarray, shape (n, coils)
        Of each coil, as a share of its peak.
    along_beacon : ndarray, shape (n, 3), optional
        A displacement of the points.

    Returns
    -------
    Driven
        Beacon axes.
    """
    field, along = np.zeros_like(offset_beacon), np.zeros_like(offset_beacon)
    centres, place = np.unique(beacon.centres_beacon, axis=0, return_inverse=True)
    for k, centre in enumerate(centres):
        here = place == k
        moment, offset = current[:, here] @ beacon.moments_beacon[here], offset_beacon - centre
        field += dipole_field(offset, moment)
        if along_beacon is not None:
            along += dipole_field_along(offset, moment, along_beacon)
    return Driven(field, None if along_beacon is None else along)
