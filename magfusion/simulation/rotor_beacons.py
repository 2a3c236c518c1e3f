"""Beacons that are magnets on shafts, around which a platform moves.

Each order of the shaft's angle is a tone of the moment's own spectrum, with its own coils; their
carrier is the angle, not the clock.  The non-rotating part of the moment is static.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from magfusion.model.rotor import RotorAngles
from magfusion.model.site import Beacon, Coil, Site
from magfusion.simulation.shaft import Shaft, ShaftErrors, draw_shaft, moment_orders, shaft_course
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class MagnetRotation:
    """Rotation of a beacon's magnet."""

    angle: Callable[[Array], Array]  # of the shaft (rad), of times (s)
    steady_beacon: Array  # (3,), static moment (A m^2)
    encoder_sigma: float  # (rad)


def turn_rotors(
    site: Site, errors: ShaftErrors, duration: float, rng: np.random.Generator
) -> tuple[Site, dict[str, MagnetRotation]]:
    """Return a site whose rotors have all orders of their true moments, and their rotation."""
    beacons, turning = list[Beacon](), dict[str, MagnetRotation]()
    for beacon in site.beacons:
        if beacon.rotor is None:
            beacons.append(beacon)
            continue
        shaft = draw_shaft(beacon.rotor, errors, rng)
        beacons.append(_of_orders(beacon, shaft))
        turning[beacon.name] = MagnetRotation(
            shaft_course(shaft, beacon.frequency_hz, -2.0, duration + 2.0, rng),
            moment_orders(beacon.rotor, shaft).get(0, np.zeros(3)).real,
            shaft.encoder_sigma,
        )
    return replace(site, beacons=tuple(beacons)), turning


def recorded_angles(
    turning: Mapping[str, MagnetRotation], time: Array, rng: np.random.Generator
) -> RotorAngles:
    """Return encoder records at times (n,) (s)."""
    angles = {
        name: np.mod(
            own.angle(time) + own.encoder_sigma * rng.standard_normal(len(time)), 2.0 * np.pi
        )
        for name, own in turning.items()
    }
    return RotorAngles(time, angles)


def _of_orders(beacon: Beacon, shaft: Shaft) -> Beacon:
    assert beacon.rotor is not None
    coils = []
    for order, share in moment_orders(beacon.rotor, shaft).items():
        if not order:
            continue
        tone_hz = order * beacon.frequency_hz
        for moment, phase in ((share.real, 0.0), (share.imag, 0.5 * np.pi)):
            if np.any(moment):
                coils.append(Coil(moment, phase, frequency_hz=tone_hz))
    return replace(beacon, coils=tuple(coils))
