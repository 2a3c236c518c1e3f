"""Bench readings of a field probe around an antenna whose coils are driven one by one."""

from dataclasses import dataclass

from magfusion.units import Array, IntArray


@dataclass(frozen=True, eq=False)
class ProbeReadings:
    """Readings of a one-axis probe; a three-axis probe gives three readings.

    Parameters
    ----------
    coil : ndarray of int, shape (n,)
        Driven coil, from 0.
    position : ndarray, shape (n, 3)
        Of the probe, antenna axes (m).
    axis : ndarray, shape (n, 3)
        Measured direction, unit vectors, antenna axes.
    reading, sigma : ndarray, shape (n,)
        Signed amplitude, and its standard deviation (T).
    """

    coil: IntArray
    position: Array
    axis: Array
    reading: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.coil)

    def rows(self, chosen: Array) -> "ProbeReadings":
        """Return a subset of the readings."""
        return ProbeReadings(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))
