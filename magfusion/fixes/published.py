"""The three algorithms of paper 004, from a survey and the fields of an epoch to its pose.

They are what this package is compared with.  Positions are those of `magfusion.fixes.rssi` and
`magfusion.fixes.fingerprint`; the attitude is that of Eq 18-19 by the nearest rotation, which holds
for a level platform among beacons that turn about the vertical, and for no other: one degree of
tilt at half a metre above the beacons makes two to three degrees of error
(`scenarios/tilted_attitude.py`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from magfusion.fixes.direction import attitude_from_vectors, direction_from_normal
from magfusion.fixes.fingerprint import (
    NEIGHBOURS,
    FingerprintDatabase,
    locate_by_differential_range,
    locate_by_neighbours,
    nearest,
)
from magfusion.fixes.rssi import (
    BlockLines,
    RssiLines,
    distances,
    fit_block_lines,
    fit_lines,
    ranges_from_lines,
    trilaterate_from_both_sides,
)
from magfusion.units import Array, IntArray

Method = Literal["paper-lines", "paper-knn", "paper-knn-nt", "paper-fingerprint"]
LEAST_BEACONS = 3  # a position has three coordinates
BLOCK_PASSES = 3  # between position and the block that it lies in

TOO_FEW_BEACONS = "fewer than three beacons heard"
TOO_FEW_POINTS = "too few fingerprints of the beacons heard"


@dataclass(frozen=True, eq=False)
class RotatingFields:
    """What the published algorithms take from each epoch.

    Parameters
    ----------
    axis_world : ndarray, shape (beacons, 3)
        Unit vectors about which the beacons' moments turn by the right-hand rule.
    amplitude : ndarray, shape (n, beacons)
        Root mean square over time (T); NaN where a beacon was not heard.
    normal_body : ndarray, shape (n, beacons, 3)
        Normal of the plane in which the field turns, of any length, body axes.
    """

    axis_world: Array
    amplitude: Array
    normal_body: Array


@dataclass(frozen=True, eq=False)
class PublishedFixes:
    """Poses of the epochs that could be located.

    Parameters
    ----------
    epoch : ndarray of int, shape (m,)
        Which of the epochs they are.
    position_world : ndarray, shape (m, 3)
        Of the sensor (m).
    world_from_body : ndarray, shape (m, 3, 3)
    dropped : mapping
        Reason to number of epochs.
    """

    epoch: IntArray
    position_world: Array
    world_from_body: Array
    dropped: Mapping[str, int]


def fix_as_published(
    database: FingerprintDatabase,
    fields: RotatingFields,
    method: Method,
    block: float | None = None,
) -> PublishedFixes:
    """Locate each epoch by one of the published algorithms, from the beacons that it hears.

    Parameters
    ----------
    database : FingerprintDatabase
    fields : RotatingFields
        Of the database's beacons.
    method : {"paper-lines", "paper-knn", "paper-knn-nt", "paper-fingerprint"}
        Algorithm 1; 2, in logarithms or as printed in nT; 3.
    block : float, optional
        Size of the blocks of algorithm 1 (m); one line for all where it is not given.

    Raises
    ------
    EstimationError
        Where a trilateration does not converge.
    """
    heard = np.isfinite(fields.amplitude)
    enough = np.sum(heard, axis=1) >= LEAST_BEACONS
    dropped = {TOO_FEW_BEACONS: int(np.sum(~enough)), TOO_FEW_POINTS: 0}
    position = np.full((len(heard), 3), np.nan)
    for pattern in np.unique(heard[enough], axis=0):
        rows, columns = np.flatnonzero(np.all(heard == pattern, axis=1)), np.flatnonzero(pattern)
        known = database.hearing(columns)
        if len(known) < NEIGHBOURS:
            dropped[TOO_FEW_POINTS] += len(rows)
            continue
        position[rows] = _located(known, fields.amplitude[np.ix_(rows, columns)], method, block)
    epoch = np.flatnonzero(np.isfinite(position[:, 0]))
    attitude = attitude_as_published(
        fields.normal_body[epoch], position[epoch], database.beacons_world, fields.axis_world
    )
    return PublishedFixes(
        epoch, position[epoch], attitude, {why: count for why, count in dropped.items() if count}
    )


def _located(
    known: FingerprintDatabase, amplitude: Array, method: Method, block: float | None
) -> Array:
    if method == "paper-fingerprint":
        return locate_by_differential_range(known, amplitude)
    if method != "paper-lines":
        return locate_by_neighbours(known, amplitude, logarithmic=method == "paper-knn")
    place, beacons = known.position_world, known.beacons_world
    if block is None:
        return locate_by_lines(
            known, amplitude, fit_lines(distances(place, beacons), known.amplitude)
        )
    return locate_by_lines(
        known, amplitude, fit_block_lines(place, beacons, known.amplitude, block)
    )


def locate_by_lines(
    known: FingerprintDatabase, amplitude: Array, lines: RssiLines | BlockLines
) -> Array:
    """Return the positions of algorithm 1: ranges from lines, then trilateration.

    Started where the fingerprints are most alike, which also tells the side of the beacons' plane
    and the first block.

    Parameters
    ----------
    known : FingerprintDatabase
        Complete.
    amplitude : ndarray, shape (n, beacons)
        (T)
    lines : RssiLines or BlockLines

    Returns
    -------
    ndarray, shape (n, 3)
        Of the sensor (m).

    Raises
    ------
    EstimationError
        Where the trilateration does not converge.
    """
    _, point = nearest(known, amplitude, NEIGHBOURS)
    position = np.asarray(np.mean(known.position_world[point], axis=1))
    for _ in range(BLOCK_PASSES if isinstance(lines, BlockLines) else 1):
        here = lines.at(position) if isinstance(lines, BlockLines) else lines
        ranges = ranges_from_lines(here, amplitude)
        position = trilaterate_from_both_sides(ranges, known.beacons_world, position)
    return position


def attitude_as_published(
    normal_body: Array, position_world: Array, beacons_world: Array, axis_world: Array
) -> Array:
    """Return the rotation nearest to Eq 18, from pseudo-directions to directions.

    Eq 7 takes the normal in the body's axes for one in the beacon's and returns a direction in the
    half-space of the axis; the found position tells when it is the other.

    Parameters
    ----------
    normal_body : ndarray, shape (n, beacons, 3)
        NaN where a beacon was not heard.
    position_world : ndarray, shape (n, 3)
        Of the sensor (m).
    beacons_world, axis_world : ndarray, shape (beacons, 3)
        Centres (m), and unit vectors about which the moments turn.

    Returns
    -------
    ndarray, shape (n, 3, 3)
        world_from_body.
    """
    offset = position_world[:, None] - beacons_world
    direction = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    along = np.sum(normal_body * axis_world, axis=-1, keepdims=True)
    flat = normal_body - along * axis_world
    size = np.linalg.norm(flat, axis=-1, keepdims=True)
    azimuth = np.divide(flat, size, out=np.zeros_like(flat), where=size > 0.0)
    # About its axis a rotating beacon looks the same: its x axis may point at the sensor.
    local = direction_from_normal(np.concatenate([size, np.zeros_like(size), along], axis=-1))
    pseudo = local[..., :1] * azimuth + local[..., 2:] * axis_world
    below = np.sum(direction * axis_world, axis=-1, keepdims=True) < 0.0
    heard = np.isfinite(normal_body).all(axis=-1, keepdims=True)
    pseudo = np.where(heard, np.where(below, -pseudo, pseudo), 0.0)
    return attitude_from_vectors(pseudo, direction)
