"""Gauge directions: changes of the calibration that no measurement observes, or hardly any.

A common motion of all beacons, rotations of a beacon compensated by its drive phase, a rotation
shared by the mounting and the magnetometer's matrix: named tangent vectors of the calibration.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from magfusion.model.field import skew
from magfusion.model.parameters import (
    BEACON_POSITION,
    BEACON_ROTATION,
    CENTIMETRE,
    DEGREES,
    LOG_MOMENT,
    MATRIX,
    PERCENT,
    PHASE,
    SENSOR_ROTATION,
    Block,
    Calibration,
    Parameter,
    ParameterUnit,
    dimension,
)
from magfusion.model.site import Beacon
from magfusion.units import Array

NEARLY_NULL = 0.03  # relative change of a drive that passes for none: coils differ by percents
_AXES = "xyz"
Parts = dict[tuple[Parameter, str], Array]


class Gauge(NamedTuple):
    """A change of the calibration that changes no measurement, or hardly any."""

    name: str  # e.g. ``all beacons shifted together along x``
    remedy: str
    unit: ParameterUnit  # of the amplitude
    direction: Array  # (dimension,), tangent vector of amplitude one
    exact: bool = True  # False where gravity or acceleration may observe it


def gauges(calibration: Calibration, blocks: tuple[Block, ...]) -> list[Gauge]:
    """Return the gauge directions of the estimated parameters, the approximate ones last.

    `blocks`: estimated blocks; a gauge that would change other parameters is omitted.
    """
    beacons = calibration.site.beacons
    result = [*_shifts(beacons, blocks), *_turns(beacons, blocks, (2,))]
    result += [*_of_sensor(calibration, blocks)]
    for beacon in beacons:
        result += _of_drive(beacon, blocks)
    return result + _turns(beacons, blocks, (0, 1)) + _scale(beacons, blocks)


def frame_directions(beacons: tuple[Beacon, ...], blocks: tuple[Block, ...]) -> Array | None:
    """Return the motions of the world frame: all beacons shifted along x, y, z, and turned in yaw.

    Returns (dimension, 4), per metre and radian; None where a beacon is fixed, and the frame with
    it.
    """
    moves = [
        gauge.direction for gauge in (*_shifts(beacons, blocks), *_turns(beacons, blocks, (2,)))
    ]
    return np.stack(moves, axis=1) if len(moves) == 4 else None


def _scale(beacons: tuple[Beacon, ...], blocks: tuple[Block, ...]) -> list[Gauge]:
    """Return the scale gauge: a larger world, with moments growing with the cube."""
    parts: Parts = {}
    for b in beacons:
        parts[BEACON_POSITION, b.name] = b.position_world
        parts[LOG_MOMENT, b.name] = np.full(len(b.coils), 3.0)
    direction = _joined(blocks, parts)
    name = "common scale of all distances, with its cube that of the moments"
    remedy = "only accelerations observe it: move farther and faster, or measure a distance"
    return [] if direction is None else [Gauge(name, remedy, PERCENT, direction, False)]


def _joined(blocks: tuple[Block, ...], parts: Parts) -> Array | None:
    """Return the tangent vector of these parts; None where one is not estimated."""
    out, remaining = np.zeros(dimension(blocks)), dict(parts)
    for block in blocks:
        value = remaining.pop(block.key, None)
        if value is not None:
            out[block.columns] = value
    return None if any(np.any(value != 0.0) for value in remaining.values()) else out


def _shifts(beacons: tuple[Beacon, ...], blocks: tuple[Block, ...]) -> list[Gauge]:
    result = []
    for axis, step in zip(_AXES, np.eye(3), strict=True):
        direction = _joined(blocks, {(BEACON_POSITION, b.name): step for b in beacons})
        if direction is not None:
            name = f"all beacons shifted together along {axis}"
            remedy = "not observable from any log (gauge freedom): survey one beacon better"
            result.append(Gauge(name, remedy, CENTIMETRE, direction))
    return result


def _turns(
    beacons: tuple[Beacon, ...], blocks: tuple[Block, ...], axes: tuple[int, ...]
) -> list[Gauge]:
    result = []
    for k in axes:
        axis_world = np.eye(3)[k]
        parts: Parts = {}
        for b in beacons:
            parts[BEACON_POSITION, b.name] = np.cross(axis_world, b.position_world)
            parts[BEACON_ROTATION, b.name] = b.world_from_beacon.T @ axis_world
        direction = _joined(blocks, parts)
        if direction is None:
            continue
        if k == 2:
            name = "all beacons rotated together about the vertical"
            remedy = (
                "not observable from any log (gauge freedom): survey a bearing between two beacons"
            )
        else:
            name = f"all beacons tilted together about {_AXES[k]}"
            remedy = "gravity alone observes it; record rest in several attitudes"
        result.append(Gauge(name, remedy, DEGREES, direction, exact=k == 2))
    return result


def _of_sensor(calibration: Calibration, blocks: tuple[Block, ...]) -> Iterator[Gauge]:
    matrix = calibration.site.platform.magnetometer.matrix
    place = (MATRIX, MATRIX.owner)
    moments: Parts = {(LOG_MOMENT, b.name): np.ones(len(b.coils)) for b in calibration.site.beacons}
    direction = _joined(blocks, moments | {place: -matrix.ravel()})
    if direction is not None:
        name = "common scale of the moments, with its inverse the magnetometer's gain"
        remedy = (
            "not observable from any log (gauge freedom): measure one beacon's moment, or the gain"
        )
        yield Gauge(name, remedy, PERCENT, direction)
    for axis, step in zip(_AXES, np.eye(3), strict=True):
        rotated: Parts = {(SENSOR_ROTATION, SENSOR_ROTATION.owner): step}
        direction = _joined(blocks, rotated | {place: (matrix @ skew(step)).ravel()})
        if direction is not None:
            name = f"the mounting rotated about the sensor's {axis} and the matrix rotated back"
            remedy = "not observable from any log (gauge freedom): fix one of the two"
            yield Gauge(name, remedy, DEGREES, direction)


def _of_drive(beacon: Beacon, blocks: tuple[Block, ...]) -> list[Gauge]:
    """Return rotations of one beacon that its coils' currents compensate, as for a rotating one."""
    drive = beacon.moments_beacon.T @ beacon.excitation  # (3, tones)
    rotated = [(skew(axis) @ drive).ravel() for axis in np.eye(3)]
    shifted = [
        np.where(np.arange(len(beacon.tones)) == k, 1j * drive, 0.0).ravel()
        for k in range(0 if beacon.synchronised else len(beacon.tones))
    ]
    grown = [
        (beacon.moments_beacon[j][:, None] * beacon.excitation[j]).ravel()
        for j in range(len(beacon.coils))
    ]
    change = np.stack([*rotated, *shifted, *grown], axis=1)
    change = np.concatenate([change.real, change.imag]) / np.linalg.norm(drive)
    _, size, right = np.linalg.svd(change, full_matrices=True)
    size = np.concatenate([size, np.zeros(len(right) - len(size))])
    result = []
    for step in right[size < NEARLY_NULL]:
        turn = float(np.linalg.norm(step[:3]))
        tones = len(shifted)
        step = np.where(np.abs(step) < NEARLY_NULL, 0.0, step)
        parts: Parts = {(BEACON_ROTATION, beacon.name): step[:3]}
        if tones:
            parts[PHASE, beacon.name] = step[3 : 3 + tones]
        parts[LOG_MOMENT, beacon.name] = step[3 + tones :]
        direction = _joined(blocks, parts)
        if direction is None or turn < NEARLY_NULL:
            continue
        against = " against its drive phase" if tones else ""
        name = f"beacon {beacon.name} rotated about its own axis{against}"
        remedy = "its field does not change (gauge freedom): nothing depends on it"
        result.append(Gauge(name, remedy, DEGREES, direction / turn))
    return result
