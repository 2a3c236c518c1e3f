"""Poses of a tracker about its closed form: from a site's phasors, in the world, and refined."""

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
from magfusion.papers.p000_tracker.pose import TrackerFix
from magfusion.units import Array, ComplexArray, IntArray


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
