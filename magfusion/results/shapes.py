"""Outlines to draw: coils, coverage, uncertainty, and the scale at which they can be seen."""

from typing import NamedTuple

import numpy as np

from magfusion.model.physics.dipole import dipole_field
from magfusion.model.site import Beacon, Coil, Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

MIN_SIZE = 0.1  # m, of a scene: a tracker's


class Scale(NamedTuple):
    """Position and size of the scene, and the magnification of sigmas."""

    centre_world: Array  # (3,) (m)
    size: float  # diagonal of the box around beacons and path (m)
    sigma: int  # magnification: a power of ten

    @property
    def grid(self) -> float:
        """Side of a square of the grid (m): a power of ten, some squares to the scene."""
        return float(10.0 ** np.floor(np.log10(self.size / 2.5)))


def scene_scale(site: Site, trajectory: Trajectory) -> Scale:
    """Return the scale of the scene with the beacons and the path."""
    places = np.vstack([trajectory.position_world, *(b.position_world for b in site.beacons)])
    low, high = places.min(axis=0), places.max(axis=0)
    size = max(float(np.linalg.norm(high - low)), MIN_SIZE)
    magnification = 1
    if trajectory.pose_cov is not None:
        variance = np.trace(trajectory.pose_cov[:, 3:, 3:], axis1=1, axis2=2)
        three_sigma = 3.0 * np.sqrt(np.median(variance))
        visible = (m for m in (1, 10, 100) if m * three_sigma > 0.01 * size)
        magnification = next(visible, 1000)
    return Scale(0.5 * (low + high), size, magnification)


def coil_loop(coil: Coil, usual_radius: float) -> Array:
    """Return the circle of a coil's wire in beacon axes (m), shape (points, 3).

    ``usual_radius`` (m) is used where the coil's own is unknown.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 49)[:, None]
    _, _, basis = np.linalg.svd(coil.moment_beacon[None])  # the last two rows span its plane
    circle = np.cos(angle) * basis[1] + np.sin(angle) * basis[2]
    return np.asarray(coil.centre_beacon + (coil.radius or usual_radius) * circle)


def coverage_shell(beacon: Beacon, level: float) -> list[Array]:
    """Return the equator and two meridians of the surface at a level of the field.

    `level`: root mean square of the field over time (T). Returns lines, each of shape
    (points, 3), in beacon axes (m).
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    along, across, none = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    circles = (along, across, none), (along, none, across), (none, along, across)
    strips = []
    for direction in (np.stack(circle, axis=1) for circle in circles):
        fields = dipole_field(direction[:, None], beacon.moments_beacon)
        phasor = np.einsum("njx,jk->nxk", fields, beacon.excitation)
        at_one_metre = np.sqrt(0.5 * np.sum(np.abs(phasor) ** 2, axis=(1, 2)))
        strips.append(np.cbrt(at_one_metre / level)[:, None] * direction)
    return strips


def ellipsoids(world_from_body: Array, position_cov_body: Array) -> tuple[Array, Array]:
    """Return the half axes of one-sigma ellipsoids (m), (n, 3), and world_from_axes, (n, 3, 3)."""
    variance, axes_body = np.linalg.eigh(position_cov_body)
    axes_body[:, :, 0] *= np.linalg.det(axes_body)[:, None]
    half_sizes = np.sqrt(np.maximum(variance, 0.0))
    return half_sizes, world_from_body @ axes_body


def beads(position_world: Array, spacing: float) -> Array:
    """Return points of a path about ``spacing`` (m) apart along it, shape (m, 3)."""
    step = np.linalg.norm(np.diff(position_world, axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(step)])
    _, first = np.unique(travelled // spacing, return_index=True)
    return np.asarray(position_world[first])
