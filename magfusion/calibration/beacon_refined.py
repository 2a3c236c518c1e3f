"""Attitude and coils of a beacon from its fitted moments, with their sigmas."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.calibration.beacon import BeaconFits, BeaconMeasurements, calibrate_beacon
from magfusion.estimation.snapshot.candidates import wahba
from magfusion.model.coil_field import as_points, is_sized
from magfusion.model.field import predict
from magfusion.model.site import Beacon, BeaconSigma
from magfusion.units import Array, ComplexArray

TURNS = 8  # each leaves the offset over the distance of the error, some hundredths
OPEN = 0.1  # of the moment that a turn moves, below which it goes with the drive phase


@dataclass(frozen=True, eq=False)
class RefinedBeacon:
    """A beacon after calibration."""

    # with the posterior sigmas; it predicts the fitted phasors, except for the drive phase of an
    # unsynchronised beacon
    beacon: Beacon
    # (tones,), estimated drive phase, in addition to the coils' own (rad); zero where it is known
    phase: Array
    # (n, 3), axes, declared beacon axes, about which rotation is unobservable: there the declared
    # attitude and its sigma are kept
    open_beacon: Array


def attitudes(beacon: Beacon, moments_world: ComplexArray) -> tuple[Array, Array]:
    """Return the attitude in which the declared moments best match the estimated ones.

    The polar decomposition of paper 002's problem: imbalance and angle between the coils are split
    evenly.  Of equally good rotations, the one nearest to the declared is returned. `beacon`: as
    declared. `moments_world` (runs, tones, 3) (A m^2). Returns `world_from_beacon` (runs, 3, 3);
    `phase` (runs, tones): of the drive, in addition to the declared (rad); zero for a synchronised
    beacon.
    """
    declared = _drive(beacon)
    unit = declared / np.linalg.norm(declared, axis=-1, keepdims=True) ** 2
    rotation = np.broadcast_to(beacon.world_from_beacon, (len(moments_world), 3, 3))
    phase = np.zeros(moments_world.shape[:2])
    for _ in range(1 if beacon.synchronised else 50):
        if not beacon.synchronised:
            in_world = declared @ np.swapaxes(rotation, -1, -2)
            phase = np.angle(np.sum(moments_world * in_world.conj(), axis=-1))
        rotated = moments_world * np.exp(-1j * phase)[..., None]
        correlation = np.einsum("rki,kj->rij", rotated, unit.conj()).real
        rotation = wahba(correlation + 1e-9 * beacon.world_from_beacon)
    return rotation, phase


def _drive(beacon: Beacon) -> ComplexArray:
    """Return the declared complex moment of each tone, shape (tones, 3), beacon axes."""
    return beacon.excitation.T @ beacon.moments_beacon


def coil_moments(
    beacon: Beacon, moments_world: ComplexArray, world_from_beacon: Array, phase: Array
) -> Array:
    """Return the moments of the coils in beacon axes, shape (runs, coils, 3) (A m^2).

    Where a tone drives more coils than its field can separate, the change is the smallest possible.
    """
    rotated = (moments_world * np.exp(-1j * phase)[..., None]) @ world_from_beacon
    change = rotated - _drive(beacon)
    drive = np.concatenate([beacon.excitation.real, beacon.excitation.imag], axis=1).T
    parts = np.concatenate([change.real, change.imag], axis=-2)
    return beacon.moments_beacon + np.linalg.pinv(drive) @ parts


def open_axes(beacon: Beacon) -> Array:
    """Return the axes, beacon frame, about which a rotation cannot be determined, shape (n, 3).

    A coil's own axis and, where the drive phase is unknown, the axis of a rotating field.
    """
    drive = _drive(beacon)
    turns = np.stack([np.cross(axis, drive).ravel() for axis in np.eye(3)], axis=-1)
    if not beacon.synchronised:
        phases = np.einsum("kl,ki->kil", np.eye(len(drive)), 1j * drive).reshape(drive.size, -1)
        turns = turns - phases @ np.linalg.lstsq(_parts(phases), _parts(turns), rcond=None)[0]
    _, size, axes = np.linalg.svd(_parts(turns))
    return axes[size < OPEN * np.linalg.norm(drive)]


def _parts(columns: ComplexArray) -> Array:
    return np.concatenate([columns.real, columns.imag])


def calibrate_one(measured: BeaconMeasurements, reach: float) -> tuple[BeaconFits, RefinedBeacon]:
    """Calibrate a beacon whose coils may have separate centres and sizes, from one run.

    The coils' offsets rotate with the attitude to be estimated, and so does the contribution of
    their size to the field, which is subtracted from the measurements.  The fit is iterated until
    both converge. `reach`: as in `magfusion.calibration.beacon.calibrate_beacon` (m).
    """
    declared, seen, sized = measured.beacon, measured.phasor_sensor, is_sized(measured.beacon)
    for _ in range(TURNS if sized or declared.centres_beacon.any() else 1):
        fits = calibrate_beacon(measured, reach)
        result, _ = attitudes(measured.beacon, fits.moments_world)
        used = measured
        rotated = replace(declared, world_from_beacon=result[0])
        of_size = _of_size(measured, refine(measured, fits)) if sized else 0.0
        measured = replace(measured, beacon=rotated, phasor_sensor=seen - of_size)
    return fits, refine(used, fits)


def _of_size(measured: BeaconMeasurements, result: RefinedBeacon) -> ComplexArray:
    """Return the contribution of the coils' size to the phasors, shape (points, tones, 3)."""
    place = (measured.magnetometer, measured.world_from_body, measured.position_world)
    phase = np.broadcast_to(result.phase, (len(measured.position_world), len(result.phase)))
    return predict(result.beacon, *place, phase) - predict(as_points(result.beacon), *place, phase)


def refine(measured: BeaconMeasurements, fits: BeaconFits, run: int = 0) -> RefinedBeacon:
    """Return the beacon of one calibration run, with posterior sigmas."""
    declared, moments = measured.beacon, fits.moments_world[run : run + 1]
    rotation, phase = attitudes(declared, moments)
    coils = coil_moments(declared, moments, rotation, phase)[0]
    spread = _spread(measured, moments[0], rotation[0], coils)
    cov = spread @ fits.cov[run, 3:, 3:] @ spread.T
    free_parameters = open_axes(declared)
    known = np.eye(3) - free_parameters.T @ free_parameters
    turn = known @ cov[:3, :3] @ known
    prior = free_parameters @ np.diag(declared.sigma.rotation_beacon**2) @ free_parameters.T
    sigma = BeaconSigma(
        position_world=np.sqrt(np.diag(fits.cov[run, :3, :3])),
        rotation_beacon=np.sqrt(np.diag(turn + free_parameters.T @ prior @ free_parameters)),
        log_moment=np.sqrt(np.diag(cov[3:, 3:])),
    )
    result = replace(
        declared,
        position_world=fits.centre_world[run],
        world_from_beacon=rotation[0],
        coils=tuple(
            replace(coil, moment_beacon=moment)
            for coil, moment in zip(declared.coils, coils, strict=True)
        ),
        sigma=sigma,
        field_map=None,  # it corrected the beacon as it was declared
        steel=None,  # the moments that this beacon induced
    )
    return RefinedBeacon(result, phase[0], free_parameters)


def _spread(
    measured: BeaconMeasurements, moments: ComplexArray, rotation: Array, coils: Array
) -> Array:
    """Return the derivatives of attitude and log-moments by the moments, by central differences."""
    step = 1e-5 * float(np.max(np.abs(moments)))
    units = step * measured.unit_moments
    sides = np.concatenate([units, -units])
    rotated, phase = attitudes(measured.beacon, moments + sides)
    sizes = np.linalg.norm(coil_moments(measured.beacon, moments + sides, rotated, phase), axis=-1)
    angle = Rotation.from_matrix(rotation.T @ rotated).as_rotvec()
    value = np.hstack([angle, np.log(sizes / np.linalg.norm(coils, axis=-1))])
    count = len(units)
    return (value[:count] - value[count:]).T / (2.0 * step)
