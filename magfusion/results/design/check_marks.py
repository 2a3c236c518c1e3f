"""Marks and distances whose measurements prove an installation."""

from collections.abc import Mapping

import numpy as np

from magfusion.model.site import Site
from magfusion.units import Array

PER_BEACON = 4  # marks near each beacon
NEAREST = 1.0  # m from a beacon
SEPARATE = 0.8  # m between marks
NEIGHBOURS = 2  # other beacons, and marks, to which a beacon's distance is taped


def check_marks(site: Site, points_world: Array) -> dict[str, Array]:
    """Return marks, shape (3,) (m), by name: the points nearest to each beacon.

    `points_world` (n, 3): positions where the platform can be (m).
    """
    chosen: list[int] = []
    for beacon in site.beacons:
        gap = np.linalg.norm(points_world - beacon.position_world, axis=1)
        near: list[int] = []
        for k in np.argsort(gap, kind="stable").tolist():
            distances = (
                np.linalg.norm(points_world[k] - points_world[o]) for o in (*near, *chosen)
            )
            if gap[k] >= NEAREST and (k in chosen or all(d >= SEPARATE for d in distances)):
                near.append(k)
            if len(near) == PER_BEACON:
                break
        chosen += [k for k in near if k not in chosen]
    order = sorted(chosen, key=lambda k: tuple(points_world[k]))
    return {f"M{i}": points_world[k] for i, k in enumerate(order, 1)}


def check_pairs(site: Site, marks_world: Mapping[str, Array]) -> list[tuple[str, str]]:
    """Return pairs of a beacon with its nearest beacons and marks, each once."""
    beacons = {b.name: b.position_world for b in site.beacons}
    pairs: dict[frozenset[str], tuple[str, str]] = {}
    for name, place in beacons.items():
        for others in (beacons, marks_world):
            near = sorted(
                (other for other in others if other != name),
                key=lambda other: float(np.linalg.norm(others[other] - place)),
            )
            for other in near[:NEIGHBOURS]:
                pairs.setdefault(frozenset((name, other)), (name, other))
    return list(pairs.values())
