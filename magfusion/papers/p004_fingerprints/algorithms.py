"""The three algorithms of paper 004, from a survey and the fields of an epoch to its pose.

They serve for comparison.  Positions are those of `magfusion.papers.p004_fingerprints.rssi` and
`magfusion.papers.p004_fingerprints.fingerprint`; the attitude is that of Eq 18-19 by the nearest
rotation, which is valid only for a level platform among beacons that rotate about the vertical: one
degree of tilt at half a metre above the beacons gives two to three degrees of error
(`scenarios/tilted_attitude.py`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from magfusion.papers.p004_fingerprints.equations import (
    distances,
    eq_07_direction,
    eq_19_direction,
    eq_21_attitude,
)
from magfusion.papers.p004_fingerprints.fingerprint import (
    NEIGHBOURS,
    FingerprintDatabase,
    locate_by_differential_range,
    locate_by_neighbours,
    nearest,
)
from magfusion.papers.p004_fingerprints.rssi import (
    BlockLines,
    RssiLines,
    fit_block_lines,
    fit_lines,
    ranges_from_lines,
    trilaterate_from_both_sides,
)
from magfusion.units import Array, IntArray

Method = Literal["paper-lines", "paper-knn", "paper-knn-nt", "paper-fingerprint"]
MIN_BEACONS = 3  # a position has three coordinates
BLOCK_ITERATIONS = 3  # between position and the block that it lies in

TOO_FEW_BEACONS = "fewer than three beacons detected"
TOO_FEW_POINTS = "too few fingerprints of the detected beacons"


@dataclass(frozen=True, eq=False)
class RotatingFields:
    """Inputs of the published algorithms for each epoch."""

    # (beacons, 3), unit vectors about which the beacons' moments rotate by the right-hand rule
    axis_world: Array
    # (n, beacons), root mean square over time (T); NaN where a beacon was not detected
    amplitude: Array
    # (n, beacons, 3), normal of the plane in which the field rotates, of any length, body axes
    normal_body: Array


@dataclass(frozen=True, eq=False)
class PublishedFixes:
    """Poses of the located epochs."""

    epoch: IntArray  # (m,), their indices
    position_world: Array  # (m, 3), of the sensor (m)
    world_from_body: Array  # (m, 3, 3)
    dropped: Mapping[str, int]  # reason to number of epochs


def fix_as_published(
    database: FingerprintDatabase,
    fields: RotatingFields,
    method: Method,
    block: float | None = None,
) -> PublishedFixes:
    """Locate each epoch by one of the published algorithms, from the detected beacons.

    `fields`: of the database's beacons. `method`: algorithm 1; 2, in logarithms or as printed in
    nT; 3. `block`: size of the blocks of algorithm 1 (m); by default one line for all. Raises
    EstimationError where a trilateration does not converge.
    """
    detected = np.isfinite(fields.amplitude)
    enough = np.sum(detected, axis=1) >= MIN_BEACONS
    dropped = {TOO_FEW_BEACONS: int(np.sum(~enough)), TOO_FEW_POINTS: 0}
    position = np.full((len(detected), 3), np.nan)
    for pattern in np.unique(detected[enough], axis=0):
        rows, columns = np.flatnonzero(np.all(detected == pattern, axis=1)), np.flatnonzero(pattern)
        known = database.detecting(columns)
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
    lines: RssiLines | BlockLines
    if block is None:
        lines = fit_lines(distances(place, beacons), known.amplitude)
    else:
        lines = fit_block_lines(place, beacons, known.amplitude, block)
    return locate_by_lines(known, amplitude, lines)


def locate_by_lines(
    known: FingerprintDatabase, amplitude: Array, lines: RssiLines | BlockLines
) -> Array:
    """Return the positions (n, 3) of the sensor (m) by algorithm 1: ranges, then trilateration.

    The start is the most similar fingerprints, which also give the side of the beacons' plane and
    the first block.
    """
    _, point = nearest(known, amplitude, NEIGHBOURS)
    position = np.mean(known.position_world[point], axis=1)
    for _ in range(BLOCK_ITERATIONS if isinstance(lines, BlockLines) else 1):
        here = lines.at(position) if isinstance(lines, BlockLines) else lines
        ranges = ranges_from_lines(here, amplitude)
        position = trilaterate_from_both_sides(ranges, known.beacons_world, position)
    return position


def attitude_as_published(
    normal_body: Array, position_world: Array, beacons_world: Array, axis_world: Array
) -> Array:
    """Return world_from_body (n, 3, 3), the rotation nearest to Eq 18.

    Eq 7 treats the normal in body axes, NaN where a beacon was not detected, as one in beacon axes
    and returns a direction in the half-space of its axis; the position of the sensor determines
    where the opposite applies.  Arguments as in `RotatingFields`.
    """
    direction = eq_19_direction(position_world, beacons_world)
    # A rotating beacon is symmetric about its axis: any axes across it do.
    across = np.linalg.svd(axis_world[:, None])[2][:, 1:]
    beacon_from_world = np.concatenate([across, axis_world[:, None]], axis=1)
    normal_beacon = np.einsum("bij,nbj->nbi", beacon_from_world, normal_body)
    pseudo = np.einsum("bij,nbi->nbj", beacon_from_world, eq_07_direction(normal_beacon))
    below = np.sum(direction * axis_world, axis=-1, keepdims=True) < 0.0
    detected = np.isfinite(normal_body).all(axis=-1, keepdims=True)
    pseudo = np.where(detected, np.where(below, -pseudo, pseudo), 0.0)
    return eq_21_attitude(pseudo, direction)
