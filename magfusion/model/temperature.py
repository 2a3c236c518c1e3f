"""Temperatures of coils and of the magnetometer, and what changes with them.

A reading holds for its time; in between it is linear, and beyond the first and the last it is held.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from magfusion.units import Array

MAGNETOMETER = "magnetometer"  # the part of that name; all others are beacons
REMEMBERED = 1000  # readings of each part that a running estimator keeps


@dataclass(frozen=True)
class Warming:
    """How the moments of a beacon's coils change with their temperature.

    Parameters
    ----------
    log_moment_per_k : float
        Of the logarithm of all its moments (1/K).
    reference_degc : float
        Temperature for which they are declared (degrees Celsius).
    """

    log_moment_per_k: float
    reference_degc: float = 20.0


@dataclass(frozen=True, eq=False)
class SensorWarming:
    """How a magnetometer's matrix and offset change with its temperature.

    Parameters
    ----------
    matrix_per_k : ndarray, shape (3, 3)
        (1/K)
    offset_per_k : ndarray, shape (3,)
        (T/K)
    reference_degc : float
        Temperature for which both are declared (degrees Celsius).
    """

    matrix_per_k: Array
    offset_per_k: Array
    reference_degc: float = 20.0

    def to_reference(self, matrix: Array, degc: Array) -> tuple[Array, Array]:
        """Return what turns samples into those of the reference temperature, and their offset.

        Parameters
        ----------
        matrix : ndarray, shape (3, 3)
            Of the magnetometer.
        degc : ndarray, shape (n,)

        Returns
        -------
        ndarray, shape (n, 3, 3)
            To be applied to what a sample is beyond its offset.
        ndarray, shape (n, 3)
            By how much the offset is larger (T).
        """
        warmer = np.asarray(degc) - self.reference_degc
        grown = np.eye(3) + warmer[:, None, None] * (self.matrix_per_k @ np.linalg.inv(matrix))
        return np.asarray(np.linalg.inv(grown)), warmer[:, None] * self.offset_per_k


class Temperatures:
    """Readings of several parts, whole or as they come.

    Parameters
    ----------
    readings : mapping of str to ndarray, optional
        Of each part, shape (2, n): times, increasing (s), and temperatures (degrees Celsius).
    """

    readings: dict[str, Array]  # what a checkpoint holds

    def __init__(self, readings: Mapping[str, Array] | None = None) -> None:
        self.readings = {} if readings is None else dict(readings)

    def hear(self, part: str, time: float, degc: float) -> None:
        """Take a reading; one that is older than the last is passed over."""
        known = self.readings.get(part, np.zeros((2, 0)))
        if known.shape[1] == 0 or time > known[0, -1]:
            self.readings[part] = np.column_stack([known[:, -REMEMBERED:], [time, degc]])

    def at(self, part: str, time: Array) -> Array | None:
        """Return temperatures of a part at some times, of their shape; None without a reading."""
        known = self.readings.get(part)
        return None if known is None else np.asarray(np.interp(time, *known))

    def each(self) -> Iterator[tuple[float, str, float]]:
        """Yield time (s), part and temperature of every reading, part by part."""
        for part, (time, degc) in self.readings.items():
            yield from zip(time.tolist(), repeat(part), degc.tolist())

    def without(self, part: str) -> "Temperatures":
        """Return those of all other parts."""
        return Temperatures({k: v for k, v in self.readings.items() if k != part})
