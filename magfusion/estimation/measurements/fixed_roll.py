"""Constraint that fixes the unobservable roll about a single coil to an arbitrary value."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.measurement import Measurement, Rows
from magfusion.estimation.graph.state import States
from magfusion.model.one_axis import axis_of, coil_lever, least_turn
from magfusion.model.parameters import Block, Calibration
from magfusion.model.quaternion import matrices, of_matrices
from magfusion.model.site import Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

SIGMA = 1e-3  # rad; reported covariances include any roll


@dataclass(frozen=True, eq=False)
class HeldRoll(Measurement):
    """Zero rotation about an axis of the body from given attitudes."""

    axis_body: Array  # (n, 3)
    world_from_body: Array  # (n, 3, 3)

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate, one group of one."""
        turn = np.swapaxes(self.world_from_body, 1, 2) @ states.world_from_body
        about = np.sum(Rotation.from_matrix(turn).as_rotvec() * self.axis_body, axis=1)
        by_pose = np.zeros((len(turn), 1, 1, 6))
        # Linearised at the rotation about the axis, with the rest small.
        by_pose[..., :3] = self.axis_body[:, None, None] / SIGMA
        return Rows(error=about[:, None, None] / SIGMA, by_pose=by_pose)


def held_roll(site: Site, states: Trajectory) -> HeldRoll:
    """Constrain the roll of the first state to its current value."""
    first = np.zeros(1, dtype=np.int64)
    axis_body = axis_of(site.platform.magnetometer)[None]
    return HeldRoll(first, axis_body, states.world_from_body[:1])


def without_roll(states: Trajectory, site: Site, *, signed: bool = True) -> Trajectory:
    """Return states whose attitudes do not rotate about the coil from one to the next.

    The coil's position and direction are unchanged; the first state has the smallest rotation.
    `signed`: whether the sense of the coil is known. Amplitudes do not determine it: the first
    points up, and none reverses from one state to the next.
    """
    sensor = site.platform.magnetometer
    axis, lever = axis_of(sensor), coil_lever(sensor)
    towards = states.world_from_body @ axis
    if not signed:
        forth = np.sum(towards[1:] * towards[:-1], axis=1)
        sign = np.cumprod(np.where(np.append(towards[:1, 2], forth) < 0.0, -1.0, 1.0))
        towards = sign[:, None] * towards
    turns = np.empty_like(states.world_from_body)
    turns[0] = least_turn(axis, towards[0])
    for k, step in enumerate(least_turn(towards[:-1], towards[1:])):
        turns[k + 1] = step @ turns[k]
    place = states.position_world + (states.world_from_body - turns) @ lever
    whole = matrices(of_matrices(turns))  # rounding accumulates over many
    return Trajectory(**vars(states) | {"world_from_body": whole, "position_world": place})
