"""GTSAM factors of a user's on one state, as a measurement of the online estimators."""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.estimation.graph.measurement import Measurement, Rows
from magfusion.estimation.graph.state import States, values_from
from magfusion.estimation.graph.user_factors import UserFactors
from magfusion.model.parameters import Block, Calibration

WIDTHS = {X(0): 6, V(0): 3, B(0): 6}


@dataclass(frozen=True, eq=False)
class StateFactor(Measurement):
    """Factors, linearised at the state of their epoch and weighted by their own noise models."""

    factors: UserFactors  # on X(0), V(0), B(0), or some of them, and on keys of their own
    identity: int  # distinguishes factors that print the same text

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate, one group."""
        every = [self._linear(states, i) for i in range(len(states))]
        present = set(every[0].keyVector())
        keys = [key for key in WIDTHS if key in present]
        ordering = gtsam.Ordering()
        for key in keys:
            ordering.push_back(key)
        linear = [graph.jacobian(ordering) for graph in every]
        jacobian = np.array([by for by, _ in linear])[:, None]
        split = np.cumsum([WIDTHS[key] for key in keys])[:-1]
        by = dict(zip(keys, np.split(jacobian, split, axis=-1), strict=True))
        error = -np.array([right for _, right in linear])[:, None]
        return Rows(error, *(by.get(key) for key in WIDTHS))

    def _linear(self, states: States, i: int) -> gtsam.GaussianFactorGraph:
        pose = gtsam.Pose3(gtsam.Rot3(states.world_from_body[i]), states.position_world[i])
        values = values_from([pose], [states.velocity_world[i]], [states.read_bias()[i]])
        return self.factors.marginalized(values)


def state_factor(factors: UserFactors) -> StateFactor:
    """Return factors on the state of one time as a measurement."""
    now = np.zeros(1, dtype=np.int64)
    return StateFactor(now, factors.among(factors.time), id(factors))
