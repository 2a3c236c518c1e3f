"""Conducting ground or water around all beacons of a site."""

from dataclasses import replace

import numpy as np

from magfusion.model.coil_field import alone, coil_fields
from magfusion.model.physics.conduction import skin_depth
from magfusion.model.site import Beacon, Site
from magfusion.units import MU0_OVER_4PI, TINY, Array, ComplexArray

# Beyond so many skin depths about a hundredth of the field remains, which depends more on the
# ground than on the position.
DEEPEST = 5.0

_NEARER = 3.0  # e-folds by which conduction may reduce the range
_HALVINGS = 24


def conductivity_of(site: Site) -> float:
    """Return the conductivity around the beacons of a site (S/m); zero for none."""
    return site.beacons[0].conductivity if site.beacons else 0.0


def in_ground(site: Site, conductivity: float) -> Site:
    """Return a site with a conductivity of its ground or water (S/m)."""
    beacons = tuple(replace(b, conductivity=conductivity) for b in site.beacons)
    return replace(site, beacons=beacons)


def skin_depth_count(beacon: Beacon, distance: Array) -> Array:
    """Return distances (m) in skin depths of a beacon's highest tone."""
    frequency = float(beacon.tone_frequencies_hz.max())
    return np.asarray(distance / skin_depth(frequency, beacon.conductivity))


def ground_error(site: Site, distance: Array) -> Array:
    """Return the relative error of each beacon's field that the conductivity's sigma causes.

    `distance` (n, beacons) (m). Returns (n, beacons): of the field in the dipole's equatorial
    plane.
    """
    depths = [skin_depth_count(b, distance[:, k]) for k, b in enumerate(site.beacons)]
    x = (1.0 + 1.0j) * np.minimum(np.stack(depths, axis=1), 2.0 * DEEPEST)
    return site.log_conductivity_sigma * np.abs(x**2 * (1.0 - x) / (1.0 + x + x**2)) / 2.0


def range_of_strength(beacon: Beacon, phasor: ComplexArray, direction_beacon: Array) -> Array:
    """Return the range in each direction at which a beacon's field is as strong as its phasors.

    `phasor` (n, tones, 3) (T), in any axes. `direction_beacon` (directions, 3): unit vectors.
    Returns (n, directions) (m).
    """
    total = np.sum(np.abs(phasor) ** 2, axis=(1, 2))[:, None] + TINY
    drive = beacon.moments_beacon.T @ beacon.excitation  # (3, tones)
    strongest = 2.0 * MU0_OVER_4PI * np.sqrt(np.sum(np.abs(drive) ** 2))
    # With conduction the field is nowhere stronger than that of the dipole at its poles.
    far = np.log(np.cbrt(strongest / np.sqrt(total))) + np.zeros(len(direction_beacon))
    near, source = far - _NEARER, alone(beacon)
    for _ in range(_HALVINGS):
        middle = 0.5 * (near + far)
        coils = coil_fields(source, np.exp(middle)[..., None] * direction_beacon)
        seen = beacon.excitation.T @ coils
        stronger = np.sum(np.abs(seen) ** 2, axis=(-1, -2)) > total
        near, far = np.where(stronger, middle, near), np.where(stronger, far, middle)
    return np.asarray(np.exp(0.5 * (near + far)))


def sphere(number: int) -> Array:
    """Return evenly spread directions (Fibonacci lattice), shape (number, 3)."""
    height = 1.0 - (2.0 * np.arange(number) + 1.0) / number
    turn = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(number)
    flat = np.sqrt(1.0 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
