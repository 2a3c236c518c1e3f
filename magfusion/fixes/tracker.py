"""Pose from one three-axis beacon in closed form: paper 000 as printed, and what is exact.

Frames: the paper's transmitter is the beacon, its receiver the sensor, its H sensor_from_beacon.
One singular value decomposition gives range, bearing and attitude at once.  The dipole is even, so
that the opposite position fits as well; the attitude is the same for both.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.antenna import Antenna, observe_antenna
from magfusion.errors import EstimationError, InputError
from magfusion.site import Beacon, Site
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray


@dataclass(frozen=True, eq=False)
class TrackerFix:
    """Pose of a sensor relative to one beacon.

    Parameters
    ----------
    sensor_from_beacon : ndarray, shape (..., 3, 3)
        The paper's H.
    position_beacon : ndarray, shape (..., 2, 3)
        The two positions that fit, opposite each other (m); the order means nothing until
        `nearest` has put the wanted hemisphere first.
    distance : ndarray, shape (...)
        (m)
    residual : ndarray, shape (...)
        What no pose explains, relative to the coupling: singular values that are not 2 : 1 : 1.
    """

    sensor_from_beacon: Array
    position_beacon: Array
    distance: Array
    residual: Array

    def nearest(self, guess_beacon: Array) -> "TrackerFix":
        """Return the fix with the position on the side of a guess (..., 3) first.

        A prior or the last position tells the hemisphere; the coils' centres do so only where the
        antenna is known far better than the noise.
        """
        towards = np.einsum("...hi,...i", self.position_beacon, guess_beacon)
        swap = (towards[..., 1] > towards[..., 0])[..., None, None]
        ordered = np.where(swap, self.position_beacon[..., ::-1, :], self.position_beacon)
        return TrackerFix(self.sensor_from_beacon, ordered, self.distance, self.residual)


def unit_coupling(
    beacon: Beacon, phasor_sensor: ComplexArray, matrix: Array, phase: Array | None = None
) -> Array:
    """Return the field of unit moments along the beacon's axes, in sensor axes.

    The paper's ``T Y (Q X)^-1``: whitened of drive, moments and sensitivities, and real once the
    drive phase is undone.

    Parameters
    ----------
    beacon : Beacon
        With moments along all three axes.
    phasor_sensor : complex ndarray, shape (..., tones, 3)
        (T), measured axes.
    matrix : ndarray, shape (3, 3)
        The magnetometer's.
    phase : ndarray, shape (..., tones), optional
        Drive phase beyond what the coils declare (rad).

    Returns
    -------
    ndarray, shape (..., 3, 3)
        (T per A m^2); rows are sensor axes, columns beacon axes.

    Raises
    ------
    InputError
        Where the beacon's moments lie in one plane.
    """
    drive = beacon.moments_beacon.T @ beacon.excitation
    moments = np.concatenate([drive.real, drive.imag], axis=1)
    size = np.linalg.svd(moments, compute_uv=False)
    if size[-1] < 1e-3 * size[0]:
        raise InputError(
            f"beacon {beacon.name}: its moments lie in one plane; the closed form of a tracker"
            " needs three axes, `magfusion fix` does with fewer"
        )
    undone = phasor_sensor if phase is None else phasor_sensor * np.exp(-1j * phase)[..., None]
    measured = np.concatenate([undone.real, undone.imag], axis=-2)  # (..., 2 tones, 3)
    in_sensor = measured @ np.linalg.inv(matrix).T
    return np.asarray(np.swapaxes(in_sensor, -1, -2) @ np.linalg.pinv(moments))


def whitened(coupling: Array, receiver: Array, transmitter: Array) -> Array:
    """Return couplings freed of their antennas, ``T Y (Q X)^-1`` (paper 000, Eq 9, corrected).

    Parameters
    ----------
    coupling : ndarray, shape (..., 3, 3)
        Rows are receiving coils.
    receiver : ndarray, shape (..., 3, 3)
        T: the inverse of the receiving coils' sensitivities, row by row.
    transmitter : ndarray, shape (..., 3, 3)
        Q X: the moments as columns.

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    return np.asarray(receiver @ coupling @ np.linalg.inv(transmitter))


def locate_by_svd(unit: Array) -> TrackerFix:
    """Find range, bearing and attitude from one singular value decomposition.

    ``U = (K/R^3) H (3 u u^T - 1)`` has singular values 2 : 1 : 1, the first along the bearing, and
    H is what remains of it: the solution of Wahba's problem and the polar factor of Eq 11 as well.

    Parameters
    ----------
    unit : ndarray, shape (..., 3, 3)
        Of `unit_coupling` (T per A m^2).

    Returns
    -------
    TrackerFix

    Raises
    ------
    EstimationError
        Where a determinant is not positive, as no pose of a right-handed tracker makes it.
    """
    _refuse_mirrored(unit)
    left, size, right = np.linalg.svd(unit)
    power = np.sum(size**2, axis=-1)
    distance = (6.0 * MU0_OVER_4PI**2 / power) ** (1.0 / 6.0)
    along = right[..., 0, :] * distance[..., None]
    ideal = np.sqrt(power / 6.0)[..., None] * [2.0, 1.0, 1.0]
    return TrackerFix(
        sensor_from_beacon=(left * [1.0, -1.0, -1.0]) @ right,
        position_beacon=np.stack([along, -along], axis=-2),
        distance=np.asarray(distance),
        residual=np.asarray(np.linalg.norm(size - ideal, axis=-1) / np.sqrt(power)),
    )


def _refuse_mirrored(unit: Array) -> None:
    finite = np.isfinite(unit).all(axis=(-2, -1))
    if not finite.all():
        raise EstimationError(f"coupling {np.argmin(finite.ravel())} holds no numbers to solve for")
    size = np.linalg.svd(unit, compute_uv=False)
    flat = size[..., 2] < 1e-6 * size[..., 0]
    if flat.any():
        raise EstimationError(
            f"coupling {np.argmax(flat.ravel())} is singular: a coil is silent or its wire broken"
        )
    # det U = 2 (K/R^3)^3; noise does not turn its sign before it is as large as the signal.
    wrong = np.linalg.det(unit) < 0.0
    if wrong.any():
        raise EstimationError(
            f"coupling {np.argmax(wrong.ravel())} has a negative determinant, which no pose"
            " explains: the wires of one coil, or two coils, are swapped, or the sign of one axis"
            " or of Eq 1 is wrong (M = 1 - 3 u u^T takes a minus)"
        )


def world_poses(site: Site, beacon: Beacon, fix: TrackerFix) -> tuple[Array, Array]:
    """Return world_from_body (..., 2, 3, 3) and the body's position (..., 2, 3) of a fix (m).

    One hypothesis for each hemisphere: a start for `magfusion.fixes.likelihood` or a smoother.
    """
    sensor = site.platform.magnetometer
    world_from_sensor = beacon.world_from_beacon @ np.swapaxes(fix.sensor_from_beacon, -1, -2)
    world_from_body = (world_from_sensor @ sensor.body_from_sensor.T)[..., None, :, :]
    spot = beacon.position_world + fix.position_beacon @ beacon.world_from_beacon.T
    lever = (world_from_body @ sensor.position_body[:, None])[..., 0]
    shape = (*spot.shape, 3)
    return np.broadcast_to(world_from_body, shape).copy(), np.asarray(spot - lever)


def euler_angles(sensor_from_beacon: Array) -> Array:
    """Return yaw, pitch and roll of ``H = Rx Ry Rz`` (paper 000, Eq 12-14, with atan2).

    Parameters
    ----------
    sensor_from_beacon : ndarray, shape (..., 3, 3)

    Returns
    -------
    ndarray, shape (..., 3)
        (rad); the pitch within a quarter turn, beside which yaw and roll are not defined.
    """
    h = sensor_from_beacon
    yaw = np.arctan2(h[..., 0, 1], h[..., 0, 0])
    pitch = np.arcsin(np.clip(-h[..., 0, 2], -1.0, 1.0))
    return np.stack([yaw, pitch, np.arctan2(h[..., 1, 2], h[..., 2, 2])], axis=-1)


def attitude_from_angles(angles: Array) -> Array:
    """Return the H of yaw, pitch and roll (..., 3) (rad): the inverse of `euler_angles`."""
    turned = Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix()
    return np.asarray(np.swapaxes(turned, -1, -2).reshape(*angles.shape, 3))


def euler_angles_as_printed(sensor_from_beacon: Array) -> Array:
    """Return the angles of Eq 12-14 as printed: arctan of a ratio, wrong by 180 deg beyond 90."""
    h = sensor_from_beacon
    yaw, roll = np.arctan(h[..., 0, 1] / h[..., 0, 0]), np.arctan(h[..., 1, 2] / h[..., 2, 2])
    return np.stack([yaw, np.arcsin(-h[..., 0, 2]), roll], axis=-1)


def position_matrix(position_beacon: Array) -> Array:
    """Return the paper's ``M = 1 - 3 u u^T``, shape (..., 3, 3), of positions (..., 3)."""
    unit = position_beacon / np.linalg.norm(position_beacon, axis=-1, keepdims=True)
    return np.asarray(np.eye(3) - 3.0 * unit[..., :, None] * unit[..., None, :])


@dataclass(frozen=True, eq=False)
class Correction:
    """The five matrices of paper 000, Eq 9, each of shape (3, 3).

    Parameters
    ----------
    transmitter_rotation, transmitter_shift : ndarray
        Q and C.
    receiver_rotation, receiver_shift : ndarray
        T and B.
    ambient : ndarray
        A.
    """

    transmitter_rotation: Array
    transmitter_shift: Array
    receiver_rotation: Array
    receiver_shift: Array
    ambient: Array


def coupling_as_printed(
    attitude: Array, position_beacon: Array, gain: float, drive: Array, correction: Correction
) -> Array:
    """Return the couplings of Eq 10 as printed, ``[-(K/R^3) H M (X - C) Q + A] T^-1 + B``.

    C and B are lengths that Eq 10 subtracts from and adds to voltages; they are taken as given.
    """
    distance = np.linalg.norm(position_beacon, axis=-1)[..., None, None]
    moved = (drive - correction.transmitter_shift) @ correction.transmitter_rotation
    ideal = -gain / distance**3 * attitude @ position_matrix(position_beacon) @ moved
    inverse = np.linalg.inv(correction.receiver_rotation)
    return np.asarray((ideal + correction.ambient) @ inverse + correction.receiver_shift)


def attitude_as_printed(
    coupling: Array, position_beacon: Array, gain: float, drive: Array, correction: Correction
) -> Array:
    """Solve Eq 11 as printed, to reproduce the paper; it does not invert Eq 10.

    ``H = [-(R^3/K) (Y - B) T - A] Q^-1 (X - C)^-1 M^-1``: the ambient field A is subtracted beside
    what the factor should multiply too, T stands where it mixes the transmitter's columns, and
    Q and T of Eq 20 are the inverses of what is needed.

    Parameters
    ----------
    coupling : ndarray, shape (..., 3, 3)
    position_beacon : ndarray, shape (..., 3)
    gain : float
        K.
    drive : ndarray, shape (3, 3)
        X.
    correction : Correction

    Returns
    -------
    ndarray, shape (..., 3, 3)
        In general no rotation.
    """
    scale = np.linalg.norm(position_beacon, axis=-1)[..., None, None] ** 3 / gain
    received = (coupling - correction.receiver_shift) @ correction.receiver_rotation
    return _freed(-scale * received - correction.ambient, position_beacon, drive, correction)


def attitude_of_printed_model(
    coupling: Array, position_beacon: Array, gain: float, drive: Array, correction: Correction
) -> Array:
    """Invert Eq 10 exactly, as Eq 11 should: the bracket repaired, the model as printed."""
    scale = np.linalg.norm(position_beacon, axis=-1)[..., None, None] ** 3 / gain
    received = (coupling - correction.receiver_shift) @ correction.receiver_rotation
    bracket = -scale * (received - correction.ambient)
    return _freed(bracket, position_beacon, drive, correction)


def _freed(bracket: Array, position_beacon: Array, drive: Array, correction: Correction) -> Array:
    driven = (drive - correction.transmitter_shift) @ correction.transmitter_rotation
    inverse = np.linalg.inv(position_matrix(position_beacon))
    return np.asarray(bracket @ np.linalg.inv(driven) @ inverse)


def attitude_corrected(
    coupling: Array, position_beacon: Array, receiver: Array, transmitter: Array, ambient: Array
) -> Array:
    """Return the attitude of Eq 11, corrected: ``polar{-(R^3/K) T (Y - A) (Q X)^-1 M^-1}``.

    Parameters
    ----------
    coupling : ndarray, shape (..., 3, 3)
        (T)
    position_beacon : ndarray, shape (..., 3)
        (m); only its direction matters.
    receiver, transmitter : ndarray, shape (..., 3, 3)
        T and Q X as in `whitened`.
    ambient : ndarray, shape (..., 3, 3)
        One vector in all columns, as the silent slot measured it, before any correction (T).

    Returns
    -------
    ndarray, shape (..., 3, 3)
        sensor_from_beacon.
    """
    free = whitened(coupling - ambient, receiver, transmitter)
    left, _, right = np.linalg.svd(-free @ np.linalg.inv(position_matrix(position_beacon)))
    sign = np.linalg.det(left @ right)[..., None]
    last = np.concatenate([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)
    return np.asarray((left * last[..., None, :]) @ right)


def refine_poses(
    antenna: Antenna,
    coupling: Array,
    beacon_from_sensor: Array,
    position_beacon: Array,
    iterations: int = 6,
) -> tuple[Array, Array]:
    """Return the poses of maximum likelihood in white noise, by Gauss and Newton.

    The closed form knows no centres and weighs all directions alike; this takes its pose to the
    optimum of the whole model.

    Parameters
    ----------
    antenna : Antenna
        Leading axes broadcast against those of the couplings.
    coupling : ndarray, shape (..., 3, 3)
        Rows are receiving coils (T).
    beacon_from_sensor : ndarray, shape (..., 3, 3)
    position_beacon : ndarray, shape (..., 3)
        Start (m).
    iterations : int
        Each squares the error.

    Returns
    -------
    beacon_from_sensor, position_beacon : ndarray
        As given.

    Raises
    ------
    EstimationError
        Where a pose runs away.
    """
    rotation, position = beacon_from_sensor, position_beacon
    for _ in range(iterations):
        seen = observe_antenna(antenna, rotation, position)
        jacobian = seen.pose.reshape(*seen.pose.shape[:-3], 9, 6)
        scale = np.linalg.norm(jacobian, axis=-2, keepdims=True)
        jacobian = jacobian / scale
        rest = (coupling - seen.value).reshape(*jacobian.shape[:-1], 1)
        turned = np.swapaxes(jacobian, -1, -2)
        step = np.linalg.solve(turned @ jacobian, turned @ rest)[..., 0] / scale[..., 0, :]
        moved = (rotation @ step[..., 3:, None])[..., 0]
        turn = Rotation.from_rotvec(step[..., :3].reshape(-1, 3)).as_matrix()
        rotation, position = rotation @ turn.reshape(rotation.shape), position + moved
    if not np.all(np.linalg.norm(moved, axis=-1) < 1e-3 * np.linalg.norm(position, axis=-1)):
        raise EstimationError("a tracker's pose does not converge: antenna and couplings disagree")
    return rotation, position
