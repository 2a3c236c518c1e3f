"""A running mean with exponential weights, and its effective number of samples."""

from dataclasses import dataclass

import numpy as np

from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class DecayingSums:
    """Sums with weights that decrease exponentially with age."""

    total: Array  # of the weighted samples
    # weight, squares: of the weights, and of their squares
    weight: float = 0.0
    squares: float = 0.0
    time: float = -np.inf  # of the last sample (s)

    def with_sample(
        self, value: Array, time: float, memory: float, weight: float = 1.0
    ) -> "DecayingSums":
        """Return the sums with another sample; older ones decay with a time constant (s)."""
        kept = float(np.exp(-max(0.0, time - self.time) / memory))
        return DecayingSums(
            kept * self.total + weight * value,
            kept * self.weight + weight,
            kept**2 * self.squares + weight**2,
            time,
        )

    @property
    def mean(self) -> Array:
        """Mean of the samples; zero without any."""
        return self.total / self.weight if self.weight > 0.0 else 0.0 * self.total

    @property
    def count(self) -> float:
        """Effective number of samples."""
        return self.weight**2 / self.squares if self.squares > 0.0 else 0.0


def nothing(size: int = 1) -> DecayingSums:
    """Return a running mean without samples."""
    return DecayingSums(np.zeros(size))
