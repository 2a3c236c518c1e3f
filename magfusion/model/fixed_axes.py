"""Pose covariances in world axes, as robots exchange them."""

import numpy as np

from magfusion.units import Array


def fixed_axes_covariance(world_from_body: Array, pose_cov: Array) -> Array:
    """Return covariances by the ROS and MAVLink convention: position, rotation, world axes.

    Here, a covariance is of a right perturbation: rotation, then translation, both in body axes.
    That of ``geometry_msgs/PoseWithCovariance`` is of x, y, z and of rotations about the X, Y and Z
    axes of the header's frame, which do not move the position.  To first order both parts rotate to
    the world: ``d_position_world = R d_position_body`` and ``R exp(d) = exp(R d) R``.
    `world_from_body` (..., 3, 3), `pose_cov` (..., 6, 6). Returns (..., 6, 6).
    """
    jacobian = np.zeros_like(pose_cov)
    jacobian[..., :3, 3:] = jacobian[..., 3:, :3] = world_from_body
    cov = jacobian @ pose_cov @ jacobian.swapaxes(-1, -2)
    return np.asarray(0.5 * (cov + cov.swapaxes(-1, -2)))
