"""Orientations of a sensor that is rotated by hand for its calibration: which are missing."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from magfusion.units import DEGREE, Array, BoolArray

# Towards the faces, edges and corners of a cube, shape (26, 3): at most 27 deg from any direction.
DIRECTIONS = np.array([d for d in product((1.0, 0.0, -1.0), repeat=3) if any(d)])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
FACES = np.max(np.abs(DIRECTIONS), axis=1) > 0.99
# Of a visited direction; less than the 45 deg of the estimator, which averages over a window.
NEAR = 30.0 * DEGREE


@dataclass(frozen=True, eq=False)
class TurnStatus:
    """State of a guided rotation."""

    time: float  # since the first sample (s)
    # (3,), direction of the vertical, or of the field without an IMU, in sensor axes
    now: Array | None
    visited: BoolArray  # (26,), of `DIRECTIONS`
    missing: list[str]  # sentences on the axes that were never along the vertical, or the field
    target: str  # which orientation is next; empty if all are visited
    # offset_sigma, matrix_sigma: largest sigma of the estimate, that of the matrix times the field
    # (T); None before it
    offset_sigma: float | None = None
    matrix_sigma: float | None = None
    reason: str = ""  # why there is no estimate, or why it is rejected

    @property
    def complete(self) -> bool:
        """Whether each axis pointed both ways."""
        return bool(self.visited[FACES].all())


class TurnCoverage:
    """Directions that a vector of the world had in a sensor.

    `vertical`: whether it is the vertical; else it is the magnetic field.
    """

    def __init__(self, vertical: bool) -> None:
        self.vertical = vertical
        self._ways = ("up", "down") if vertical else ("along the field", "against the field")
        self.now: Array | None = None
        self._target: int | None = None  # stays until it is visited
        self.visited: BoolArray = np.zeros(len(DIRECTIONS), dtype=bool)

    def add(self, vectors_sensor: Array) -> None:
        """Add directions in order of time, shape (n, 3), of any length."""
        if len(vectors_sensor):
            unit = vectors_sensor / np.linalg.norm(vectors_sensor, axis=1, keepdims=True)
            self.visited |= np.max(DIRECTIONS @ unit.T, axis=1) > np.cos(NEAR)
            self.now = unit[-1]
            if self._target is None or self.visited[self._target]:
                self._target = self._nearest()

    def _nearest(self) -> int | None:
        """Return the nearest direction that is missing, faces first; None if there is none."""
        missing = ~self.visited
        among = np.flatnonzero(missing & FACES if (missing & FACES).any() else missing)
        return int(among[np.argmax(DIRECTIONS[among] @ self.now)]) if len(among) else None

    @property
    def missing(self) -> list[str]:
        """Sentences on the axes that did not point both ways."""
        never = {
            axis: [
                way
                for way, towards in zip(self._ways, (1.0, -1.0), strict=True)
                if not self.visited[int(np.argmax(towards * DIRECTIONS[:, k]))]
            ]
            for k, axis in enumerate("xyz")
        }
        return [
            f"the sensor's {axis} axis never pointed {' or '.join(ways)}"
            for axis, ways in never.items()
            if ways
        ]

    @property
    def target(self) -> str:
        """The orientation to visit next; empty if none is missing."""
        if self._target is None:
            return ""
        parts = [
            f"{axis} {self._ways[int(way < 0.0)]}"
            for axis, way in zip("xyz", DIRECTIONS[self._target], strict=True)
            if way
        ]
        return parts[0] if len(parts) == 1 else "between " + " and ".join(parts)
