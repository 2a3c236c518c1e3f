"""Fixes as a measurement of the pose (loose coupling)."""

from dataclasses import dataclass

import gtsam
import numpy as np

from magfusion.estimation.graph.measurement import Loss, Measurement, Rows
from magfusion.estimation.graph.state import States
from magfusion.model.parameters import Block, Calibration
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class PoseFix(Measurement):
    """A pose from another estimator, one group of six."""

    world_from_body: Array  # (n, 3, 3)
    position_world: Array  # (n, 3) (m)
    sqrt_information: Array  # (n, 6, 6), whitening: rotation, then position, body axes
    robust: str | None = None  # 'huber' or 'cauchy'

    @property
    def loss(self) -> Loss | None:
        """Robust loss of a whole fix."""
        return None if self.robust is None else Loss(self.robust)

    def linearize(
        self, states: States, calibration: Calibration, blocks: tuple[Block, ...]
    ) -> Rows:
        """Return the rows at an estimate."""
        error, by_pose = np.empty((len(states), 6)), np.empty((len(states), 6, 6))
        for i in range(len(states)):
            fix = gtsam.Pose3(gtsam.Rot3(self.world_from_body[i]), self.position_world[i])
            pose = gtsam.Pose3(gtsam.Rot3(states.world_from_body[i]), states.position_world[i])
            separate = fix.between(pose)
            error[i] = gtsam.Pose3.Logmap(separate)
            by_pose[i] = gtsam.Pose3.LogmapDerivative(separate)
        return Rows(
            error=(self.sqrt_information @ error[..., None])[:, None, :, 0],
            by_pose=(self.sqrt_information @ by_pose)[:, None],
        )


def pose_fixes(fixes: Trajectory, robust: str | None = None) -> PoseFix:
    """Return fixes, one for each state, with their covariance, as a measurement."""
    assert fixes.pose_cov is not None
    return PoseFix(
        np.arange(len(fixes)),
        fixes.world_from_body,
        fixes.position_world,
        np.linalg.inv(np.linalg.cholesky(fixes.pose_cov)),
        robust,
    )
