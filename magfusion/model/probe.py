"""Bench readings of a field probe around an antenna whose coils are driven one by one."""

from dataclasses import dataclass

from magfusion.units import Array, IntArray


@dataclass(frozen=True, eq=False)
class ProbeReadings:
    """Readings of a one-axis probe; a three-axis probe gives three readings."""

    coil: IntArray  # (n,), driven coil, from 0
    position: Array  # (n, 3), of the probe, antenna axes (m)
    axis: Array  # (n, 3), measured direction, unit vectors, antenna axes
    # reading, sigma: (n,), signed amplitude, and its standard deviation (T)
    reading: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.coil)

    def rows(self, chosen: Array) -> "ProbeReadings":
        """Return a subset of the readings."""
        return ProbeReadings(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))
