"""Temperatures of coils and of the magnetometer, and their effects.

Readings are interpolated linearly, and constant before the first and after the last.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from magfusion.model.drive import MAX_READINGS
from magfusion.units import Array

MAGNETOMETER = "magnetometer"  # name of that part; all others are beacons


@dataclass(frozen=True)
class MomentTemperatureModel:
    """Temperature dependence of the moments of a beacon's coils."""

    log_moment_per_k: float  # of the logarithm of all its moments (1/K)
    reference_degc: float = 20.0  # temperature for which they are declared (degrees Celsius)


@dataclass(frozen=True, eq=False)
class SensorTemperatureModel:
    """Temperature dependence of a magnetometer's matrix and offset."""

    matrix_per_k: Array  # (3, 3) (1/K)
    offset_per_k: Array  # (3,) (T/K)
    reference_degc: float = 20.0  # temperature for which both are declared (degrees Celsius)

    def to_reference(self, matrix: Array, degc: Array) -> tuple[Array, Array]:
        """Return the matrix that corrects samples to the reference temperature, and their offset.

        `matrix` (3, 3): of the magnetometer. `degc` (n,). Returns (n, 3, 3): applied to samples
        after subtraction of the offset; (n, 3): increase of the offset (T).
        """
        warmer = np.asarray(degc) - self.reference_degc
        grown = np.eye(3) + warmer[:, None, None] * (self.matrix_per_k @ np.linalg.inv(matrix))
        return np.asarray(np.linalg.inv(grown)), warmer[:, None] * self.offset_per_k


class Temperatures:
    """Readings of several parts, complete or streamed.

    `readings`: of each part, shape (2, n): times, increasing (s), and temperatures (degrees
    Celsius).
    """

    readings: dict[str, Array]  # part of a checkpoint

    def __init__(self, readings: Mapping[str, Array] | None = None) -> None:
        self.readings = {} if readings is None else dict(readings)

    def add_reading(self, part: str, time: float, degc: float) -> None:
        """Add a reading; one older than the last is ignored."""
        known = self.readings.get(part, np.zeros((2, 0)))
        if known.shape[1] == 0 or time > known[0, -1]:
            self.readings[part] = np.column_stack([known[:, -MAX_READINGS:], [time, degc]])

    def at(self, part: str, time: Array) -> Array | None:
        """Return temperatures of a part at times, same shape; None without a reading."""
        known = self.readings.get(part)
        return None if known is None else np.asarray(np.interp(time, *known))

    def each(self) -> Iterator[tuple[float, str, float]]:
        """Yield time (s), part and temperature of every reading, part by part."""
        for part, (time, degc) in self.readings.items():
            yield from zip(time.tolist(), repeat(part), degc.tolist())

    def without(self, part: str) -> "Temperatures":
        """Return the readings of all other parts."""
        return Temperatures({k: v for k, v in self.readings.items() if k != part})
