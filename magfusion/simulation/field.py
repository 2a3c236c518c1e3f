"""The simulator's own field of a beacon: coils of their true size, not dipoles."""

from dataclasses import dataclass

import numpy as np

from magfusion.physics.dipole import dipole_field
from magfusion.site import Beacon, Coil, Site
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray

_AZIMUTHS = 32
_SLICES = 5


@dataclass(frozen=True, eq=False)
class Drives:
    """True drive of every beacon against the log clock, beyond what its coils declare.

    Parameters
    ----------
    phase : ndarray, shape (channels,)
        At the log's epoch (rad).
    drift : ndarray, shape (beacons,)
        Relative frequency error.
    """

    phase: Array
    drift: Array


def synchronised_drives(site: Site) -> Drives:
    """Return drives that run exactly as the site declares."""
    return Drives(np.zeros(len(site.channels)), np.zeros(len(site.beacons)))


def coil_field(offset: Array, coil: Coil) -> Array:
    """Return the flux density of a coil at its peak current, in the axes of its arguments.

    A coil with a radius is a thin loop, one with a length as well a uniform current sheet, one
    with a length alone a line of dipoles, one with neither a dipole.  Loops are integrated by
    Biot and Savart's law at 32 azimuths and sheets at 5 Gauss-Legendre slices: the relative error
    is below 1e-5 (a lone loop's below 1e-7) farther than two radii and two lengths away.

    Parameters
    ----------
    offset : ndarray, shape (n, 3)
        From the beacon's origin (m).
    coil : Coil

    Returns
    -------
    ndarray, shape (n, 3)
        (T)
    """
    size = float(np.linalg.norm(coil.moment_beacon))
    if size == 0.0:
        return np.zeros_like(offset)
    from_centre = offset - coil.centre_beacon
    axis = coil.moment_beacon / size
    nodes, weights = _slices(coil.length)
    field = np.zeros_like(from_centre)
    for node, weight in zip(nodes, weights, strict=True):
        from_slice = from_centre - node * axis
        if coil.radius:
            field += _loop_field(from_slice, weight * coil.moment_beacon, coil.radius)
        else:
            field += dipole_field(from_slice, weight * coil.moment_beacon)
    return field


def beacon_fields_world(beacon: Beacon, point_world: Array) -> Array:
    """Return the field of each coil at its peak current (T), shape (n, coils, 3)."""
    offset_beacon = (point_world - beacon.position_world) @ beacon.world_from_beacon
    fields_beacon = np.stack([coil_field(offset_beacon, coil) for coil in beacon.coils], axis=1)
    return np.asarray(fields_beacon @ beacon.world_from_beacon.T)


def phasors_world(beacon: Beacon, point_world: Array) -> ComplexArray:
    """Return the phasor of each tone without phase or drift of the drive, (n, tones, 3) (T)."""
    fields = beacon_fields_world(beacon, point_world)
    phasors = np.zeros((len(point_world), len(beacon.tones), 3), dtype=np.complex128)
    for j, coil in enumerate(beacon.coils):
        tone = beacon.tones.index((coil.frequency_hz or beacon.frequency_hz, coil.slot))
        phasors[:, tone] += fields[:, j] * np.exp(1j * coil.phase)
    return phasors


def _slices(length: float | None) -> tuple[Array, Array]:
    """Return positions along the axis (m) and weights that sum to one."""
    if not length:
        return np.zeros(1), np.ones(1)
    nodes, weights = np.polynomial.legendre.leggauss(_SLICES)
    return 0.5 * length * nodes, 0.5 * weights


def _loop_field(offset: Array, moment: Array, radius: float) -> Array:
    """Return the field of a circular current loop of the given moment around its centre."""
    size = float(np.linalg.norm(moment))
    current = size / (np.pi * radius**2)
    axis = moment / size
    across = np.linalg.svd(axis[None])[2][1]
    along = np.cross(axis, across)
    field = np.zeros_like(offset)
    for angle in np.arange(_AZIMUTHS) * 2.0 * np.pi / _AZIMUTHS:
        outward = np.cos(angle) * across + np.sin(angle) * along
        separation = offset - radius * outward
        cubed = np.einsum("ni,ni->n", separation, separation)[:, None] ** 1.5
        field += np.cross(np.cross(axis, outward), separation) / cubed
    return np.asarray(MU0_OVER_4PI * current * radius * (2.0 * np.pi / _AZIMUTHS) * field)
