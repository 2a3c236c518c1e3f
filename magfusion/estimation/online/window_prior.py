"""The information that has left a sliding window, on the states that it still concerns."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.estimation.graph.factors import CALIBRATION_KEY, empty_factor
from magfusion.estimation.graph.kalman import partial_update
from magfusion.estimation.graph.state import MOTION, State, between
from magfusion.model.parameters import Block, dimension
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class WindowPrior:
    """``|sqrt_information @ step - right|^2``, steps from its points to the states."""

    # of the clones, then of the first node, whose step ends with the calibration's
    linearization_points: tuple[State, ...]
    sqrt_information: Array
    right: Array

    @classmethod
    def of(cls, state: State) -> "WindowPrior":
        """Return the prior of a state with its covariance."""
        sqrt_information = np.linalg.inv(np.linalg.cholesky(state.cov))
        return cls((state,), sqrt_information, np.zeros(len(sqrt_information)))

    def factor(
        self, numbers: Sequence[int], states: Sequence[State], blocks: tuple[Block, ...]
    ) -> gtsam.JacobianFactor:
        """Return the linear factor at states, under their numbers."""
        pairs = zip(self.linearization_points, states, strict=True)
        *clones, first = (between(point, state, blocks) for point, state in pairs)
        moved = np.concatenate([*(step[:MOTION] for step in clones), first])
        parts = [(key(i), size) for i in numbers for key, size in ((X, 6), (V, 3), (B, 6))]
        if blocks:
            parts.append((CALIBRATION_KEY, dimension(blocks)))
        factor, size = empty_factor(parts, len(self.right)), len(self.right)
        factor.getA()[:size] = self.sqrt_information
        factor.getb()[:size] = self.right - self.sqrt_information @ moved
        return factor

    def predicted(self, noise: Array, considered_cov: Array, share: Array | None) -> "WindowPrior":
        """Return the prior with calibration drift added and considered parameters unlearnt.

        `noise` (calibration, calibration): covariance of the drift. `considered_cov`, `share`: of
        the first node's state, as in `partial_update`.
        """
        if share is None and not np.any(noise > 0.0):
            return self
        inverse, extra = np.linalg.inv(self.sqrt_information), len(self.right) - len(considered_cov)
        if share is not None:  # the clones are estimated
            share = np.pad(share, (extra, 0), constant_values=1.0)
        before = np.pad(considered_cov, ((extra, 0), (extra, 0)))
        mean, cov = partial_update(inverse @ self.right, inverse @ inverse.T, before, share)
        drifting = slice(extra + MOTION, None)
        cov[drifting, drifting] += noise
        wide = np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))
        return replace(self, sqrt_information=wide, right=wide @ mean)


def triangular(sqrt_information: Array, right: Array) -> tuple[Array, Array]:
    """Return the same information with a square triangle."""
    whole = np.asarray(np.linalg.qr(np.column_stack([sqrt_information, right])).R)
    size = sqrt_information.shape[1]
    return whole[:size, :size], whole[:size, size]
