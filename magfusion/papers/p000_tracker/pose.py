"""Exact pose from one three-axis beacon in closed form, which paper 000 lacks.

Frames: the paper's transmitter is the beacon, its receiver the sensor, its H sensor_from_beacon.
One singular value decomposition gives range, bearing and attitude at once.  The dipole is even, so
that the opposite position fits as well; the attitude is the same for both.
"""

from dataclasses import dataclass

import numpy as np

from magfusion.errors import EstimationError, InputError
from magfusion.estimation.solve.batched import (
    NormalEquations,
    minimise,
    moved_poses,
    normal_equations,
)
from magfusion.model.antenna import Antenna, antenna_from_vector, observe_antenna
from magfusion.model.site import Beacon, Site
from magfusion.units import MU0_OVER_4PI, Array, ComplexArray, IntArray


@dataclass(frozen=True, eq=False)
class TrackerFix:
    """Pose of a sensor relative to one beacon.

    Parameters
    ----------
    sensor_from_beacon : ndarray, shape (..., 3, 3)
        The paper's H.
    position_beacon : ndarray, shape (..., 2, 3)
        The two positions that fit, opposite each other (m), in arbitrary order until `nearest`
        puts the wanted hemisphere first.
    distance : ndarray, shape (...)
        (m)
    residual : ndarray, shape (...)
        Unmodelled part relative to the coupling: singular values that are not 2 : 1 : 1.
    """

    sensor_from_beacon: Array
    position_beacon: Array
    distance: Array
    residual: Array

    def nearest(self, guess_beacon: Array) -> "TrackerFix":
        """Return the fix with the position on the side of a guess (..., 3) first.

        The hemisphere is known from a prior or the last position; the coils' centres determine it
        only where the antenna is known far more accurately than the noise.
        """
        towards = np.einsum("...hi,...i", self.position_beacon, guess_beacon)
        swap = (towards[..., 1] > towards[..., 0])[..., None, None]
        ordered = np.where(swap, self.position_beacon[..., ::-1, :], self.position_beacon)
        return TrackerFix(self.sensor_from_beacon, ordered, self.distance, self.residual)


def unit_coupling(
    beacon: Beacon, phasor_sensor: ComplexArray, matrix: Array, phase: Array | None = None
) -> Array:
    """Return the field of unit moments along the beacon's axes, in sensor axes.

    The paper's ``T Y (Q X)^-1``: drive, moments and sensitivities removed, and real after removal
    of the drive phase.

    Parameters
    ----------
    beacon : Beacon
        With moments along all three axes.
    phasor_sensor : complex ndarray, shape (..., tones, 3)
        (T), measured axes.
    matrix : ndarray, shape (3, 3)
        The magnetometer's.
    phase : ndarray, shape (..., tones), optional
        Drive phase in addition to the coils' own (rad).

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
            " requires three axes; `magfusion fix` works with fewer"
        )
    reverted = phasor_sensor if phase is None else phasor_sensor * np.exp(-1j * phase)[..., None]
    measured = np.concatenate([reverted.real, reverted.imag], axis=-2)  # (..., 2 tones, 3)
    in_sensor = measured @ np.linalg.inv(matrix).T
    return np.swapaxes(in_sensor, -1, -2) @ np.linalg.pinv(moments)


def locate_by_svd(unit: Array) -> TrackerFix:
    """Compute range, bearing and attitude from one singular value decomposition.

    `unit_coupling` (..., 3, 3), ``U = (K/R^3) H (3 u u^T - 1)``, has singular values 2 : 1 : 1, the
    first along the bearing, and H is the remaining factor: the solution of Wahba's problem and also
    the polar factor of Eq 11.

    Raises
    ------
    EstimationError
        Where a determinant is not positive, which no pose of a right-handed tracker gives.
    """
    _refuse_mirrored(unit)
    residual, size, right = np.linalg.svd(unit)
    power = np.sum(size**2, axis=-1)
    distance = (6.0 * MU0_OVER_4PI**2 / power) ** (1.0 / 6.0)
    along = right[..., 0, :] * distance[..., None]
    ideal = np.sqrt(power / 6.0)[..., None] * [2.0, 1.0, 1.0]
    return TrackerFix(
        sensor_from_beacon=(residual * [1.0, -1.0, -1.0]) @ right,
        position_beacon=np.stack([along, -along], axis=-2),
        distance=distance,
        residual=np.linalg.norm(size - ideal, axis=-1) / np.sqrt(power),
    )


def _refuse_mirrored(unit: Array) -> None:
    finite = np.isfinite(unit).all(axis=(-2, -1))
    if not finite.all():
        raise EstimationError(f"coupling {np.argmin(finite.ravel())} is not finite")
    size = np.linalg.svd(unit, compute_uv=False)
    flat = size[..., 2] < 1e-6 * size[..., 0]
    if flat.any():
        raise EstimationError(
            f"coupling {np.argmax(flat.ravel())} is singular: a coil is silent or its wire broken"
        )
    # det U = 2 (K/R^3)^3; noise changes its sign only if it is as large as the signal.
    wrong = np.linalg.det(unit) < 0.0
    if wrong.any():
        raise EstimationError(
            f"coupling {np.argmax(wrong.ravel())} has a negative determinant, which no pose"
            " explains: the wires of one coil, or two coils, are swapped, or the sign of one axis"
            " or of Eq 1 is wrong (M = 1 - 3 u u^T takes a minus)"
        )


def world_poses(site: Site, beacon: Beacon, fix: TrackerFix) -> tuple[Array, Array]:
    """Return world_from_body (..., 2, 3, 3) and the body's position (..., 2, 3) (m) of a fix.

    One hypothesis for each hemisphere: a start for `magfusion.estimation.snapshot.likelihood` or a
    smoother.
    """
    sensor = site.platform.magnetometer
    world_from_sensor = beacon.world_from_beacon @ np.swapaxes(fix.sensor_from_beacon, -1, -2)
    world_from_body = (world_from_sensor @ sensor.body_from_sensor.T)[..., None, :, :]
    spot = beacon.position_world + fix.position_beacon @ beacon.world_from_beacon.T
    lever = (world_from_body @ sensor.position_body[:, None])[..., 0]
    shape = (*spot.shape, 3)
    return np.broadcast_to(world_from_body, shape).copy(), spot - lever


def refine_poses(
    antenna: Antenna,
    coupling: Array,
    beacon_from_sensor: Array,
    position_beacon: Array,
    iterations: int = 20,
) -> tuple[Array, Array]:
    """Return the poses of maximum likelihood in white noise.

    The closed form neglects the coils' centres and weights all directions equally; this refines its
    pose to the optimum of the full model.

    Couplings (..., 3, 3) (T) and the start's beacon_from_sensor (..., 3, 3) and position (..., 3)
    (m) broadcast against the leading axes of the antenna; returned as the start is given.

    Raises
    ------
    EstimationError
        Where a pose does not converge.
    """
    lead = coupling.shape[:-2]
    vector = np.broadcast_to(antenna.vector(), (*lead, antenna.vector().shape[-1]))
    vector, measured = vector.reshape(-1, vector.shape[-1]), coupling.reshape(-1, 3, 3)
    weight = 1.0 / np.linalg.norm(measured, axis=(1, 2))[:, None, None]

    def model(rows: IntArray, pose: Array) -> NormalEquations:
        rotated, position = pose[:, :9].reshape(-1, 3, 3), pose[:, 9:]
        seen = observe_antenna(antenna_from_vector(vector[rows]), rotated, position)
        error = (seen.value - measured[rows]) * weight[rows]
        jacobian = seen.pose * weight[rows, ..., None]
        return normal_equations(error.reshape(-1, 9), jacobian.reshape(-1, 9, 6))

    start = np.concatenate(
        [beacon_from_sensor.reshape(-1, 9), position_beacon.reshape(-1, 3)], axis=1
    )
    result = minimise(model, start, moved_poses, max_iterations=iterations, absolute=1e-18)
    if not np.all(result.converged):
        raise EstimationError("a tracker's pose does not converge: inconsistent couplings")
    return result.state[:, :9].reshape(*lead, 3, 3), result.state[:, 9:].reshape(*lead, 3)
