"""Time division: when the coils of a beacon are driven, where they are driven in turn."""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array, IntArray


@dataclass(frozen=True)
class Slots:
    """Time division: the coils of a beacon are driven in turn, slot after slot, cycle after cycle.

    Parameters
    ----------
    duration : float
        Of one slot (s).
    count : int
        Slots in a cycle; those that no coil names are silent.
    start : float
        When slot 0 of a cycle begins on the log's clock (s).
    """

    duration: float
    count: int
    start: float = 0.0

    @property
    def cycle(self) -> float:
        """Duration of a cycle (s)."""
        return self.duration * self.count

    def running(self, time: Array) -> IntArray:
        """Return the number of the slot at each time, counted on since ``start``.

        Modulo ``count`` it is the slot in its cycle; a time that rounding takes from the beginning
        of a slot belongs to that slot.
        """
        return np.floor((time - self.start) / self.duration + 1e-6).astype(np.int64)


@dataclass(frozen=True)
class MarkedSlots:
    """Time division by a clock that nobody knows beforehand: the log says when each is driven.

    A slot is then a number that its marks name (`magfusion.model.marks`), and has no length.
    """
