"""Where the smoother of a log begins: chains of fixes, or gravity and the Earth field.

At epochs that no beacon tells of the gyro carries the attitude on from those that one does, as it
does from the fix of a cycle to the slots in it.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.fixes.fix import Fixes
from magfusion.fusion.source import first_fixes
from magfusion.fusion.start import Start, choose_chains, start_phases
from magfusion.parameters import Calibration
from magfusion.records.samples import FieldSamples, ImuSamples, Log, SteadyFields
from magfusion.site import Site
from magfusion.strapdown import attitude_at, attitude_from_gyro, attitude_from_gyro_at, resting
from magfusion.trajectory import Trajectory
from magfusion.units import Array

LEAST_HELD = 10  # epochs at which a beacon is heard; fewer are no beginning
AVERAGING = 2.0  # s; over which the specific force is taken for gravity


@dataclass(frozen=True, eq=False)
class Beginning:
    """A start with the calibration that its drive phases suggest.

    Parameters
    ----------
    start : Start
    declared : Calibration
        Unsynchronised drives have no declared phase: their prior is centred on the start.
    fixes : Fixes, optional
        Of the epochs at which a beacon is heard; None where there are too few.
    """

    start: Start
    declared: Calibration
    fixes: Fixes | None


def begin(
    samples: FieldSamples, steady: SteadyFields | None, log: Log, calibration: Calibration
) -> list[Beginning]:
    """Return the starts from which the motion chooses.

    Parameters
    ----------
    samples : FieldSamples
    steady : SteadyFields, optional
        At the same times; where there is none, every epoch needs a beacon.
    log : Log
    calibration : Calibration
    """
    held = np.asarray(samples.valid.any(axis=1))
    if steady is not None and np.sum(held) < LEAST_HELD:
        return [Beginning(_by_earth(samples, steady, log.imu, calibration.site), calibration, None)]
    heard = samples if steady is None else samples.rows(held)
    fixes = first_fixes(heard, log, calibration)
    offset = calibration.time_offset
    out = []
    for start in choose_chains(fixes, log.imu, offset, calibration.site.gravity):
        declared = start_phases(calibration, fixes.time, start.phase)
        everywhere = len(fixes) == len(samples)
        whole = start if everywhere else _carried(start, log.imu, offset, samples.time)
        out.append(Beginning(whole, declared, fixes))
    return out


def with_rest_bias(states: Trajectory, imu: ImuSamples, time_offset: float) -> Trajectory:
    """Return states with the gyro bias of the rests, where there are any."""
    still = resting(imu.time + time_offset, imu.gyro_body, imu.accel_body)
    bias = np.mean(imu.gyro_body[still], axis=0) if np.any(still) else np.zeros(3)
    shape = (len(states), 3)
    return replace(
        states, gyro_bias_body=np.broadcast_to(bias, shape).copy(), accel_bias_body=np.zeros(shape)
    )


def _by_earth(samples: FieldSamples, steady: SteadyFields, imu: ImuSamples, site: Site) -> Start:
    """Return attitudes by gravity and the Earth field, at rest amid the beacons.

    Parameters
    ----------
    samples : FieldSamples
        None of which is used but its times.
    steady : SteadyFields
        At the same times.
    imu : ImuSamples
    site : Site
    """
    assert site.earth_field_world is not None
    time, n = samples.time, len(samples)
    stamps = imu.time + site.platform.imu.time_offset
    attitude = attitude_from_gyro(stamps, imu.gyro_body)
    at_epochs = attitude_at(attitude, stamps, imu.gyro_body, time)
    up_body = at_epochs.inv().apply(_mean_about(stamps, attitude.apply(imu.accel_body), time))
    sensor = site.platform.magnetometer
    field = (steady.measured_sensor - sensor.offset) @ np.linalg.inv(sensor.matrix).T
    field_body = field @ sensor.body_from_sensor.T
    world = _axes(np.array([0.0, 0.0, 1.0]), site.earth_field_world)
    middle = np.mean([b.position_world for b in site.beacons], axis=0)
    return Start(
        states=Trajectory(
            time=time,
            world_from_body=world @ np.swapaxes(_axes(up_body, field_body), -1, -2),
            position_world=np.broadcast_to(middle, (n, 3)).copy(),
            velocity_world=np.zeros((n, 3)),
        ),
        phase=np.zeros((n, len(site.channels))),
        chosen=np.zeros(n, dtype=np.int64),
        cost=0.0,
        determined=np.zeros(n, dtype=bool),
    )


def _mean_about(time: Array, vector: Array, wanted: Array) -> Array:
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(vector, axis=0)])
    lo = np.searchsorted(time, wanted - AVERAGING / 2)
    hi = np.maximum(np.searchsorted(time, wanted + AVERAGING / 2), lo + 1)
    hi = np.minimum(hi, len(time))
    lo = np.minimum(lo, hi - 1)
    return np.asarray((total[hi] - total[lo]) / (hi - lo)[:, None])


def _axes(up: Array, field: Array) -> Array:
    """Return the axes east of the field, along it, and up, as columns (..., 3, 3)."""
    z = up / np.linalg.norm(up, axis=-1, keepdims=True)
    east = np.cross(field, z)
    x = east / np.linalg.norm(east, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _carried(start: Start, imu: ImuSamples, time_offset: float, time: Array) -> Start:
    """Return a start at more epochs: from the nearest that it has, turned by the gyro.

    Parameters
    ----------
    start : Start
    imu : ImuSamples
    time_offset : float
        (s)
    time : ndarray, shape (n,)
        (s)
    """
    known = start.states
    after = np.clip(np.searchsorted(known.time, time), 1, len(known) - 1)
    later = known.time[after] - time < time - known.time[after - 1]
    nearest = np.where(later, after, after - 1)
    stamps = imu.time + time_offset
    at_known, here = (attitude_from_gyro_at(stamps, imu.gyro_body, at) for at in (known.time, time))
    there = at_known[nearest]
    turned = Rotation.from_matrix(known.world_from_body[nearest]) * there.inv() * here
    position = np.stack([np.interp(time, known.time, p) for p in known.position_world.T], axis=1)
    states = Trajectory(
        time=time,
        world_from_body=turned.as_matrix(),
        position_world=position,
        velocity_world=np.asarray(np.gradient(position, time, axis=0)),
    )
    return replace(
        start,
        states=states,
        phase=start.phase[nearest],
        chosen=start.chosen[nearest],
        determined=start.determined[nearest],
    )
