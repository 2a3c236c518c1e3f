"""The simulator's own field of a beacon: coils of finite size, not dipoles."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from magfusion.model.physics.solenoid import solenoid_field
from magfusion.model.site import Beacon, Coil, Site
from magfusion.simulation.disturbance import Spheres
from magfusion.simulation.ground import ground_effect
from magfusion.simulation.layers import Layers, layered_effect
from magfusion.simulation.pipe import Steel
from magfusion.simulation.rails import layered_at, secondary_world
from magfusion.simulation.rotor_beacons import MagnetRotation
from magfusion.simulation.steel import SteelStructure
from magfusion.units import AnyArray, Array, ComplexArray


@dataclass(frozen=True, eq=False)
class Drives:
    """True drive of every beacon relative to the log clock, in addition to its coils' phases."""

    phase: Array  # (tones,), of all beacons' tones, one after the other, at the log's epoch (rad)
    drift: Array  # (beacons,), relative frequency error
    # of beacons that are magnets on shafts, by name; phase and drift do not apply to them
    turning: Mapping[str, MagnetRotation] = field(default_factory=dict)


def synchronised_drives(site: Site) -> Drives:
    """Return drives as declared by the site."""
    tones = sum(len(beacon.tones) for beacon in site.beacons)
    return Drives(np.zeros(tones), np.zeros(len(site.beacons)))


def coil_field(offset: Array, coil: Coil) -> Array:
    """Return the flux density of a coil at its peak current, in the axes of its arguments.

    See `magfusion.model.physics.solenoid.solenoid_field` for the shapes and their accuracy.
    `offset` (n, 3): from the beacon's origin (m). Returns (n, 3) (T).
    """
    return solenoid_field(offset - coil.centre_beacon, coil.moment_beacon, coil.radius, coil.length)


def beacon_fields_world(beacon: Beacon, point_world: Array) -> AnyArray:
    """Return the field of each coil at its peak current (T), shape (n, coils, 3).

    Complex where the ground conducts, in which it lags behind the current.
    """
    offset_beacon = (point_world - beacon.position_world) @ beacon.world_from_beacon
    fields: list[AnyArray] = [coil_field(offset_beacon, coil) for coil in beacon.coils]
    if beacon.conductivity:
        for j, coil in enumerate(beacon.coils):
            frequency_hz = coil.frequency_hz or beacon.frequency_hz
            offset = offset_beacon - coil.centre_beacon
            fields[j] = fields[j] + ground_effect(offset, coil, frequency_hz, beacon.conductivity)
    return np.asarray(np.stack(fields, axis=1) @ beacon.world_from_beacon.T)


def phasors_world(
    beacon: Beacon,
    point_world: Array,
    spheres: Spheres | None = None,
    layers: Layers | None = None,
    rails: Steel | SteelStructure | None = None,
) -> ComplexArray:
    """Return the phasor of each tone without phase or drift of the drive, (n, tones, 3) (T).

    Includes the contributions of spheres and rails, if any, without their interaction; layers
    replace the beacon's full space.
    """
    phasors = _primary_world(beacon, point_world, layers)
    if spheres is not None:
        at_spheres = _primary_world(beacon, spheres.position_world, layers)
        phasors += spheres.secondary_world(at_spheres, beacon.tone_frequencies_hz, point_world)
    if rails is not None:
        at_rails = _at_rails(beacon, rails, layers)
        phasors += secondary_world(rails, at_rails, beacon.tone_frequencies_hz, point_world)
    return phasors


def _primary_world(beacon: Beacon, point_world: Array, layers: Layers | None) -> ComplexArray:
    if layers is None:
        fields = beacon_fields_world(beacon, point_world)
    else:
        fields = beacon_fields_world(replace(beacon, conductivity=0.0), point_world)
        fields = fields + layered_effect(beacon, point_world, layers)
    return _by_tone(beacon, fields)


def _at_rails(beacon: Beacon, rails: Steel | SteelStructure, layers: Layers | None) -> ComplexArray:
    if layers is None:
        return _primary_world(beacon, rails.points_world(), None)
    still = beacon_fields_world(replace(beacon, conductivity=0.0), rails.points_world())
    return _by_tone(beacon, still + layered_at(rails, beacon, layers))


def _by_tone(beacon: Beacon, fields: AnyArray) -> ComplexArray:
    phasors = np.zeros((len(fields), len(beacon.tones), 3), dtype=np.complex128)
    for j, coil in enumerate(beacon.coils):
        tone = beacon.tones.index((coil.frequency_hz or beacon.frequency_hz, coil.slot))
        phasors[:, tone] += fields[:, j] * np.exp(1j * coil.phase)
    return phasors
