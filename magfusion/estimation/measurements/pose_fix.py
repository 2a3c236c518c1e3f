"""Fixes as a measurement of the pose (loose coupling), and the error that they have in common."""

from dataclasses import dataclass

import gtsam
import numpy as np

from magfusion.estimation.graph.measurement import Loss, Measurement, Rows
from magfusion.estimation.graph.state import States
from magfusion.estimation.snapshot.problem import nuisance_blocks
from magfusion.estimation.snapshot.survey_error import survey_jacobians
from magfusion.model.noise import measurement_cov, sensor_positions, whitening
from magfusion.model.parameters import Block, Calibration
from magfusion.model.samples import FieldSamples
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array


@dataclass(frozen=True, eq=False)
class PoseFix(Measurement):
    """A pose that something else has found, one group of six.

    Parameters
    ----------
    world_from_body : ndarray, shape (n, 3, 3)
    position_world : ndarray, shape (n, 3)
        (m)
    sqrt_information : ndarray, shape (n, 6, 6)
        Whitening: rotation, then position, body axes.
    robust : {None, 'huber', 'cauchy'}
    """

    world_from_body: Array
    position_world: Array
    sqrt_information: Array
    robust: str | None = None

    @property
    def loss(self) -> Loss | None:
        """Robust loss of a whole fix."""
        return None if self.robust is None else Loss(self.robust)

    def linearize(
        self,
        states: States,
        calibration: Calibration,
        blocks: tuple[Block, ...],
    ) -> Rows:
        """Return the rows at an estimate."""
        error, by_pose = np.empty((len(states), 6)), np.empty((len(states), 6, 6))
        for i in range(len(states)):
            fix = gtsam.Pose3(gtsam.Rot3(self.world_from_body[i]), self.position_world[i])
            pose = gtsam.Pose3(gtsam.Rot3(states.world_from_body[i]), states.position_world[i])
            apart = fix.between(pose)
            error[i], by_pose[i] = gtsam.Pose3.Logmap(apart), _log_jacobian(apart)
        return Rows(
            error=(self.sqrt_information @ error[..., None])[:, None, :, 0],
            by_pose=(self.sqrt_information @ by_pose)[:, None],
        )


def _log_jacobian(pose: gtsam.Pose3) -> Array:
    return gtsam.Pose3.LogmapDerivative(pose)


def pose_fixes(fixes: Trajectory, robust: str | None = None) -> PoseFix:
    """Return fixes, one for each state, with their covariance."""
    assert fixes.pose_cov is not None
    return PoseFix(
        np.arange(len(fixes)),
        fixes.world_from_body,
        fixes.position_world,
        np.linalg.inv(np.linalg.cholesky(fixes.pose_cov)),
        robust,
    )


def survey_response(declared: Calibration, samples: FieldSamples, states: Trajectory) -> Array:
    """Return what the survey's error does to every fix alike, shape (n, 6, parameters).

    The graph takes the fixes' errors for independent, but no number of fixes averages it out.
    Columns are of one sigma each.
    """
    cov = measurement_cov(
        declared.site,
        samples,
        survey_error=True,
        sensor_world=sensor_positions(declared.site, states),
    )
    by_found, by_survey = survey_jacobians(
        declared,
        nuisance_blocks(declared.site),
        samples.time,
        states.world_from_body,
        states.position_world,
        whitening(cov, samples.there),
    )
    return (np.linalg.pinv(by_found) @ by_survey)[:, :6]
