"""Acceleration of passes that oscillate about their fixed point."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.posterior.convergence import (
    OFFSET_CONVERGED,
    POSITION_CONVERGED,
    pose_steps,
)
from magfusion.model.parameters import Block, Calibration, difference, retract
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array

MIN_COUNT = 0.2  # minimum share of a step


@dataclass(frozen=True, eq=False)
class Step:
    """Change by a pass, and the share of it that was applied."""

    moved: Array  # in units of the convergence limits
    share: float

    @staticmethod
    def of(
        last: "Step | None",
        before: Trajectory,
        after: Trajectory,
        old: Calibration,
        new: Calibration,
    ) -> "Step":
        """Return the step of a pass, shortened where it reverses the one before.

        Demodulation about a trajectory depends on it in ways that no Jacobian of the pass contains.
        Where each pass therefore overshoots the fixed point, the secant through the last two steps
        locates it (Aitken's relaxation; Küttler and Wall, Comput. Mech. 43, 2008, Eq 44).
        """
        ends = after.time[[0, -1]]
        shifted = (new.imu_offset(ends) - old.imu_offset(ends)) / OFFSET_CONVERGED
        by_place = (after.position_world - before.position_world) / POSITION_CONVERGED
        moved = np.concatenate([shifted, by_place.ravel() / np.sqrt(len(after.time))])
        if last is None or moved @ last.moved >= 0.0:
            return Step(moved, 1.0)
        change = moved - last.moved
        share = -last.share * float(last.moved @ change) / float(change @ change)
        return Step(moved, float(np.clip(share, MIN_COUNT, 1.0)))


def part_of_the_way(
    before: Trajectory,
    after: Trajectory,
    old: Calibration,
    new: Calibration,
    blocks: tuple[Block, ...],
    share: float,
) -> tuple[Trajectory, Calibration]:
    """Return states and a calibration at a share of the way between two."""
    if share == 1.0:
        return after, new
    step = share * pose_steps(before, after)
    turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
    moved = before.world_from_body @ step[:, 3:, None]

    def mixed(a: Array | None, b: Array | None) -> Array | None:
        return b if a is None or b is None else a + share * (b - a)

    states = replace(
        after,
        world_from_body=before.world_from_body @ turn,
        position_world=before.position_world + moved[..., 0],
        velocity_world=mixed(before.velocity_world, after.velocity_world),
        gyro_bias_body=mixed(before.gyro_bias_body, after.gyro_bias_body),
        accel_bias_body=mixed(before.accel_bias_body, after.accel_bias_body),
    )
    back = (share - 1.0) * difference(old, new, blocks)
    return states, retract(new, blocks, back)
