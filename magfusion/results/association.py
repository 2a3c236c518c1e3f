"""Estimated and true poses at the same times: the finer one is interpolated."""

from dataclasses import dataclass, replace

import numpy as np

from magfusion.model.trajectory import Trajectory, interpolated
from magfusion.model.truth_poses import in_short_steps, truth_poses
from magfusion.units import Array, BoolArray


@dataclass(frozen=True, eq=False)
class AssociatedPoses:
    """Estimate and truth at the same n times."""

    estimate: Trajectory
    truth: Trajectory
    compared: BoolArray  # which epochs of the estimate were compared, or which samples of the truth
    not_covered: str = ""  # why others were not; empty where all were
    # whether the times are those of the truth, which is coarser than the estimate
    at_truth: bool = False

    def first(self, count: int | None) -> "AssociatedPoses":
        """Return the first pairs; all without a number."""
        chosen = np.arange(len(self.truth)) < (len(self.truth) if count is None else count)
        own, true = select_poses(self.estimate, chosen), select_poses(self.truth, chosen)
        return replace(self, estimate=own, truth=true)


def associate(
    estimate: Trajectory, truth: Trajectory, *, any_motion: bool = False
) -> AssociatedPoses:
    """Return the truth at the estimate's epochs, wherever its motion allows that.

    Where it does not, and the truth is the coarser of both, the estimate at the truth's samples.
    Neither is interpolated across its gaps. `any_motion` as of `truth_poses`.
    """
    true, covered, reason = truth_poses(truth, estimate.time, any_motion=any_motion)
    if _coarser(truth, estimate) and np.any(~covered & in_short_steps(truth, estimate.time)):
        within = (truth.time >= estimate.time[0]) & (truth.time <= estimate.time[-1])
        coarse = select_poses(truth, within)
        own, compared, reason = truth_poses(estimate, coarse.time)
        own = Trajectory(
            own.time,
            own.world_from_body,
            own.position_world,
            pose_cov=_interpolated_cov(estimate, own.time),
        )
        return AssociatedPoses(own, select_poses(coarse, compared), compared, reason, at_truth=True)
    return AssociatedPoses(select_poses(estimate, covered), true, covered, reason)


def _coarser(one: Trajectory, other: Trajectory) -> bool:
    if min(len(one), len(other)) < 2:
        return False
    return bool(np.median(np.diff(one.time)) > np.median(np.diff(other.time)))


def select_poses(poses: Trajectory, rows: BoolArray) -> Trajectory:
    """Return some of the poses, with their covariances."""
    cov = None if poses.pose_cov is None else poses.pose_cov[rows]
    parts = poses.time[rows], poses.world_from_body[rows], poses.position_world[rows]
    return Trajectory(*parts, pose_cov=cov)


def _interpolated_cov(estimate: Trajectory, time: Array) -> Array | None:
    if estimate.pose_cov is None:
        return None
    flat = estimate.pose_cov.reshape(len(estimate), 36)
    return interpolated(time, estimate.time, flat).reshape(-1, 6, 6)
