"""The Earth field as one more row beside the phasors of an epoch.

It has the shape of a phasor's row, so that one set of factors carries both: its three components
stand where the real parts are, and where the imaginary parts are there is nothing.
"""

import numpy as np

from magfusion.observation import EarthObservation, observe_earth
from magfusion.parameters import Block, Calibration, dimension
from magfusion.site_moves import MICROTESLA, earth_directions
from magfusion.units import Array


def _seen(calibration: Calibration, world_from_body: Array) -> tuple[EarthObservation, Array]:
    site = calibration.site
    assert site.earth_field_world is not None
    sensor = site.platform.magnetometer
    seen = observe_earth(sensor, world_from_body, site.earth_field_world)
    return seen, site.earth_field_world


def predict_earth(calibration: Calibration, world_from_body: Array) -> Array:
    """Return the row of the Earth field, shape (n, 1, 6) (T)."""
    seen, _ = _seen(calibration, world_from_body)
    return _row(seen.measured_sensor[..., None])[..., 0]


def linearize_earth(
    calibration: Calibration,
    blocks: tuple[Block, ...],
    world_from_body: Array,
    rate_body: Array,
) -> tuple[Array, Array, Array]:
    """Return the row of the Earth field with its Jacobian by pose and calibration.

    Parameters
    ----------
    calibration : Calibration
    blocks : tuple of Block
        Columns of the calibration's tangent vector.
    world_from_body : ndarray, shape (n, 3, 3)
    rate_body : ndarray, shape (n, 3)
        For the time offset (rad/s).

    Returns
    -------
    value : ndarray, shape (n, 1, 6)
        (T)
    by_pose : ndarray, shape (n, 1, 6, 6)
    by_calibration : ndarray, shape (n, 1, 6, dimension)
    """
    seen, field_world = _seen(calibration, world_from_body)
    by_pose = np.zeros((len(rate_body), 1, 6, 6))
    by_pose[..., :3] = _row(seen.platform_rotation)
    by_calibration = np.zeros((len(rate_body), 1, 6, dimension(blocks)))
    for block in blocks:
        part = _columns(block, seen, field_world, rate_body)
        if part is not None:
            by_calibration[..., block.columns] = _row(part)
    return _row(seen.measured_sensor[..., None])[..., 0], by_pose, by_calibration


def _row(part: Array) -> Array:
    """Return (n, 3, k) as the row of one channel, (n, 1, 6, k)."""
    return np.concatenate([part, np.zeros_like(part)], axis=1)[:, None]


def _columns(
    block: Block, seen: EarthObservation, field_world: Array, rate_body: Array
) -> Array | None:
    if block.group == "earth":
        return np.asarray(seen.earth_world @ earth_directions(field_world)[block.kind])
    if block.group == "magnetometer":
        return seen.matrix if block.kind == "matrix" else MICROTESLA * seen.offset
    if block.group == "extrinsics" and block.kind == "rotation":
        return seen.sensor_rotation
    if block.kind == "time_offset":
        return np.asarray(-seen.platform_rotation @ rate_body[..., None])
    return None
