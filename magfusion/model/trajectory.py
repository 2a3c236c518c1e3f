"""Trajectory: poses over time."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from magfusion.model.short_repr import one_line
from magfusion.units import Array, BoolArray, IntArray

# Of one pose, by the name of each part.
_SHAPES: tuple[tuple[str, tuple[int, ...]], ...] = (
    ("time", ()),
    ("world_from_body", (3, 3)),
    ("position_world", (3,)),
    ("velocity_world", (3,)),
    ("gyro_bias_body", (3,)),
    ("accel_bias_body", (3,)),
    ("pose_cov", (6, 6)),
)


class PoseAccess:
    """Short names for position and attitude, for one pose or a pose per row."""

    world_from_body: Array
    position_world: Array

    @property
    def position(self) -> Array:
        """Position of the body in the world, shape (..., 3) (m): ``position_world``."""
        return self.position_world

    @property
    def rotation(self) -> Rotation:
        """Attitude from body to world axes, as SciPy's `Rotation`."""
        return Rotation.from_matrix(self.world_from_body)

    @property
    def euler(self) -> Array:
        """Roll, pitch, yaw, shape (..., 3) (rad): rotation by yaw, then pitch, then roll.

        As ``rpy_deg`` of a site, and as ``rotation.as_euler("xyz")``.
        """
        return np.asarray(self.rotation.as_euler("xyz"))


@dataclass(frozen=True, eq=False)
class Trajectory(PoseAccess):
    """Poses of the body over time; optional parts are None if unknown.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds since the log's epoch, strictly increasing.
    world_from_body : ndarray, shape (n, 3, 3)
        Rotation matrices; NaN of a truth that has positions alone.
    position_world : ndarray, shape (n, 3)
        (m); NaN of a truth that has attitudes alone.
    velocity_world : ndarray, shape (n, 3), optional
        (m/s)
    gyro_bias_body : ndarray, shape (n, 3), optional
        (rad/s)
    accel_bias_body : ndarray, shape (n, 3), optional
        (m/s^2)
    pose_cov : ndarray, shape (n, 6, 6), optional
        Rotation, then position; body axes, right perturbation (rad^2, rad m, m^2).
    """

    time: Array
    world_from_body: Array
    position_world: Array
    velocity_world: Array | None = None
    gyro_bias_body: Array | None = None
    accel_bias_body: Array | None = None
    pose_cov: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.time)
        for name, own in _SHAPES:
            value = getattr(self, name)
            if value is not None and value.shape != (n, *own):
                raise ValueError(f"{name} must have shape {(n, *own)}; got {value.shape}")
        if n > 1 and (self.time[1:] <= self.time[:-1]).any():
            raise ValueError("time must be strictly increasing")

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        spans = [f"{self.time[0]:g} to {self.time[-1]:g} s"] if len(self) else []
        known = [n for n, _ in _SHAPES[3:] if getattr(self, n) is not None]
        return one_line(type(self).__name__, [f"{len(self)} poses", *spans, *known])

    def rows(self, chosen: IntArray | BoolArray | slice) -> "Trajectory":
        """Return some of the poses, with all that is known of them."""
        return Trajectory(**{k: v[chosen] for k, v in vars(self).items() if v is not None})

    @property
    def has_position(self) -> bool:
        """Whether the positions are known."""
        return not np.isnan(self.position_world).any()

    @property
    def has_attitude(self) -> bool:
        """Whether the attitudes are known."""
        return not np.isnan(self.world_from_body).any()

    @property
    def has_poses(self) -> bool:
        """Whether positions and attitudes are known."""
        return self.has_position and self.has_attitude

    @property
    def cov(self) -> Array | None:
        """Covariance of rotation, then position, shape (n, 6, 6): ``pose_cov`` (rad, m)."""
        return self.pose_cov


def interpolate(
    trajectory: Trajectory, time: Array, max_gap: float
) -> tuple[Trajectory, BoolArray]:
    """Interpolate the poses at those of ``time`` that lie on a sample or in a short enough step.

    Positions are interpolated linearly, attitudes along the shortest rotation (slerp); other parts
    of the trajectory are omitted. `time` (n,): strictly increasing (s). `max_gap`: longest step of
    the trajectory to interpolate across (s). Returns `poses`: at the m times that exist;
    `exists` (n,): which of ``time`` have a pose.
    """
    known = trajectory.time
    if len(known) == 0:
        exists = np.zeros(len(time), dtype=bool)
        return Trajectory(time[exists], np.empty((0, 3, 3)), np.empty((0, 3))), exists
    after = np.clip(np.searchsorted(known, time), 0, len(known) - 1)
    before = np.where(known[after] == time, after, np.maximum(after - 1, 0))
    step = known[after] - known[before]
    exists = (known[before] <= time) & (time <= known[after]) & (step <= max_gap)
    wanted, remaining, right = time[exists], before[exists], after[exists]
    # On a sample both neighbours are that sample, and the step is zero.
    share = (wanted - known[remaining]) / np.where(remaining == right, 1.0, step[exists])
    position = trajectory.position_world
    turn = _slerp(known, trajectory.world_from_body, wanted)
    moved = position[remaining] + share[:, None] * (position[right] - position[remaining])
    return Trajectory(wanted, turn, moved), exists


def interpolated(wanted: Array, time: Array, values: Array) -> Array:
    """Return columns, shape (m, k), linearly interpolated between values at times (n,) (s).

    Constant before the first time and after the last one.
    """
    return np.stack([np.interp(wanted, time, column) for column in values.T], axis=1)


def _slerp(known: Array, world_from_body: Array, wanted: Array) -> Array:
    if len(wanted) == 0:
        return np.empty((0, 3, 3))
    if len(known) == 1:
        return world_from_body.copy()
    return Slerp(known, Rotation.from_matrix(world_from_body))(wanted).as_matrix()
