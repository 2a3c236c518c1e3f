"""A mean that forgets, and how many samples it is worth."""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class Running:
    """Sums with weights that fall exponentially with age.

    Parameters
    ----------
    total : ndarray
        Of the weighted samples.
    weight, squares : float
        Of the weights, and of their squares.
    time : float
        Of the last sample (s).
    """

    total: Array
    weight: float = 0.0
    squares: float = 0.0
    time: float = -np.inf

    def with_sample(
        self, value: Array, time: float, memory: float, weight: float = 1.0
    ) -> "Running":
        """Return it with another sample, the older ones forgotten over a memory (s)."""
        kept = float(np.exp(-max(0.0, time - self.time) / memory))
        return Running(
            kept * self.total + weight * value,
            kept * self.weight + weight,
            kept**2 * self.squares + weight**2,
            time,
        )

    @property
    def mean(self) -> Array:
        """Of the samples, zero where there is none."""
        return self.total / self.weight if self.weight > 0.0 else 0.0 * self.total

    @property
    def count(self) -> float:
        """Number of equal samples that would tell as much."""
        return self.weight**2 / self.squares if self.squares > 0.0 else 0.0


def nothing(size: int = 1) -> Running:
    """Return the mean of no samples yet."""
    return Running(np.zeros(size))
