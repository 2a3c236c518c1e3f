"""Paper 000, equation by equation: the coupling of two three-axis antennas, and its calibration.

The transmitter is the beacon, the receiver the sensor.  H is an attitude (..., 3, 3),
sensor_from_beacon; a position (..., 3) is the sensor's in beacon axes (m); Y is a coupling
(..., 3, 3), rows receiving coils, columns transmitting ones, that is, time slots; X is the drive
(3, 3), K the gain.  Centres (..., 3 coils, 3) are those of the coils (m).
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.model.antenna import observe_antenna
from magfusion.units import Array

NOT_FUNCTIONS = {
    2: "first column of Eq 5; Misprint: called the field without the ambient one, it contains it",
    3: "second column of Eq 5; Misprint as Eq 2",
    4: "third column of Eq 5; Misprint as Eq 2",
    6: "names the nine entries of the drive X",
    7: "names the nine entries of the coupling Y",
    8: "names nine entries of the ambient field; False: one silent slot measures three of them",
    19: "is Eq 18 at scale one; Misprint as that: both sides have one name",
}


def position_matrix(position_beacon: Array) -> Array:
    """Return ``M = 1 - 3 u u^T``, shape (..., 3, 3), with which Eq 1 has the right sign."""
    unit = position_beacon / np.linalg.norm(position_beacon, axis=-1, keepdims=True)
    return np.eye(3) - 3.0 * unit[..., :, None] * unit[..., None, :]


def eq_01_coupling(gain: float, attitude: Array, position_beacon: Array, drive: Array) -> Array:
    """Return ``Y = -(K / R^3) H M X``.  Right: the minus belongs to `position_matrix`."""
    distance = np.linalg.norm(position_beacon, axis=-1)[..., None, None]
    return -gain / distance**3 * attitude @ position_matrix(position_beacon) @ drive


def eq_05_coupling(
    gain: float, attitude: Array, position_beacon: Array, drive: Array, ambient: Array
) -> Array:
    """Return ``Y = -(K / R^3) H M X + A``, as measured.

    Misprint: it is called the coupling after A was removed.  Right as measured, with one vector in
    all columns of A, measured in the silent slot and removed by `magfusion.receiver.ambient`.
    """
    return eq_01_coupling(gain, attitude, position_beacon, drive) + ambient


# 3.2 Antennas -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Correction:
    """The five matrices of Eq 9, each of shape (3, 3)."""

    # transmitter_rotation, transmitter_shift: Q and C
    transmitter_rotation: Array
    transmitter_shift: Array
    # receiver_rotation, receiver_shift: T and B
    receiver_rotation: Array
    receiver_shift: Array
    ambient: Array  # A

    def driven(self, drive: Array) -> Array:
        """Return ``(X - C) Q``."""
        return (drive - self.transmitter_shift) @ self.transmitter_rotation

    def received(self, coupling: Array) -> Array:
        """Return ``(Y - B) T``."""
        return (coupling - self.receiver_shift) @ self.receiver_rotation


def eq_09_whitened(coupling: Array, receiver: Array, transmitter: Array) -> Array:
    """Return the couplings with both antennas removed, ``T Y (Q X)^-1``.

    Corrected: T on the left, where it mixes receiving coils, and Q the map of moments.
    `coupling` (..., 3, 3): without the ambient field. `receiver` (..., 3, 3): T, the inverse of the
    receiving coils' sensitivities, row by row. `transmitter` (..., 3, 3): Q X, the moments as
    columns.
    """
    return receiver @ coupling @ np.linalg.inv(transmitter)


def eq_10_coupling_as_printed(
    gain: float, attitude: Array, position_beacon: Array, drive: Array, correction: Correction
) -> Array:
    """Return ``Y = [-(K / R^3) H M (X - C) Q + A] T^-1 + B``, which is Eq 9 solved for Y.

    False: T mixes transmitting coils, as Q does already; B and C are lengths, added to voltages.
    """
    driven = correction.driven(drive)
    received = eq_05_coupling(gain, attitude, position_beacon, driven, correction.ambient)
    return received @ np.linalg.inv(correction.receiver_rotation) + correction.receiver_shift


eq_10_coupling = observe_antenna
"""Corrected: with a moment, a sensitivity and a centre for each coil."""


def eq_11_attitude_as_printed(
    coupling: Array, position_beacon: Array, gain: float, drive: Array, correction: Correction
) -> Array:
    """Return ``H = [-(R^3 / K) (Y - B) T - A] Q^-1 (X - C)^-1 M^-1``, in general no rotation.

    False: it does not even invert Eq 10, as A is added to the term that the factor multiplies.
    """
    scale = np.linalg.norm(position_beacon, axis=-1)[..., None, None] ** 3 / gain
    bracket = -scale * correction.received(coupling) - correction.ambient
    return _corrected_bracket(bracket, position_beacon, drive, correction)


def eq_11_attitude_of_eq_10(
    coupling: Array, position_beacon: Array, gain: float, drive: Array, correction: Correction
) -> Array:
    """Invert Eq 10 exactly.  Corrected in its bracket; the model remains as printed."""
    scale = np.linalg.norm(position_beacon, axis=-1)[..., None, None] ** 3 / gain
    bracket = -scale * (correction.received(coupling) - correction.ambient)
    return _corrected_bracket(bracket, position_beacon, drive, correction)


def _corrected_bracket(
    bracket: Array, position_beacon: Array, drive: Array, correction: Correction
) -> Array:
    driven, matrix = correction.driven(drive), position_matrix(position_beacon)
    return bracket @ np.linalg.inv(driven) @ np.linalg.inv(matrix)


def eq_11_attitude(
    coupling: Array, position_beacon: Array, receiver: Array, transmitter: Array, ambient: Array
) -> Array:
    """Return the rotation ``polar{-(R^3 / K) T (Y - A) (Q X)^-1 M^-1}``.

    Corrected; matrices as in `eq_09_whitened`, A one vector in all columns, as measured in the
    silent slot.  Only the direction of the position matters.
    """
    free_parameters = eq_09_whitened(coupling - ambient, receiver, transmitter)
    residual, _, right = np.linalg.svd(
        -free_parameters @ np.linalg.inv(position_matrix(position_beacon))
    )
    sign = np.linalg.det(residual @ right)[..., None]
    last = np.concatenate([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)
    return (residual * last[..., None, :]) @ right


# 3.3 Angles of H = Rx(roll) Ry(pitch) Rz(yaw) as turns of the axes ------------------------------


def eq_12_yaw(attitude: Array) -> Array:
    """Return the yaw (rad).  Right: a two-argument arctangent."""
    return np.arctan2(attitude[..., 0, 1], attitude[..., 0, 0])


def eq_13_pitch(attitude: Array) -> Array:
    """Return the pitch (rad).  Right; at a quarter turn yaw and roll are one."""
    return np.arcsin(np.clip(-attitude[..., 0, 2], -1.0, 1.0))


def eq_14_roll(attitude: Array) -> Array:
    """Return the roll (rad).  Right: a two-argument arctangent."""
    return np.arctan2(attitude[..., 1, 2], attitude[..., 2, 2])


def euler_angles(attitude: Array) -> Array:
    """Return yaw, pitch and roll (..., 3) (rad) of Eq 12-14."""
    return np.stack([eq_12_yaw(attitude), eq_13_pitch(attitude), eq_14_roll(attitude)], axis=-1)


def attitude_from_angles(angles: Array) -> Array:
    """Return the H of yaw, pitch and roll (..., 3) (rad): the inverse of `euler_angles`."""
    rotated = Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix()
    return np.swapaxes(rotated, -1, -2).reshape(*angles.shape, 3)


# 4 Calibration ----------------------------------------------------------------------------------


def eq_15_shift_x_as_printed(centres: Array) -> Array:
    """Return the antenna's shift along x (m), ``dX_y + dX_z``.

    Misprint: dX_x, which no point sees, for dX_y.  False: the sum doubles what coils have in
    common; `mean_shift` is the half.
    """
    return centres[..., 1, 0] + centres[..., 2, 0]


def eq_16_shift_y_as_printed(centres: Array) -> Array:
    """Return the antenna's shift along y (m), ``dY_x + dY_z``.  False as Eq 15."""
    return centres[..., 0, 1] + centres[..., 2, 1]


def eq_17_shift_z_as_printed(centres: Array) -> Array:
    """Return the antenna's shift along z (m), ``dZ_x + dZ_y``.  False as Eq 15."""
    return centres[..., 0, 2] + centres[..., 1, 2]


def shift_as_printed(centres: Array) -> Array:
    """Return the shift (..., 3) of Eq 15-17 as printed (m)."""
    parts = (eq_15_shift_x_as_printed, eq_16_shift_y_as_printed, eq_17_shift_z_as_printed)
    return np.stack([part(centres) for part in parts], axis=-1)


def mean_shift(centres: Array) -> Array:
    """Return Eq 15-17 corrected: along each axis the mean over the two coils across it (m)."""
    return 0.5 * shift_as_printed(centres)


def bursa_wolf_matrix(rotation: Array) -> Array:
    """Return ``1 + [w]x`` of Eq 18, of rotations (..., 3) (rad); it is no rotation.

    Its singular values are 1 and twice ``sqrt(1 + w^2)``, its angle is short by ``w^3 / 3``.
    """
    return np.eye(3) + np.cross(np.eye(3), rotation[..., None, :])


def eq_18_point_as_printed(ideal: Array, scale: float, rotation: Array, shift: Array) -> Array:
    """Return the actual of an ideal point (..., 3), Bursa and Wolf's formula.

    Misprint: both sides have one name, and the scale that of the position matrix.  Right to first
    order in the rotation.
    """
    return scale * (bursa_wolf_matrix(rotation) @ ideal[..., None])[..., 0] + shift


def eq_20_ideal_point_as_printed(actual: Array, rotation: Array, shift: Array) -> Array:
    """Return the ideal of an actual point (..., 3): the inverse of Eq 19.

    Right as that.  False: that the shift is C of Eq 9, which has no place for a length.
    """
    inverse = np.linalg.inv(bursa_wolf_matrix(rotation))
    return (inverse @ (actual - shift)[..., None])[..., 0]
