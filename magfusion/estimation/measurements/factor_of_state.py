"""A GTSAM factor of a user's on one state, as a measurement of the online estimators."""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from magfusion.errors import InputError
from magfusion.estimation.graph.measurement import Measurement, Rows
from magfusion.estimation.graph.state import States
from magfusion.model.parameters import Block, Calibration
from magfusion.units import Array

STATE = (X(0), V(0), B(0))


@dataclass(frozen=True, eq=False)
class StateFactor(Measurement):
    """A factor, linearised at the state of its epoch and weighted by its own noise model.

    Parameters
    ----------
    factor : gtsam.NonlinearFactor
        On X(0), V(0), B(0), or some of them.
    identity : int
        Distinguishes factors that print the same text.
    """

    factor: gtsam.NonlinearFactor
    identity: int

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate, one group."""
        every = [self._linear(states, i) for i in range(len(states))]
        keys, widths = list(self.factor.keys()), {STATE[0]: 6, STATE[1]: 3, STATE[2]: 6}
        split = np.cumsum([widths[key] for key in keys])[:-1]
        jacobian = np.array([linear.getA() for linear in every])[:, None]
        by = dict(zip(keys, np.split(jacobian, split, axis=-1), strict=True))
        error = -np.array([linear.getb() for linear in every])[:, None]
        return Rows(error, *(by.get(key) for key in STATE))

    def _linear(self, states: States, i: int) -> gtsam.JacobianFactor:
        values, bias = gtsam.Values(), states.read_bias()[i]
        rotation = gtsam.Rot3(states.world_from_body[i])
        values.insert(STATE[0], gtsam.Pose3(rotation, states.position_world[i]))
        values.insert(STATE[1], states.velocity_world[i])
        values.insert(STATE[2], gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
        return gtsam.JacobianFactor(self.factor.linearize(values))


def state_factor(factor: gtsam.NonlinearFactor, times: Array) -> StateFactor:
    """Return a factor on the state of one time as a measurement.

    Raises
    ------
    InputError
        If it is on more than that state.
    """
    keys = set(factor.keys())
    if len(times) != 1 or not keys <= set(STATE):
        named = ", ".join(sorted(gtsam.DefaultKeyFormatter(key) for key in keys))
        raise InputError(
            f"a factor online is on X(0), V(0), B(0) of one time; this is on {named} at"
            f" {len(times)} times: use magfusion.smooth(factors=...)"
        )
    return StateFactor(np.zeros(1, dtype=np.int64), factor, id(factor))
