"""Errors of an estimated trajectory against the truth, as evo computes them."""

from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.model.arguments import check_arguments
from magfusion.model.short_repr import one_line, short_repr
from magfusion.model.trajectory import Trajectory, interpolate
from magfusion.results.association import AssociatedPoses, associate, select_poses
from magfusion.units import Array, BoolArray, IntArray


class RelativeErrors(NamedTuple):
    """Relative pose errors (RPE) over pairs of epochs."""

    pairs: IntArray  # (m, 2), first and second epoch of each pair
    translation: Array  # (m,) (m)
    rotation: Array  # (m,), geodesic angle (rad)

    def __repr__(self) -> str:
        return one_line("RelativeErrors", [f"{len(self.pairs)} pairs"])

    @property
    def translation_rmse(self) -> float:
        """Root mean square of the translation errors (m)."""
        return _rms(self.translation)

    @property
    def rotation_rmse_deg(self) -> float:
        """Root mean square of the rotation errors (deg)."""
        return float(np.rad2deg(_rms(self.rotation)))


@dataclass(frozen=True, eq=False)
class TrajectoryErrors:
    """Estimate minus truth at each of the estimate's times for which there is a truth.

    Errors of a part that the truth lacks are NaN: of attitude, or of position.
    """

    __repr__ = short_repr

    time: Array  # (n,), seconds since the log's epoch
    # (epochs of the estimate,), which epochs of the estimate were compared; of a truth that is too
    # coarse to be interpolated, which of its samples
    compared: BoolArray
    position_world: Array  # (n, 3) (m)
    # (n, 6), ``Pose3.localCoordinates(truth, estimate)``: rotation, translation in body axes (rad,
    # m)
    pose_body: Array
    attitude: Array  # (n,), geodesic angle (rad)
    # (n, 3), after the rigid motion of the estimate that fits the positions best (Umeyama, no
    # scale; m)
    aligned_position_world: Array
    # (n,), after the one constant world rotation that fits the attitudes best (rad)
    aligned_attitude: Array
    relative: RelativeErrors  # over consecutive pairs of compared epochs
    world_from_body: Array  # (n, 3, 3), rotation matrices of the estimate
    # (n, 6, 6), of the estimate, where it has one: rotation, translation, body axes (rad^2, m^2)
    pose_cov: Array | None = None
    # (n,), normalised estimation error squared where there is a covariance (no unit), of
    # `degrees_of_freedom`
    nees: Array | None = None
    not_covered: str = ""  # why other epochs were not compared; empty where all were
    at_truth: bool = False  # whether the samples of the truth were compared

    @property
    def has_position(self) -> bool:
        """Whether positions are compared."""
        return not np.isnan(self.position_world).any()

    @property
    def has_attitude(self) -> bool:
        """Whether attitudes are compared."""
        return not np.isnan(self.attitude).any()

    @property
    def degrees_of_freedom(self) -> int:
        """Of a pose error."""
        return 3 * self.has_position + 3 * self.has_attitude

    @property
    def ate(self) -> float:
        """Absolute trajectory error: root mean square of the position error (m)."""
        return _rms(np.linalg.norm(self.position_world, axis=1))

    @property
    def attitude_rmse_deg(self) -> float:
        """Root mean square of the attitude error (deg)."""
        return float(np.rad2deg(_rms(self.attitude)))

    @property
    def aligned_ate(self) -> float:
        """Absolute trajectory error after rigid alignment of the positions (m)."""
        return _rms(np.linalg.norm(self.aligned_position_world, axis=1))

    @property
    def aligned_attitude_rmse_deg(self) -> float:
        """Root mean square of the attitude error after one constant world rotation (deg)."""
        return float(np.rad2deg(_rms(self.aligned_attitude)))

    @property
    def attitude_body(self) -> Array:
        """Rotation vector of the attitude error in body axes (rad), shape (n, 3)."""
        return self.pose_body[:, :3]

    @property
    def attitude_sigma_body(self) -> Array | None:
        """Standard deviation of `attitude_body` (rad), shape (n, 3)."""
        if self.pose_cov is None:
            return None
        return np.asarray(np.sqrt(np.diagonal(self.pose_cov, axis1=1, axis2=2)[:, :3]))

    @property
    def position_sigma_world(self) -> Array | None:
        """Standard deviation of `position_world` (m), shape (n, 3)."""
        if self.pose_cov is None:
            return None
        turn, cov_body = self.world_from_body, self.pose_cov[:, 3:, 3:]
        return np.asarray(np.sqrt(np.einsum("nij,njk,nik->ni", turn, cov_body, turn)))

    @property
    def inside_3_sigma(self) -> float | None:
        """Fraction of the pose error's components within three of their own sigmas."""
        if self.pose_cov is None:
            return None
        sigma = np.sqrt(np.diagonal(self.pose_cov, axis1=1, axis2=2))
        ratio = np.abs(self.pose_body) / sigma
        return float(np.mean(ratio[np.isfinite(self.pose_body)] <= 3.0))


def trajectory_errors(
    estimate: Trajectory, truth: Trajectory, *, max_gap: float | None = None, delta_frames: int = 1
) -> TrajectoryErrors:
    """Compare an estimate with the truth at the same times, as `associate` finds them.

    Parameters
    ----------
    max_gap : float, optional
        Longest step of the truth across which it is interpolated linearly (s); without it, it is
        interpolated wherever its motion allows that.
    delta_frames : int
        Length of the relative errors' pairs, in compared epochs.

    Returns
    -------
    TrajectoryErrors
        ``ate``, ``aligned_ate`` and ``relative`` agree with evo's APE and RPE.

    Raises
    ------
    TypeError
        Where one of them is not a trajectory.
    InputError
        Where fewer than three epochs of the estimate have a truth.
    """
    check_arguments("trajectory_errors", estimate=(estimate, Trajectory), truth=(truth, Trajectory))
    if max_gap is None:
        pairs = associate(estimate, truth)
    else:
        reason = f"the others are in steps longer than {max_gap} s"
        true, compared = interpolate(truth, estimate.time, max_gap)
        pairs = AssociatedPoses(select_poses(estimate, compared), true, compared, reason)
    true, own = pairs.truth, pairs.estimate
    if len(true) < 3:
        raise InputError(
            f"The truth covers {len(true)} of the estimate's {len(estimate)} epochs, and at least 3"
            f" are needed: {pairs.not_covered}. Check that both use the same clock (evaluate"
            " --align-time estimates an offset), and record the truth at a higher rate, or estimate"
            " at one (--rate)."
        )
    rotation, position, cov = own.world_from_body, own.position_world, own.pose_cov
    pose_body = pose_errors(rotation, position, true)
    return TrajectoryErrors(
        time=true.time,
        compared=pairs.compared,
        position_world=position - true.position_world,
        pose_body=pose_body,
        attitude=np.linalg.norm(pose_body[:, :3], axis=1),
        aligned_position_world=_align(position, true.position_world) - true.position_world,
        aligned_attitude=_aligned_attitude(rotation, true.world_from_body),
        relative=relative_errors(rotation, position, true, frame_pairs(len(true), delta_frames)),
        world_from_body=rotation,
        pose_cov=cov,
        nees=None if cov is None else _nees(pose_body, cov),
        not_covered=pairs.not_covered if not np.all(pairs.compared) else "",
        at_truth=pairs.at_truth,
    )


def pose_errors(world_from_body: Array, position_world: Array, truth: Trajectory) -> Array:
    """Return ``Pose3.localCoordinates(truth, estimate)`` of each epoch, shape (n, 6).

    Rotation, then translation, in body axes (rad, m); NaN of a part that one of them lacks.
    """
    turn, place = truth.world_from_body, truth.position_world
    lacking = np.zeros(6, dtype=bool)
    lacking[:3] = np.isnan(turn).any() or np.isnan(world_from_body).any()
    lacking[3:] = np.isnan(place).any() or np.isnan(position_world).any()
    if lacking[0]:
        turn = world_from_body = np.where(np.isnan(world_from_body), np.eye(3), world_from_body)
    if lacking[3]:
        place = position_world = np.zeros_like(place)
    pairs = zip(_poses(turn, place), _poses(world_from_body, position_world), strict=True)
    errors = np.array([true.localCoordinates(estimated) for true, estimated in pairs])
    errors[:, lacking] = np.nan
    return errors


def frame_pairs(epochs: int, delta: int) -> IntArray:
    """Return consecutive pairs of indices ``delta`` epochs apart, shape (m, 2)."""
    ids = np.arange(0, epochs, delta)
    return np.stack([ids[:-1], ids[1:]], axis=1)


def relative_errors(
    world_from_body: Array, position_world: Array, truth: Trajectory, pairs: IntArray
) -> RelativeErrors:
    """Compare the motion between two epochs with the true one (RPE of the TUM benchmark).

    Parameters
    ----------
    world_from_body : ndarray, shape (n, 3, 3)
    position_world : ndarray, shape (n, 3)
        (m)
    truth : Trajectory
        At the same n epochs.
    pairs : ndarray of int, shape (m, 2)
        As from `frame_pairs`.
    """
    if np.isnan(world_from_body).any() or not truth.has_attitude:
        unknown = np.full(len(pairs), np.nan)  # the translation's axes are those of the attitude
        return RelativeErrors(pairs, unknown, unknown)
    step, shift = _motion(world_from_body, position_world, pairs)
    true_step, true_shift = _motion(truth.world_from_body, truth.position_world, pairs)
    # The shifts' difference need not be rotated: its length is the same in all axes.
    return RelativeErrors(
        pairs=pairs,
        translation=np.linalg.norm(shift - true_shift, axis=1),
        rotation=Rotation.from_matrix(np.swapaxes(true_step, 1, 2) @ step).magnitude(),
    )


def _motion(world_from_body: Array, position_world: Array, pairs: IntArray) -> tuple[Array, Array]:
    first, second = pairs.T
    back = np.swapaxes(world_from_body[first], 1, 2)
    shift = (back @ (position_world[second] - position_world[first])[..., None])[..., 0]
    return back @ world_from_body[second], shift


def _poses(world_from_body: Array, position_world: Array) -> list[gtsam.Pose3]:
    return [
        gtsam.Pose3(gtsam.Rot3(r), p) for r, p in zip(world_from_body, position_world, strict=True)
    ]


def _align(position: Array, target: Array) -> Array:
    if np.isnan(position).any() or np.isnan(target).any():
        return np.full_like(target, np.nan)
    centre, target_centre = position.mean(axis=0), target.mean(axis=0)
    # Along a line, or at rest, many rotations fit equally well, with the same residual.
    turn = gtsam.Rot3.ClosestTo((target - target_centre).T @ (position - centre)).matrix()
    return np.asarray((position - centre) @ turn.T + target_centre)


def _aligned_attitude(estimated: Array, true: Array) -> Array:
    if np.isnan(estimated).any() or np.isnan(true).any():
        return np.full(len(true), np.nan)
    offset = Rotation.from_matrix(estimated @ np.swapaxes(true, 1, 2))
    return np.asarray((offset.mean().inv() * offset).magnitude())


def _nees(error: Array, cov: Array) -> Array:
    known = np.flatnonzero(np.isfinite(error).all(axis=0))
    error, cov = error[:, known], cov[:, known[:, None], known]
    return np.asarray(np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[..., None])[..., 0]))


def _rms(value: Array) -> float:
    return float(np.sqrt(np.mean(value**2)))
