"""How a step in one calibration parameter moves what a site declares, and the way back.

Steps of fields are in microtesla, since numbers of all sizes in one covariance cost its digits.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.site import Beacon, Magnetometer, Site
from magfusion.units import Array

MICROTESLA = 1e-6  # T


def _turned(rotation: Array, vector: Array) -> Array:
    return np.asarray(rotation @ Rotation.from_rotvec(vector).as_matrix())


def _turn_between(old: Array, new: Array) -> Array:
    return np.asarray(Rotation.from_matrix(old.T @ new).as_rotvec())


def moved_beacon(beacon: Beacon, kind: str, step: Array) -> Beacon:
    """Return a beacon with its rotation, position or log-moments moved."""
    if kind == "rotation":
        return replace(beacon, world_from_beacon=_turned(beacon.world_from_beacon, step))
    if kind == "position":
        return replace(beacon, position_world=beacon.position_world + step)
    coils = tuple(
        replace(coil, moment_beacon=coil.moment_beacon * np.exp(change))
        for coil, change in zip(beacon.coils, step, strict=True)
    )
    return replace(beacon, coils=coils)


def beacon_difference(old: Beacon, new: Beacon, kind: str) -> Array:
    """Return the step that takes one beacon to another: the inverse of `moved_beacon`."""
    if kind == "rotation":
        return _turn_between(old.world_from_beacon, new.world_from_beacon)
    if kind == "position":
        return new.position_world - old.position_world
    sizes = [np.linalg.norm(c.moments_beacon, axis=1) for c in (old, new)]
    return np.asarray(np.log(sizes[1] / sizes[0]))


def _moved_sensor(sensor: Magnetometer, kind: str, step: Array) -> Magnetometer:
    if kind == "matrix":
        return replace(sensor, matrix=sensor.matrix + step.reshape(3, 3))
    if kind == "offset":
        return replace(sensor, offset=sensor.offset + MICROTESLA * step)
    if kind == "rotation":
        return replace(sensor, body_from_sensor=_turned(sensor.body_from_sensor, step))
    return replace(sensor, position_body=sensor.position_body + step)


def moved_magnetometer(site: Site, kind: str, step: Array) -> Site:
    """Return a site whose magnetometer's matrix, offset, rotation or position is moved."""
    sensor = _moved_sensor(site.platform.magnetometer, kind, step)
    return replace(site, platform=replace(site.platform, magnetometer=sensor))


def magnetometer_difference(old: Site, new: Site, kind: str) -> Array:
    """Return the step that takes one magnetometer to another."""
    a, b = old.platform.magnetometer, new.platform.magnetometer
    if kind == "matrix":
        return np.asarray((b.matrix - a.matrix).ravel())
    if kind == "offset":
        return np.asarray((b.offset - a.offset) / MICROTESLA)
    if kind == "rotation":
        return _turn_between(a.body_from_sensor, b.body_from_sensor)
    return b.position_body - a.position_body


def _cylindrical(field_world: Array) -> tuple[float, Array]:
    """Return the azimuth (rad), and the horizontal and vertical part (T)."""
    x, y, z = field_world
    return float(np.arctan2(y, x)), np.array([np.hypot(x, y), z])


def moved_earth(site: Site, kind: str, step: Array) -> Site:
    """Return a site whose Earth field is turned about the vertical, or changed in strength.

    ``declination`` is one angle (rad), ``strength`` the horizontal and the vertical part (uT).
    """
    assert site.earth_field_world is not None
    azimuth, parts = _cylindrical(site.earth_field_world)
    if kind == "declination":
        azimuth += float(step[0])
    else:
        parts = parts + MICROTESLA * step
    field = [parts[0] * np.cos(azimuth), parts[0] * np.sin(azimuth), parts[1]]
    return replace(site, earth_field_world=np.array(field))


def earth_difference(old: Site, new: Site, kind: str) -> Array:
    """Return the step that takes one Earth field to another."""
    assert old.earth_field_world is not None
    assert new.earth_field_world is not None
    (turn_old, parts_old), (turn_new, parts_new) = (
        _cylindrical(s.earth_field_world) for s in (old, new) if s.earth_field_world is not None
    )
    if kind == "declination":
        return np.array([np.angle(np.exp(1j * (turn_new - turn_old)))])
    return np.asarray((parts_new - parts_old) / MICROTESLA)


def earth_directions(field_world: Array) -> dict[str, Array]:
    """Return how the Earth field changes with each kind of step, shape (3, columns)."""
    x, y, _ = field_world
    horizontal = np.array([x, y, 0.0]) / np.hypot(x, y)
    return {
        "declination": np.array([[-y], [x], [0.0]]),
        "strength": MICROTESLA * np.column_stack([horizontal, [0.0, 0.0, 1.0]]),
    }
