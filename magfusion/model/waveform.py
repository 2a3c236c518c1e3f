"""Predicted magnetometer samples along a motion, with their derivative.

Computed in real numbers: the coils' currents at every sample, and their field.  In conducting
ground the field lags behind the currents, and both are complex until they are summed.
"""

from typing import NamedTuple

import numpy as np

from magfusion.model.channel_effects import are_driven, axis_factors
from magfusion.model.coil_field import side_by_side
from magfusion.model.field import driven_field
from magfusion.model.parameters import Calibration
from magfusion.model.path_field import field_along_path
from magfusion.model.quaternion import cross
from magfusion.model.receive_coils import is_apart, joined_axes, points_apart
from magfusion.model.site import Magnetometer, Site
from magfusion.model.trajectory import Trajectory
from magfusion.units import AnyArray, Array, ComplexArray


class MotionChange(NamedTuple):
    """Rate of change of a motion, shape (n, 3) both, world axes."""

    rotation_world: Array  # (rad/s, or rad per unit of another variable)
    position_world: Array  # of the body (m/s)


def carriers(frequencies_hz: Array, time: Array) -> ComplexArray:
    """Return the carrier of each phasor, shape (n, channels)."""
    return np.exp(2j * np.pi * frequencies_hz * time[:, None])


def predicted_waveform(
    motion: Trajectory,
    calibration: Calibration,
    earth_field_world: Array,
    carrier: ComplexArray,
    change: MotionChange | None = None,
    *,
    through_nodes: bool = False,
) -> tuple[Array, Array]:
    """Return the samples of a magnetometer along a motion.

    Parameters
    ----------
    motion : Trajectory
        At the sample times.
    earth_field_world : ndarray, shape (3,)
        (T)
    carrier : complex ndarray, shape (n, channels)
        As of `carriers`.
    change : MotionChange, optional
        Derivative of the motion.
    through_nodes : bool
        Whether expensive fields are interpolated by `magfusion.model.path_field`.

    Returns
    -------
    ndarray, shape (n, 3)
        (T), measured axes, without noise.
    ndarray, shape (n, 3)
        Derivative of the samples; zero without a change.
    """
    factors = axis_factors(calibration.site)
    if factors is None:
        return _read(motion, calibration, earth_field_world, carrier, change, through_nodes)
    # An axis's response is that of all axes to currents scaled by its own factors.
    read = [
        _read(
            motion,
            calibration,
            earth_field_world,
            carrier * factors[:, axis],
            change,
            through_nodes,
        )
        for axis in range(3)
    ]
    field, by = (np.stack([read[k][i][:, k] for k in range(3)], axis=1) for i in range(2))
    return field, by


def _read(
    motion: Trajectory,
    calibration: Calibration,
    earth_field_world: Array,
    carrier: ComplexArray,
    change: MotionChange | None,
    through_nodes: bool,
) -> tuple[Array, Array]:
    """Return the samples of axes with equal response, as `predicted_waveform`."""
    magnetometer = calibration.site.platform.magnetometer
    currents = _currents(calibration, motion.time, carrier)
    if not is_apart(magnetometer):
        field, by = _at_point(
            magnetometer,
            motion,
            calibration.site,
            earth_field_world,
            currents,
            change,
            through_nodes,
        )
        return field + magnetometer.offset, by
    separate = [
        _at_point(at, motion, calibration.site, earth_field_world, currents, change, through_nodes)
        for at in points_apart(magnetometer)
    ]
    field, by = (joined_axes([part[k] for part in separate], magnetometer) for k in range(2))
    return field + magnetometer.offset, by


def _currents(calibration: Calibration, time: Array, carrier: ComplexArray) -> list[AnyArray]:
    """Return the currents of each source's coils as a share of their peak.

    Shape (n, coils), or (beacons, n, coils) where it is several beacons.
    """
    still = not np.any(calibration.drift) and not are_driven(calibration.site)
    phase = calibration.drive_phase(time[:1] if still else time)
    drive = carrier * (calibration.gain_at(time) * np.exp(1j * phase))
    of_beacon: list[AnyArray] = []
    start = 0
    for beacon in calibration.site.beacons:
        tones = slice(start, start + len(beacon.tones))
        current = drive[:, tones] @ beacon.excitation.T
        of_beacon.append(np.asarray(current if beacon.conductivity else current.real))
        start = tones.stop
    return [
        np.stack([of_beacon[k] for k in rows]) if len(rows) > 1 else of_beacon[rows[0]]
        for rows, _ in side_by_side(calibration.site)
    ]


def _at_point(
    magnetometer: Magnetometer,
    motion: Trajectory,
    site: Site,
    earth_field_world: Array,
    currents: list[AnyArray],
    change: MotionChange | None,
    through_nodes: bool,
) -> tuple[Array, Array]:
    """Return the samples of a magnetometer with concentric axes, without its offset."""
    rotation = motion.world_from_body
    lever = rotation @ magnetometer.position_body
    along = None
    if change is not None:
        along = change.position_world + cross(change.rotation_world.T, lever.T).T
    field, by = np.tile(earth_field_world, (len(rotation), 1)), np.zeros((len(rotation), 3))
    for (_, source), current in zip(side_by_side(site), currents, strict=True):
        place = motion.position_world + lever
        # For dipoles the interpolation costs more than it saves.
        expensive = source.loops.radius is not None or source.decay is not None
        field_at = field_along_path if expensive and through_nodes else driven_field
        driven = field_at(source, place, current, along)
        field += np.sum(driven.field.reshape(-1, *field.shape), axis=0)
        if driven.along is not None:
            by += np.sum(driven.along.reshape(-1, *field.shape), axis=0)
    measured_from_body = (magnetometer.matrix @ magnetometer.body_from_sensor.T).T
    if change is not None:
        by += cross(field.T, change.rotation_world.T).T
        by = np.einsum("nji,nj->ni", rotation, by) @ measured_from_body
    return np.einsum("nji,nj->ni", rotation, field) @ measured_from_body, by
