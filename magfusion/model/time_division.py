"""Time division: schedules of coils that are driven in turn."""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array, IntArray


@dataclass(frozen=True)
class Slots:
    """Time division: the coils of a beacon are driven in turn, slot by slot, cycle after cycle."""

    duration: float  # of one slot (s)
    count: int  # slots in a cycle; those without a coil are silent
    start: float = 0.0  # begin of slot 0 of a cycle on the log's clock (s)

    @property
    def cycle(self) -> float:
        """Duration of a cycle (s)."""
        return self.duration * self.count

    def running(self, time: Array) -> IntArray:
        """Return the running slot number at each time since ``start``.

        Modulo ``count`` it is the slot in its cycle.  A time that rounding places before the
        beginning of a slot belongs to that slot.
        """
        return np.floor((time - self.start) / self.duration + 1e-6).astype(np.int64)


@dataclass(frozen=True)
class MarkedSlots:
    """Time division without a known schedule: the log marks when each coil is driven.

    A slot is then the number in its marks (`magfusion.model.marks`), and has no length.
    """
