"""The measurement model: the phasors of a beacon at a magnetometer, and their Jacobian.

Every solver predicts through `observe`; the simulator does not.
"""

from typing import NamedTuple

import numpy as np

from magfusion.model.coil_field import (
    Driven,
    Sources,
    alone,
    coil_fields,
    coil_fields_and_gradients,
    coil_fields_by_log_conductivity,
    driven_dipoles,
    steel_fields,
    steel_fields_and_gradients,
)
from magfusion.model.perturbation import by_matrix as by_matrix
from magfusion.model.perturbation import skew as skew
from magfusion.model.receive_coils import (
    Observation,
    is_apart,
    joined,
    joined_phasors,
    points_apart,
)
from magfusion.model.site import Beacon, Magnetometer
from magfusion.units import AnyArray, Array, ComplexArray


def _source(beacon: Beacon | Sources) -> Sources:
    return alone(beacon) if isinstance(beacon, Beacon) else beacon


def _offset_beacon(
    source: Sources, magnetometer: Magnetometer, world_from_body: Array, position_world: Array
) -> Array:
    sensor_world = position_world + world_from_body @ magnetometer.position_body
    return (sensor_world - source.position_world) @ source.world_from_beacon


def _rotated(excitation: ComplexArray, phase: Array | None) -> ComplexArray:
    """Return the excitation with the drive phase applied, shape (..., coils, tones)."""
    return excitation if phase is None else excitation * np.exp(1j * phase)[..., None, :]


class _Mapped(NamedTuple):
    """Effect of a field map and of steel on the model, beacon axes."""

    model_beacon: AnyArray  # (..., coils, 3), field of each coil without them
    correction: Array  # (..., 1, 3, 3), multiplies it
    slope: AnyArray  # (..., coils, 3, 3), contribution of both to the field gradient
    added: Array | float = 0.0  # (..., coils, 3), field of steel

    @property
    def coils_beacon(self) -> AnyArray:
        """Field of each coil with them, shape (..., coils, 3)."""
        return (self.correction @ self.model_beacon[..., None])[..., 0] + self.added


def _mapped(source: Sources, offset_beacon: Array, model_beacon: AnyArray) -> _Mapped | None:
    """Evaluate the beacon's map and its steel at the sensor; None without both."""
    result = None if source.field_map is None else _by_map(source, offset_beacon, model_beacon)
    if source.steel is None:
        return result
    added, slope = steel_fields_and_gradients(source, offset_beacon)
    if result is None:
        return _Mapped(model_beacon, np.eye(3), slope, added)
    return result._replace(slope=result.slope + slope, added=added)


def _by_map(source: Sources, offset_beacon: Array, model_beacon: AnyArray) -> _Mapped:
    assert source.field_map is not None
    world_from_beacon = source.world_from_beacon
    sensor_world = source.position_world + offset_beacon @ world_from_beacon.T
    value, gradient = source.field_map.mean(sensor_world)
    gradient = gradient @ world_from_beacon
    turn_beacon = value[..., 1:] @ world_from_beacon
    by_axis = (world_from_beacon.T @ gradient[..., 1:, :])[..., None, :, :]
    correction = np.exp(value[..., :1, None]) * (np.eye(3) + skew(turn_beacon))
    correction = correction[..., None, :, :]
    mapped = (correction @ model_beacon[..., None])[..., 0]
    gain = np.exp(value[..., 0])[..., None, None, None]
    slope = mapped[..., None] * gradient[..., None, :1, :] - gain * skew(model_beacon) @ by_axis
    return _Mapped(model_beacon, correction, slope)


def predict(
    beacon: Beacon | Sources,
    magnetometer: Magnetometer,
    world_from_body: Array,
    position_world: Array,
    phase: Array | None = None,
) -> ComplexArray:
    """Return the phasors that `observe` returns, shape (..., tones, 3) (T), without Jacobian."""
    if is_apart(magnetometer):
        seen = [
            predict(beacon, at, world_from_body, position_world, phase)
            for at in points_apart(magnetometer)
        ]
        return joined_phasors(seen, magnetometer)
    source = _source(beacon)
    offset = _offset_beacon(source, magnetometer, world_from_body, position_world)
    coils = coil_fields(source, offset)
    if source.field_map is not None:
        coils = _by_map(source, offset, coils).coils_beacon
    if source.steel is not None:
        coils = coils + steel_fields(source, offset)
    in_beacon = np.swapaxes(_rotated(source.excitation, phase), -1, -2) @ coils
    body_from_beacon = _times(np.swapaxes(world_from_body, -1, -2), source.world_from_beacon)
    in_body = in_beacon @ np.swapaxes(body_from_beacon, -1, -2)
    return in_body @ (magnetometer.body_from_sensor @ magnetometer.matrix.T)


def observe(
    beacon: Beacon | Sources,
    magnetometer: Magnetometer,
    world_from_body: Array,
    position_world: Array,
    phase: Array | None = None,
    twist_body: Array | None = None,
) -> Observation:
    """Predict the phasors of one beacon, with the Jacobian in the same call.

    ::

        Y = S sensor_from_body body_from_world C world_from_beacon [B_j(r_j)]_j X
            diag(exp(i phase))

    B_j is the field of a coil by its declared form (`magfusion.model.coil_field`), and C the
    beacon's field map at the sensor, the identity without a map.

    Parameters
    ----------
    beacon : Beacon or Sources
        Coils with their moments, centres, and complex drive in each tone; for several beacons of
        `magfusion.model.coil_field.side_by_side`, results have a leading axis of them.
    magnetometer : Magnetometer
        Matrix, mounting and lever arm.
    world_from_body : ndarray, shape (..., 3, 3)
        Attitude of the body.
    position_world : ndarray, shape (..., 3)
        Origin of the body (m).
    phase : ndarray, shape (..., tones), optional
        Drive phase relative to the log clock beyond what the coils declare (rad).
    twist_body : ndarray, shape (..., 6), optional
        Angular rate (rad/s) and velocity (m/s) of the body, body axes, for the time offset.

    Returns
    -------
    Observation
        ``phasor_sensor`` (..., tones, 3) (T, measured axes) and its derivatives; leading axes as
        those of the poses.
    """
    if is_apart(magnetometer):
        separate = [
            observe(beacon, at, world_from_body, position_world, phase, twist_body)
            for at in points_apart(magnetometer)
        ]
        return joined(separate, magnetometer)
    mounting, matrix = magnetometer.body_from_sensor, magnetometer.matrix
    seen = _seen(_source(beacon), magnetometer, world_from_body, position_world, phase)
    phasor, platform_pose = seen.phasor_sensor, seen.platform_pose
    field_beacon = seen.tones_from_coils @ seen.coils_beacon
    sensor_from_body = matrix @ mounting.T
    measured_from_beacon = (sensor_from_body @ seen.body_from_beacon)[..., None, :, :]
    in_sensor = field_beacon @ (np.swapaxes(seen.body_from_beacon, -1, -2) @ mounting)

    by_body = platform_pose[..., 3:]
    by_beacon_offset = by_body @ seen.body_from_beacon[..., None, :, :]
    rotated = measured_from_beacon @ skew(field_beacon)
    if seen.mapped is not None:  # map and steel do not move with the beacon
        flat = seen.mapped.slope.reshape(*seen.mapped.slope.shape[:-2], 9)
        slope = (seen.tones_from_coils @ flat).reshape(*field_beacon.shape, 3)
        by_beacon_offset = by_beacon_offset - measured_from_beacon @ slope
        model_beacon = seen.tones_from_coils @ seen.mapped.model_beacon
        rotated = measured_from_beacon @ seen.mapped.correction @ skew(model_beacon)
    beacon_rotation = by_beacon_offset @ skew(seen.offset_beacon)[..., None, :, :] - rotated
    # (..., tones, coils, 3)
    driven = seen.coils_beacon if seen.mapped is None else seen.coils_beacon - seen.mapped.added
    by_coil = driven[..., None, :, :] * seen.tones_from_coils[..., None]
    return Observation(
        phasor_sensor=phasor,
        platform_pose=platform_pose,
        beacon_pose=np.concatenate([beacon_rotation, -by_beacon_offset], axis=-1),
        log_moments=measured_from_beacon @ np.swapaxes(by_coil, -1, -2),
        phase=1j * phasor,
        matrix=by_matrix(in_sensor),
        body_from_sensor=np.concatenate([matrix @ skew(in_sensor), by_body @ mounting], axis=-1),
        time_offset=None if twist_body is None else _by_time_offset(platform_pose, twist_body),
        log_conductivity=_by_log_conductivity(_source(beacon), seen, sensor_from_body),
    )


def observe_from(
    beacon: Beacon | Sources,
    magnetometer: Magnetometer,
    world_from_body: Array,
    position_world: Array,
    phase: Array | None = None,
) -> tuple[ComplexArray, ComplexArray]:
    """Return phasor_sensor and platform_pose of `observe` alone, at a fraction of the cost."""
    if is_apart(magnetometer):
        whole = observe(beacon, magnetometer, world_from_body, position_world, phase)
        return whole.phasor_sensor, whole.platform_pose
    seen = _seen(_source(beacon), magnetometer, world_from_body, position_world, phase)
    return seen.phasor_sensor, seen.platform_pose


class _Seen(NamedTuple):
    """Quantities shared by the blocks of an observation."""

    phasor_sensor: ComplexArray
    platform_pose: ComplexArray
    offset_beacon: Array
    coils_beacon: AnyArray  # (..., coils, 3), field of each coil
    tones_from_coils: ComplexArray  # (..., tones, coils)
    body_from_beacon: Array
    mapped: _Mapped | None


def _by_time_offset(platform_pose: ComplexArray, twist_body: Array) -> ComplexArray:
    """Return the derivative by the time offset: minus that by time, along the twist."""
    twist = twist_body.astype(np.complex128)[..., None, :, None]
    return np.asarray(-(platform_pose @ twist)[..., 0])


def _by_log_conductivity(
    source: Sources, seen: _Seen, measured_from_body: Array
) -> ComplexArray | None:
    """Return the derivative by the ground's conductivity; None without any."""
    by_coil = coil_fields_by_log_conductivity(source, seen.offset_beacon)
    if by_coil is None:
        return None
    if seen.mapped is not None:
        by_coil = (seen.mapped.correction @ by_coil[..., None])[..., 0]
    measured_from_beacon = np.swapaxes(measured_from_body @ seen.body_from_beacon, -1, -2)
    return np.asarray(seen.tones_from_coils @ by_coil @ measured_from_beacon)


def _times(left_factor: AnyArray, right: Array) -> AnyArray:
    """Return ``left @ right`` for stacks with few matrix products instead of many small ones."""
    if right.ndim == 2:
        return (left_factor.reshape(-1, 3) @ right).reshape(left_factor.shape)
    return (left_factor.reshape(-1, 3) @ right).reshape(len(right), *left_factor.shape)


def _seen(
    source: Sources,
    magnetometer: Magnetometer,
    world_from_body: Array,
    position_world: Array,
    phase: Array | None,
) -> _Seen:
    offset_beacon = _offset_beacon(source, magnetometer, world_from_body, position_world)
    coils, gradients = coil_fields_and_gradients(source, offset_beacon)
    tones_from_coils = np.swapaxes(_rotated(source.excitation, phase), -1, -2)
    body_from_beacon = _times(np.swapaxes(world_from_body, -1, -2), source.world_from_beacon)
    beacon_from_body = np.swapaxes(body_from_beacon, -1, -2)
    body_from_sensor = magnetometer.body_from_sensor @ magnetometer.matrix.T  # not a rotation
    measured_from_beacon = np.swapaxes(_times(beacon_from_body, body_from_sensor), -1, -2)
    # Each coil's field is real without conduction; only their sum in a tone is complex.
    mapped = _mapped(source, offset_beacon, coils)
    if mapped is not None:
        coils = mapped.coils_beacon
        gradients = mapped.correction @ gradients + mapped.slope
    in_body = coils @ beacon_from_body
    # All coils at once: one product per pose instead of many.
    flat = gradients.reshape(*gradients.shape[:-3], -1, 3) @ beacon_from_body
    by_body = measured_from_beacon[..., None, :, :] @ flat.reshape(gradients.shape)
    turning = -np.swapaxes(_times(skew(in_body), body_from_sensor), -1, -2)
    by_rotation = turning - _times(by_body, skew(magnetometer.position_body))
    parts = (_times(in_body, body_from_sensor), by_rotation, by_body)
    by_coil = np.concatenate([p.reshape(*coils.shape[:-1], -1) for p in parts], axis=-1)
    in_tones = tones_from_coils @ by_coil
    jacobian = in_tones[..., 3:].reshape(*in_tones.shape[:-1], 2, 3, 3)
    return _Seen(
        phasor_sensor=in_tones[..., :3],
        platform_pose=np.concatenate([jacobian[..., 0, :, :], jacobian[..., 1, :, :]], axis=-1),
        offset_beacon=offset_beacon,
        coils_beacon=coils,
        tones_from_coils=tones_from_coils,
        body_from_beacon=body_from_beacon,
        mapped=mapped,
    )


def driven_field(
    beacon: Beacon | Sources,
    position_world: Array,
    current: AnyArray,
    along_world: Array | None = None,
) -> Driven:
    """Return the field of a beacon at points for given coil currents, world axes.

    `beacon`: as of `observe`. `position_world` (n, 3) (m). `current` (n, coils) or
    (beacons, n, coils): of each coil, as a share of its peak; complex and rotating with time in
    conducting ground: the result is then the real part. `along_world` (n, 3): a displacement of the
    points, or their velocity.
    """
    source = _source(beacon)
    world_from_beacon = source.world_from_beacon
    offset = (position_world - source.position_world) @ world_from_beacon
    along = None if along_world is None else along_world @ world_from_beacon
    whole = source.loops.radius is not None or source.is_mapped
    if whole or source.decay is not None:
        driven = _driven_coils(source, offset, current, along)
    else:
        driven = driven_dipoles(source, offset, current, along)
    back = np.swapaxes(world_from_beacon, -1, -2)
    return Driven(driven.field @ back, None if driven.along is None else driven.along @ back)


def _driven_coils(source: Sources, offset: Array, current: AnyArray, along: Array | None) -> Driven:
    """Return the field of coils of any size, with the beacon's map, as `driven_dipoles`."""
    coils, gradients = coil_fields_and_gradients(source, offset)
    mapped = _mapped(source, offset, coils)
    if mapped is not None:
        coils = mapped.coils_beacon
        gradients = mapped.correction @ gradients + mapped.slope
    field = np.real(np.einsum("...nc,...ncx->...nx", current, coils))
    if along is None:
        return Driven(field, None)
    by = np.einsum("...nc,...ncxy,...ny->...nx", current, gradients, along, optimize=True)
    return Driven(field, np.real(by))


class EarthObservation(NamedTuple):
    """Predicted static field with its Jacobian blocks, named by the variable of each."""

    measured_sensor: Array  # (..., 3) (T), measured axes
    platform_rotation: Array  # (..., 3, 3), right perturbation of world_from_body (T/rad)
    matrix: Array  # (..., 3, 9), magnetometer matrix, row by row (T)
    sensor_rotation: Array  # (..., 3, 3), right perturbation of body_from_sensor (T/rad)
    offset: Array  # (..., 3, 3), of the magnetometer
    earth_world: Array  # (..., 3, 3), static field, world axes


def observe_earth(
    magnetometer: Magnetometer, world_from_body: Array, earth_field_world: Array
) -> EarthObservation:
    """Predict the static field measured by a magnetometer, with the Jacobian in the same call.

    ::

        m = S sensor_from_body body_from_world e + offset

    `world_from_body` (..., 3, 3), `earth_field_world` (3,) (T).
    """
    mounting, matrix = magnetometer.body_from_sensor, magnetometer.matrix
    measured_from_body = matrix @ mounting.T
    in_body = earth_field_world @ world_from_body
    in_sensor = in_body @ mounting
    return EarthObservation(
        measured_sensor=in_sensor @ matrix.T + magnetometer.offset,
        platform_rotation=measured_from_body @ skew(in_body),
        matrix=by_matrix(in_sensor),
        sensor_rotation=matrix @ skew(in_sensor),
        offset=np.broadcast_to(np.eye(3), (*in_sensor.shape, 3)),
        earth_world=measured_from_body @ np.swapaxes(world_from_body, -1, -2),
    )


def predict_earth(
    magnetometer: Magnetometer, world_from_body: Array, earth_field_world: Array
) -> Array:
    """Return the static field that `observe_earth` returns, shape (..., 3) (T)."""
    in_sensor = earth_field_world @ world_from_body @ magnetometer.body_from_sensor
    return np.asarray(in_sensor @ magnetometer.matrix.T + magnetometer.offset)
