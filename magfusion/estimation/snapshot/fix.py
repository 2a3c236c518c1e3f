"""Fix results: for each epoch the poses that explain it, best first; and the gravity input."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from magfusion.model.short_repr import short_repr
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, BoolArray, IntArray

AS_LIKELY = 20.0  # difference of chi square to the best hypothesis


class Gravity(NamedTuple):
    """Direction of the specific force, if the platform is at rest or nearly so."""

    up_body: Array  # (n, 3), unit vectors
    sigma: Array  # (n,) (rad); infinite if it is not available

    def rows(self, chosen: IntArray | BoolArray | slice) -> "Gravity":
        """Return it at selected epochs, possibly repeated."""
        return Gravity(self.up_body[chosen], self.sigma[chosen])


@dataclass(frozen=True, eq=False)
class Fixes:
    """Hypotheses of the pose at each epoch in order of their posterior."""

    __repr__ = short_repr

    time: Array  # (n,) (s)
    world_from_body: Array  # (n, hypotheses, 3, 3)
    position_world: Array  # (n, hypotheses, 3) (m)
    pose_cov: Array  # (n, hypotheses, 6, 6), rotation, then position; body axes (rad^2, m^2)
    # (n, hypotheses), squared residual in units of its sigma, plus that of the prior; infinite
    # where a row has fewer hypotheses
    cost: Array
    # (n, hypotheses), root mean square of the whitened residual; about one where noise and model
    # are as declared
    residual_rms: Array
    phase: Array  # (n, hypotheses, channels), drive phase (rad); zero if it was not estimated
    # (n, hypotheses), False if the epoch does not determine a direction of the pose
    determined: BoolArray
    # (n, hypotheses, channels), logarithm of each channel's gain; zero if it was not estimated
    log_gain: Array
    # gravity_cost, prior_cost: (n, hypotheses), contributions of gravity and the prior pose to the
    # cost; zero without them
    gravity_cost: Array
    prior_cost: Array

    def __len__(self) -> int:
        return len(self.time)

    @property
    def probability(self) -> Array:
        """Posterior share of each hypothesis, shape (n, hypotheses)."""
        relative = np.exp(-0.5 * (self.cost - self.cost[:, :1]))
        return relative / np.sum(relative, axis=1, keepdims=True)

    def padded(self, count: int) -> "Fixes":
        """Pad the hypotheses of each epoch to a count, by the best with infinite cost."""
        own = self.cost.shape[1]
        if own >= count:
            return self
        chosen = np.concatenate([np.arange(own), np.zeros(count - own, dtype=np.int64)])
        parts = {n: v if v.ndim == 1 else v[:, chosen] for n, v in vars(self).items()}
        parts["cost"][:, own:] = np.inf
        return Fixes(**parts)

    def rows(self, chosen: IntArray | BoolArray | slice) -> "Fixes":
        """Return the fixes of some epochs."""
        return Fixes(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def best(self) -> Trajectory:
        """Return the first hypothesis of every epoch."""
        return Trajectory(
            time=self.time,
            world_from_body=self.world_from_body[:, 0],
            position_world=self.position_world[:, 0],
            pose_cov=self.pose_cov[:, 0],
        )
