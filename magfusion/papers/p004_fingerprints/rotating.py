"""Inputs of the algorithms of paper 004, from the beacons and phasors of a site and a log."""

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import FieldSamples
from magfusion.model.site import Beacon, Site
from magfusion.papers.p004_fingerprints.algorithms import (
    LEAST_BEACONS,
    RotatingFields,
)
from magfusion.papers.p004_fingerprints.equations import eq_25_fingerprint
from magfusion.papers.p004_fingerprints.fingerprint import (
    NEIGHBOURS,
    FingerprintDatabase,
    calibrated,
)
from magfusion.receiver.ellipse import plane_normal
from magfusion.units import Array, BoolArray

ROUND = 1e-3  # least ratio of a rotating moment's axes


def rotating_beacons(
    database: FingerprintDatabase, site: Site
) -> tuple[FingerprintDatabase, Array]:
    """Return the fingerprints of rotating beacons alone, and the axes about which these rotate."""
    axis = np.array([rotation_axis_world(b) for b in _beacons(site, database)])
    columns = np.flatnonzero(np.isfinite(axis).all(axis=1))
    if len(columns) < LEAST_BEACONS:
        raise InputError(
            f"the algorithms of paper 004 require {LEAST_BEACONS} rotating beacons, two coils on"
            f" one tone; site and survey share {len(columns)}; use --method likelihood, or add"
            " beacons"
        )
    kept = FingerprintDatabase(
        tuple(database.beacons[c] for c in columns),
        database.beacons_world[columns],
        database.position_world,
        database.amplitude[:, columns],
    )
    useful = int(np.sum(_enough(kept.amplitude)))
    if useful < NEIGHBOURS:
        raise InputError(
            f"has {useful} points that detect {LEAST_BEACONS} rotating beacons; {NEIGHBOURS}"
            " are needed; survey more places"
        )
    return kept, axis[columns]


def _beacons(site: Site, database: FingerprintDatabase) -> list[Beacon]:
    return [b for b in site.beacons if b.name in database.beacons]


def _enough(amplitude: Array) -> BoolArray:
    return np.sum(np.isfinite(amplitude), axis=1) >= LEAST_BEACONS


def rotation_axis_world(beacon: Beacon) -> Array:
    """Return the unit vector about which a beacon's moment rotates; NaN where it does not."""
    if len(beacon.tones) != 1:
        return np.full(3, np.nan)
    drive = (beacon.moments_beacon.T @ beacon.excitation)[:, 0]
    normal = plane_normal(drive)
    size = float(np.linalg.norm(normal))
    if size < ROUND * float(np.sum(np.abs(drive) ** 2)):
        return np.full(3, np.nan)
    return beacon.world_from_beacon @ normal / size


def rotating_fields(
    samples: FieldSamples, site: Site, beacons: tuple[str, ...], axis_world: Array
) -> RotatingFields:
    """Return the amplitudes and normals of rotating beacons (`rotation_axis_world`)."""
    own = [site.channels.index((name, 0)) for name in beacons]
    phasor = calibrated(samples.phasor_sensor[:, own], site)
    body_from_sensor = site.platform.magnetometer.body_from_sensor
    return RotatingFields(
        axis_world=axis_world,
        amplitude=eq_25_fingerprint(phasor[:, :, None]),
        normal_body=plane_normal(phasor) @ body_from_sensor.T,
    )
