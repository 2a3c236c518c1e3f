"""Inputs of the algorithms of paper 004, from the beacons and phasors of a site and a log."""

import numpy as np

from magfusion.errors import InputError
from magfusion.model.samples import FieldSamples, ImuSamples
from magfusion.model.site import Beacon, Site
from magfusion.papers.p004_fingerprints.algorithms import MIN_BEACONS, RotatingFields
from magfusion.papers.p004_fingerprints.equations import eq_25_fingerprint
from magfusion.papers.p004_fingerprints.fingerprint import (
    NEIGHBOURS,
    FingerprintDatabase,
    calibrated,
)
from magfusion.receiver.ellipse import plane_normal
from magfusion.units import DEGREE, Array, BoolArray

ROUND = 1e-3  # least ratio of a rotating moment's axes
# Largest angle by which Eq 18 may be violated: two degrees of tilt make six of attitude error.
MAX_TILT = 2.0 * DEGREE
GRAVITY_WINDOW = 1.0  # s, over which the specific force is averaged


def rotating_beacons(
    database: FingerprintDatabase, site: Site
) -> tuple[FingerprintDatabase, Array]:
    """Return the fingerprints of rotating beacons alone, and the axes about which these rotate."""
    axis = np.array([rotation_axis_world(b) for b in site.beacons if b.name in database.beacons])
    columns = np.flatnonzero(np.isfinite(axis).all(axis=1))
    if len(columns) < MIN_BEACONS:
        raise InputError(
            f"the algorithms of paper 004 require {MIN_BEACONS} rotating beacons, two coils on"
            f" one tone; site and survey share {len(columns)}; use --method likelihood, or add"
            " beacons"
        )
    kept = FingerprintDatabase(
        tuple(database.beacons[c] for c in columns),
        database.beacons_world[columns],
        database.position_world,
        database.amplitude[:, columns],
    )
    useful = int(np.sum(np.sum(np.isfinite(kept.amplitude), axis=1) >= MIN_BEACONS))
    if useful < NEIGHBOURS:
        raise InputError(
            f"has {useful} points that detect {MIN_BEACONS} rotating beacons; {NEIGHBOURS}"
            " are needed; survey more places"
        )
    return kept, axis[columns]


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


def axis_spread(axis_world: Array) -> float:
    """Return the largest angle between the lines of axes (beacons, 3) and their mean line (rad)."""
    mean = _mean_line(axis_world)
    return float(np.arccos(np.clip(np.min(np.abs(axis_world @ mean)), 0.0, 1.0)))


def _mean_line(axis_world: Array) -> Array:
    """Return the unit vector (3,) along the mean line of axes whose signs do not matter."""
    return np.asarray(np.linalg.eigh(axis_world.T @ axis_world)[1][:, -1])


def attitude_is_valid(axis_world: Array, time: Array, imu: ImuSamples) -> BoolArray:
    """Return at which times (n,) (s) Eq 18 may hold, as far as axes and accelerometer show.

    Eq 18 holds for rotations about one axis that all beacons share.  The beacons' axes must
    therefore be parallel, and the mean specific force as far from that axis in the body as the
    vertical is in the world, both within `MAX_TILT`.  Without inertial samples nearby only the
    axes are checked.
    """
    if axis_spread(axis_world) > MAX_TILT:
        return np.zeros(len(time), dtype=bool)
    axis = _mean_line(axis_world)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.accel_body, axis=0)])
    first, last = (
        np.searchsorted(imu.time, time + sign * 0.5 * GRAVITY_WINDOW) for sign in (-1.0, 1.0)
    )
    mean = total[last] - total[first]
    size = np.linalg.norm(mean, axis=1)
    cosine = mean @ axis / np.where(size > 0.0, size, 1.0)
    tilt = np.abs(np.arccos(np.clip(cosine, -1.0, 1.0)) - np.arccos(np.clip(axis[2], -1.0, 1.0)))
    return np.asarray((size == 0.0) | (tilt <= MAX_TILT))
