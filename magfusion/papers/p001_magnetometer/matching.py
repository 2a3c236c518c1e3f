"""Attitude from the vector of one uniform field, the Earth's, in closed form.

A vector determines two angles of three: it is invariant to rotation about the field.  Paper 001
treats a point on its sphere of vectors as one attitude (section 2); it is a circle of them.  So
roll follows from given pitch and yaw, roll and pitch from given yaw, and all three only from a
second vector.  Even then pitch has two solutions, which coincide in a fold where neither is
determined.

Angles (rad) are those of ``world_from_body = Rz(yaw) Ry(pitch) Rx(roll)``, z up: a positive pitch
lowers the x axis.  Throughout, ``field_body`` is the measured field (..., 3) (T), ``field_world``
the known one (3,) (T) and ``sigma`` the noise of each component of the former (T).  Database
matching is in `magfusion.papers.p001_magnetometer.matching_database`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.errors import InputError
from magfusion.estimation.snapshot.candidates import wahba
from magfusion.units import DEGREE, Array, BoolArray

UNDETERMINED = 10.0 * DEGREE  # rad, one sigma
MIN_SHARE = 0.05  # of the field across an axis; below it an error of the field grows twentyfold
RESTING = 0.05  # of gravity; a specific force that differs by more is not that of a body at rest

THREE_ANGLES = (
    "one field vector determines two of three angles: give the yaw, or use a second vector (gravity"
    " from the accelerometer, or the phasors of beacons)"
)


@dataclass(frozen=True, eq=False)
class Matches:
    """Attitudes consistent with a field vector, the usual one first."""

    # (..., hypotheses, 3), roll, pitch, yaw (rad); NaN where there is no second solution of the
    # pitch
    rpy: Array
    # (..., hypotheses, 3) (rad); zero for a given angle, NaN or infinite where one is not
    # determined
    sigma: Array
    residual: Array  # (..., hypotheses), distance of the measured field from the matched one (T)
    # (..., hypotheses), False at the fold, or where the measured field is outside the database
    determined: BoolArray

    @property
    def ambiguous(self) -> BoolArray:
        """Which vectors have two attitudes."""
        return np.isfinite(self.rpy[..., 0]).sum(axis=-1) > 1


def predict_field(rpy: Array, field_world: Array) -> Array:
    """Return the field in body axes at attitudes (..., 3) (rad)."""
    turn = Rotation.from_euler("xyz", np.reshape(rpy, (-1, 3)))
    rotated = turn.apply(field_world, inverse=True)
    return rotated.reshape(rpy.shape)


def wrap(angle: Array) -> Array:
    """Return angles in the interval from -pi to pi."""
    return np.angle(np.exp(1j * angle))


def usual_side(field_world: Array) -> int:
    """Return the side of the fold of a level body; see `fold_side`."""
    return 1 if field_world[2] >= 0.0 else -1


def fold_side(pitch: Array, yaw: Array | float, field_world: Array) -> Array:
    """Return the field along the pitched z axis as a share of the whole: its sign gives the side.

    It is the sine of the angle between the field and the axes of roll and pitch; where it is zero,
    a rotation about the field is a combination of these two, and neither is determined.
    """
    along, _, down = _in_heading(yaw, field_world)
    return (along * np.sin(pitch) + down * np.cos(pitch)) / np.linalg.norm(field_world)


def match_roll(
    field_body: Array, pitch: float, yaw: float, field_world: Array, sigma: float
) -> Matches:
    """Return the maximum-likelihood roll for given pitch and yaw (atan2).

    Raises InputError where the axis of roll lies along the field.
    """
    check_roll_axis(pitch, yaw, field_world)
    roll = roll_about(field_body, np.asarray(pitch), yaw, field_world)
    rpy = np.stack([roll, np.full_like(roll, pitch), np.full_like(roll, yaw)], axis=-1)
    residual = np.linalg.norm(predict_field(rpy, field_world) - field_body, axis=-1)
    spread = roll_sigma(rpy, field_world, sigma)
    determined = spread[..., :1] < UNDETERMINED
    return Matches(rpy[..., None, :], spread[..., None, :], residual[..., None], determined)


def match_roll_pitch(
    field_body: Array, yaw: Array | float, field_world: Array, sigma: float, side: int | None = None
) -> Matches:
    """Return the maximum-likelihood roll and pitch for given yaw, both solutions.

    The first is on the given side of the fold (`fold_side`), by default that of a level body.  Yaws
    (...) give a family of attitudes. Raises InputError where the field has no component in the
    plane of pitch.
    """
    along, _, down = _in_heading(yaw, field_world)
    size = float(np.linalg.norm(field_world))
    in_plane, rotated = np.hypot(along, down), np.arctan2(down, along)
    if np.any(in_plane < MIN_SHARE * size):
        raise InputError(
            "the field lies along the axis of pitch and cannot determine it; choose another"
            " heading, or add gravity from the accelerometer"
        )
    first = usual_side(field_world) if side is None else side
    # Noise moves the measured vector off the sphere and beyond the fold: use the nearest point.
    share = field_body[..., 0] * size / (np.linalg.norm(field_body, axis=-1) * in_plane)
    opening = np.arccos(np.clip(share, -1.0, 1.0))
    pitch = wrap(first * opening - rotated)
    roll = roll_about(field_body, pitch, yaw, field_world)
    rpy = np.stack([roll, pitch, np.broadcast_to(yaw, roll.shape)], axis=-1)
    return with_other_pitch(rpy, field_body, field_world, sigma, np.abs(share) <= 1.0)


def with_other_pitch(
    rpy: Array, field_body: Array, field_world: Array, sigma: float | Array, known: BoolArray
) -> Matches:
    """Add to attitudes (..., 3) the other pitch with the same field, and flag determined ones.

    ``known`` (...) is whether the attitude matches the field.
    """
    yaw = rpy[..., 2]
    along, _, down = _in_heading(yaw, field_world)
    other = wrap(-rpy[..., 1] - 2.0 * np.arctan2(down, along))
    # Beyond the vertical it is the attitude of another yaw.
    other = np.where(np.abs(other) <= 0.5 * np.pi, other, np.nan)
    roll = roll_about(field_body, other, yaw, field_world)
    both = np.stack([rpy, np.stack([roll, other, np.where(np.isnan(other), np.nan, yaw)], -1)], -2)
    spread = roll_pitch_sigma(both, field_world, np.asarray(sigma)[..., None])
    # Distance of the pitch from the fold, where the two solutions coincide.
    to_fold = np.abs(np.arcsin(np.clip(np.sin(rpy[..., 1] + np.arctan2(down, along)), -1.0, 1.0)))
    separate = to_fold[..., None] > 3.0 * spread[..., 1]
    determined = known[..., None] & separate & (np.max(spread, axis=-1) < UNDETERMINED)
    there = np.nan_to_num(both)
    residual = np.linalg.norm(predict_field(there, field_world) - field_body[..., None, :], axis=-1)
    residual = np.where(np.isnan(both[..., 0]), np.nan, residual)
    return Matches(both, spread, residual, determined)


def roll_about(field_body: Array, pitch: Array, yaw: Array | float, field_world: Array) -> Array:
    """Return the roll (rad) that rotates the pitched field onto the measured one."""
    along, across, down = _in_heading(yaw, field_world)
    up = along * np.sin(pitch) + down * np.cos(pitch)
    measured = field_body[..., 2] + 1j * field_body[..., 1]
    return np.angle(measured * np.conj(up + 1j * across))


def check_roll_axis(pitch: float, yaw: float, field_world: Array) -> None:
    """Raise InputError if the axis of roll lies along the field."""
    still = predict_field(np.array([0.0, pitch, yaw]), field_world)
    if np.hypot(still[1], still[2]) < MIN_SHARE * np.linalg.norm(field_world):
        raise InputError(
            "the field lies along the axis of roll and cannot determine it; choose another pitch or"
            " heading, or add gravity from the accelerometer"
        )


def roll_sigma(rpy: Array, field_world: Array, sigma: float | Array) -> Array:
    """Return the standard deviation of roll alone, and zeros for pitch and yaw, (..., 3) (rad)."""
    still = predict_field(rpy, field_world)
    roll = sigma / np.hypot(still[..., 1], still[..., 2])
    return np.stack([roll, np.zeros_like(roll), np.zeros_like(roll)], axis=-1)


def roll_pitch_sigma(rpy: Array, field_world: Array, sigma: float | Array) -> Array:
    """Return the standard deviations of roll and pitch, and zero for yaw, (..., 3) (rad)."""
    size = float(np.linalg.norm(field_world))
    _, across, _ = _in_heading(rpy[..., 2], field_world)
    share = np.abs(fold_side(rpy[..., 1], rpy[..., 2], field_world))
    still = predict_field(np.nan_to_num(rpy), field_world)
    radius = np.hypot(still[..., 1], still[..., 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        pitch = sigma * radius / (size**2 * share)
        roll = sigma * np.sqrt(size**2 - across**2) / (size**2 * share)
    return np.stack([roll, pitch, np.where(np.isnan(roll), np.nan, 0.0)], axis=-1)


def attitude_with_gravity(
    field_body: Array, force_body: Array, field_world: Array, field_share: float, force_share: float
) -> Array:
    """Return world_from_body (..., 3, 3) from the field and, at rest, gravity: maximum likelihood.

    The solution of Wahba's problem; the specific force (..., 3) is upwards, and the weights are the
    noise of each component relative to the length of the vector. Raises InputError where the field
    is vertical: then both are parallel.
    """
    direction = field_world / np.linalg.norm(field_world)
    if np.hypot(direction[0], direction[1]) < MIN_SHARE:
        raise InputError(
            "the field is vertical, parallel to gravity, so that the yaw is not determined; give"
            " the yaw, or add beacons"
        )
    unit_field = field_body / np.linalg.norm(field_body, axis=-1, keepdims=True)
    unit_force = force_body / np.linalg.norm(force_body, axis=-1, keepdims=True)
    up = np.array([0.0, 0.0, 1.0])
    outer = direction[:, None] * unit_field[..., None, :] / field_share**2
    return wahba(outer + up[:, None] * unit_force[..., None, :] / force_share**2)


def match_with_gravity(
    field_body: Array,
    force_body: Array,
    field_world: Array,
    gravity: float,
    sigma: float,
    force_sigma: float,
) -> Matches:
    """Return all three angles from the field and the specific force of a body at rest.

    A force (n, 3) (m/s^2) whose magnitude is not that of gravity leaves the attitude undetermined.
    Raises InputError as `attitude_with_gravity`.
    """
    shares = (sigma / float(np.linalg.norm(field_world)), force_sigma / gravity)
    turn = attitude_with_gravity(field_body, force_body, field_world, *shares)
    pitch = -np.arcsin(np.clip(turn[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(turn[:, 2, 1], turn[:, 2, 2])
    rpy = np.stack([roll, pitch, np.arctan2(turn[:, 1, 0], turn[:, 0, 0])], axis=-1)
    # Each direction determines the two rotations across it.
    known = np.stack([field_world / np.linalg.norm(field_world), [0.0, 0.0, 1.0]]) @ turn
    across = np.eye(3) - known[..., :, None] * known[..., None, :]
    cov_body = np.linalg.inv(np.einsum("nkij,k->nij", across, 1.0 / np.square(shares)))
    by_angles = np.stack(
        [
            np.broadcast_to([1.0, 0.0, 0.0], rpy.shape),
            np.stack([np.zeros_like(roll), np.cos(roll), -np.sin(roll)], axis=-1),
            turn[:, 2],
        ],
        axis=-1,
    )
    to_angles = np.linalg.pinv(by_angles)
    cov = to_angles @ cov_body @ np.swapaxes(to_angles, 1, 2)
    spread = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    shaken = np.abs(np.linalg.norm(force_body, axis=1) / gravity - 1.0) > RESTING
    residual = np.linalg.norm(predict_field(rpy, field_world) - field_body, axis=1)
    determined = ~shaken & (np.max(spread, axis=1) < UNDETERMINED)
    return Matches(rpy[:, None], spread[:, None], residual[:, None], determined[:, None])


def _in_heading(yaw: Array | float, field_world: Array) -> tuple[Array, Array, Array]:
    """Return the field along and across the heading, level, and its upward part."""
    x, y, z = field_world
    return x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw), z
