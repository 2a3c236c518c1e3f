"""Rails and pipes of steel in the room: interacting straight bars and tubes.

They are those of `magfusion.simulation.pipe`, with segments that are short relative to the distance
of the platform and the beacons.
"""

from dataclasses import replace

import numpy as np

from magfusion.errors import InputError
from magfusion.model.site import Beacon
from magfusion.simulation.layers import Layers, layered_effect_at
from magfusion.simulation.pipe import Pipe, Steel, dipole_tensor
from magfusion.simulation.steel import SteelStructure
from magfusion.units import Array, ComplexArray

FINE = 0.5  # of the distance to the platform and to beacons: length of a segment
MAX_SEGMENT = 0.3  # m; of a segment
MIN_SEGMENTS = 40  # segments of a bar, whose poles are near its ends
NEAREST = 0.1  # m; from the surface of steel to where the body moves, and to every beacon
MAX_SEGMENTS = 1500
TOGETHER = 2_000_000  # components of tensors at once

USAGE = (
    "write radius:x,y,z:x,y,z of each in m, separated by semicolons; of a tube radius/wall,"
    " e.g. 0.05:-5,1,0:20,1,0 or 0.1/0.008:3,3,-4:3,3,4"
)


def rails_option(text: str) -> tuple[Pipe, ...]:
    """Parse ``radius[/wall]:x,y,z:x,y,z`` of each (m), separated by semicolons."""
    return tuple(_pipe(part.strip(), text) for part in text.split(";"))


def _pipe(part: str, text: str) -> Pipe:
    try:
        size, start, end = part.split(":")
        radius, *rest = (float(number) for number in size.split("/"))
        wall = rest[0] if rest else radius
        ends = np.array([[float(x) for x in point.split(",")] for point in (start, end)])
        ends = ends.reshape(2, 3)
    except ValueError:
        raise InputError(f"--rails {text!r}: {part!r} is no bar or tube; {USAGE}") from None
    if not (np.all(np.isfinite(ends)) and 0.0 < wall <= radius < 10.0 and len(rest) < 2):
        raise InputError(
            f"--rails {text!r}: {part!r} needs ends in m, and 0 < wall <= radius < 10 m; {USAGE}"
        )
    if not np.linalg.norm(ends[1] - ends[0]) > 2.0 * radius:
        raise InputError(f"--rails {text!r}: {part!r} is not longer than it is thick; {USAGE}")
    return Pipe(ends[0], ends[1], radius, wall)


def laid(pipes: tuple[Pipe, ...], box_world: Array, beacons_world: Array) -> Steel:
    """Return steel around a room, in segments that are short relative to every distance to it.

    `box_world` (2, 3): lower and upper corner (m) of the body's range. `beacons_world` (beacons, 3)
    (m). Raises InputError if steel comes closer than `NEAREST` to the box or to a beacon, or
    crosses itself.
    """
    gaps = []
    for pipe in pipes:
        along = np.linspace(pipe.start_world, pipe.end_world, 2000)
        to_box = np.linalg.norm(along - np.clip(along, *box_world), axis=1)
        to_beacon = np.linalg.norm(along[:, None] - beacons_world, axis=2)
        gaps.append(min(float(np.min(to_box)), float(np.min(to_beacon, initial=np.inf))))
    return Steel(_segmented(pipes, gaps, "the platform's range (--box) or of a beacon"))


def steel_along_wells(pipes: tuple[Pipe, ...], ways_world: list[Array]) -> tuple[Pipe, ...]:
    """Return steel near the paths (n, 3) (m) of a sensor and of a magnet, in short segments.

    Raises InputError if steel comes closer than `NEAREST` to a path, or crosses itself.
    """
    gaps, ways = [], np.concatenate(ways_world)
    for pipe in pipes:
        offset = ways - pipe.start_world
        along = np.clip(offset @ pipe.axis_world, 0.0, pipe.length)[:, None]
        gaps.append(float(np.min(np.linalg.norm(offset - along * pipe.axis_world, axis=1))))
    return _segmented(pipes, gaps, "the path of the sensor or of the magnet")


def _segmented(pipes: tuple[Pipe, ...], gaps: list[float], what: str) -> tuple[Pipe, ...]:
    """Return pipes in segments that are short relative to their axes' distances from something."""
    whole = []
    for number, (pipe, gap) in enumerate(zip(pipes, gaps, strict=True), 1):
        away = gap - pipe.radius
        if away < NEAREST:
            raise InputError(
                f"--rails: number {number} comes within {max(away, 0.0):.2g} m of {what}; keep a"
                f" distance of {NEAREST:g} m"
            )
        segment = min(max(FINE * away, 0.05), MAX_SEGMENT, pipe.length / MIN_SEGMENTS)
        whole.append(replace(pipe, segment=segment))
    count = sum(len(pipe.centres_world()) for pipe in whole)
    if count > MAX_SEGMENTS:
        raise InputError(
            f"--rails: {count} segments are too many (at most {MAX_SEGMENTS}); use shorter rails,"
            " or place them farther from the platform"
        )
    _check_apart(whole)
    return tuple(whole)


def _check_apart(pipes: list[Pipe]) -> None:
    for first, pipe in enumerate(pipes):
        for second in range(first):
            other = pipes[second]
            own, others = (np.linspace(p.start_world, p.end_world, 400) for p in (pipe, other))
            away = float(np.min(np.linalg.norm(own[:, None] - others, axis=2)))
            if away < pipe.radius + other.radius + 0.5 * min(pipe.segment, other.segment):
                raise InputError(
                    f"--rails: numbers {second + 1} and {first + 1} come within {away:.2g} m of"
                    " each other; touching parts are one piece; omit one, or increase the distance"
                )


def secondary_world(
    steel: Steel | SteelStructure,
    at_segments_world: ComplexArray,
    frequencies_hz: Array,
    point_world: Array,
) -> ComplexArray:
    """Return the phasors of steel at points.

    `at_segments_world` (segments, tones, 3): without steel at `Steel.points_world` (T).
    `frequencies_hz` (tones,), `point_world` (n, 3) (m). Returns (n, tones, 3) (T).
    """
    moments = np.stack(
        [
            steel.moments(at_segments_world[:, [k]], float(frequency_hz))[:, 0]
            for k, frequency_hz in enumerate(frequencies_hz)
        ],
        axis=1,
    )
    flat = np.swapaxes(moments, 1, 2).reshape(-1, len(frequencies_hz))  # (segments 3, tones)
    out = np.empty((len(point_world), len(frequencies_hz), 3), dtype=np.complex128)
    centres, rows = steel.points_world(), max(TOGETHER // (9 * len(moments)), 1)
    for first in range(0, len(point_world), rows):
        part = slice(first, first + rows)
        tensor = dipole_tensor(point_world[part][:, None] - centres)
        by_moment = np.swapaxes(tensor, 1, 2).reshape(-1, len(flat))
        result = (by_moment @ flat.real + 1j * (by_moment @ flat.imag)).reshape(
            -1, 3, flat.shape[1]
        )
        out[part] = np.swapaxes(result, 1, 2)
    return out


def layered_at(steel: Steel | SteelStructure, beacon: Beacon, layers: Layers) -> ComplexArray:
    """Return the contribution of layered ground at the segments, (n, coils, 3) (T).

    Segments may lie in any layer and at any distance: each is computed directly, by height.
    """
    point_world = steel.points_world()
    added = np.zeros((len(point_world), len(beacon.coils), 3), dtype=np.complex128)
    heights, level = np.unique(np.round(point_world[:, 2], 6), return_inverse=True)
    for j, coil in enumerate(beacon.coils):
        source = (
            beacon.position_world + beacon.world_from_beacon @ coil.centre_beacon,
            beacon.world_from_beacon @ coil.moment_beacon,
            coil.frequency_hz or beacon.frequency_hz,
        )
        for k in range(len(heights)):
            own = level == k
            added[own, j] = layered_effect_at(*source, point_world[own], layers)
    return added


def magnetised_world(
    steel: Steel | SteelStructure, earth_field_world: Array, point_world: Array
) -> Array:
    """Return the field of steel magnetised by the Earth's field (T) at points (n, 3) (T)."""
    even = np.broadcast_to(earth_field_world, (len(steel.points_world()), 1, 3))
    return np.real(secondary_world(steel, even.astype(complex), np.zeros(1), point_world)[:, 0])
