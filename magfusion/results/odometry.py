"""One state in the form of robot middleware: pose and velocity, with covariances."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.graph.state import ROTATION, VELOCITY, State
from magfusion.model.fixed_axes import fixed_axes_covariance
from magfusion.units import NS_PER_S, Array


@dataclass(frozen=True, eq=False)
class Odometry:
    """Pose in a world with z up, velocity in body axes."""

    stamp_ns: int  # since the epoch of the drive phases, or 1970 where that is known to be so
    # position_world, velocity_body: (3,) (m, m/s)
    position_world: Array
    quaternion: Array  # (4,), of ``world_from_body``, w first
    velocity_body: Array
    pose_cov: Array  # (6, 6), position, then rotation, about the axes of the world (m^2, rad^2)
    velocity_cov_body: Array  # (3, 3) (m^2/s^2)


def odometry_of(state: State, epoch_ns: int = 0) -> Odometry:
    """Return the odometry of a state.

    `epoch_ns`: zero of the states' time (ns since 1970); no format has earlier stamps.
    """
    world_from_body = state.world_from_body
    velocity_body = world_from_body.T @ state.velocity_world
    # v_body = exp(-phi) R^T v_world: an attitude error rotates the velocity, too.
    x, y, z = velocity_body
    by_rotation = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    jacobian = np.zeros((3, 9))
    jacobian[:, ROTATION], jacobian[:, VELOCITY] = by_rotation, world_from_body.T
    velocity_cov = jacobian @ state.cov[:9, :9] @ jacobian.T
    return Odometry(
        stamp_ns=max(0, epoch_ns + round(state.time * NS_PER_S)),
        position_world=state.position_world,
        quaternion=Rotation.from_matrix(world_from_body).as_quat(scalar_first=True),
        velocity_body=velocity_body,
        pose_cov=fixed_axes_covariance(world_from_body, state.cov[:6, :6]),
        velocity_cov_body=0.5 * (velocity_cov + velocity_cov.T),
    )
