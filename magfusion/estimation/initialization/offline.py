"""Where the smoother of a log begins: chains of fixes, or gravity and the Earth field.

At epochs without any beacon the gyro carries the attitude on from those with one, as it does from
the fix of a cycle to the slots in it.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from magfusion.estimation.demodulation import fix_inputs
from magfusion.estimation.initialization.chain import Start, choose_chains, start_phases
from magfusion.estimation.integrity.fix_separation import separate_fixes
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.parameters import Calibration
from magfusion.model.samples import FieldSamples, ImuSamples, Log, SteadyFields
from magfusion.model.site import Site
from magfusion.model.strapdown import (
    attitude_at,
    attitude_from_gyro,
    attitude_from_gyro_at,
    mean_about,
    resting,
    triad,
)
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, IntArray

LEAST_DETECTED = 10  # epochs at which a beacon is detected; fewer give no start


@dataclass(frozen=True, eq=False)
class OfflineStart:
    """A start with the calibration that its drive phases suggest.

    Parameters
    ----------
    declared : Calibration
        Unsynchronised drives have no declared phase: their prior is centred on the start.
    fixes : Fixes, optional
        Of the epochs at which a beacon is detected; None where there are too few.
    """

    start: Start
    declared: Calibration
    fixes: Fixes | None


def begin(
    samples: FieldSamples, steady: SteadyFields | None, log: Log, calibration: Calibration
) -> list[OfflineStart]:
    """Return the starts from which the motion chooses.

    Parameters
    ----------
    steady : SteadyFields, optional
        At the same times; where there is none, every epoch needs a beacon.
    """
    detected = np.asarray(samples.valid.any(axis=1))
    if steady is not None and np.sum(detected) < LEAST_DETECTED:
        return [
            OfflineStart(_by_earth(samples, steady, log.imu, calibration.site), calibration, None)
        ]
    # An epoch that hears nothing has no fix at all, and would end the chain somewhere.
    some = samples.rows(detected) if np.sum(detected) >= LEAST_DETECTED else samples
    epochs, gravity = fix_inputs(some, log, calibration.site)
    fixes = fix_epochs(epochs, calibration, gravity=gravity)
    # A beacon that fell silent, or is false, would lead the chain astray.
    fixes = separate_fixes(epochs, calibration, fixes, gravity=gravity).fixes
    offset = calibration.time_offset
    out = []
    for start in choose_chains(fixes, log.imu, offset, calibration.site):
        declared = start_phases(calibration, fixes.time, start.phase)
        everywhere = len(fixes) == len(samples)
        whole = start if everywhere else _carried(start, log.imu, offset, samples.time)
        out.append(OfflineStart(whole, declared, fixes))
    return out


def with_rest_bias(states: Trajectory, imu: ImuSamples, calibration: Calibration) -> Trajectory:
    """Return states with the gyro bias of the rests, where there are any."""
    motion, time = calibration.site.platform.motion, imu.time + calibration.time_offset
    still = resting(time, imu.gyro_body, imu.accel_body, motion=motion)
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
    """
    assert site.earth_field_world is not None
    time, n = samples.time, len(samples)
    stamps = imu.time + site.platform.imu.time_offset
    attitude = attitude_from_gyro(stamps, imu.gyro_body)
    at_epochs = attitude_at(attitude, stamps, imu.gyro_body, time)
    turned, span = attitude.apply(imu.accel_body), site.platform.motion.accel_span
    up_body = at_epochs.inv().apply(mean_about(stamps, turned, time, span))
    sensor = site.platform.magnetometer
    field = (steady.measured_sensor - sensor.offset) @ np.linalg.inv(sensor.matrix).T
    field_body = field @ sensor.body_from_sensor.T
    middle = np.mean([b.position_world for b in site.beacons], axis=0)
    return Start(
        states=Trajectory(
            time=time,
            world_from_body=triad(site.earth_field_world, up_body, field_body),
            position_world=np.broadcast_to(middle, (n, 3)).copy(),
            velocity_world=np.zeros((n, 3)),
        ),
        phase=np.zeros((n, len(site.channels))),
        chosen=np.zeros(n, dtype=np.int64),
        cost=0.0,
        determined=np.zeros(n, dtype=bool),
    )


def carried(known: Trajectory, imu: ImuSamples, time_offset: float, time: Array) -> Trajectory:
    """Return states at other epochs: from the nearest known one, turned by the gyro.

    Parameters
    ----------
    time_offset : float
        (s)
    time : ndarray, shape (n,)
        (s)
    """
    if np.array_equal(known.time, time):
        return known
    nearest = _nearest(known.time, time)
    stamps = imu.time + time_offset
    at_known, here = (attitude_from_gyro_at(stamps, imu.gyro_body, at) for at in (known.time, time))
    turned = Rotation.from_matrix(known.world_from_body[nearest]) * at_known[nearest].inv() * here
    position = np.stack([np.interp(time, known.time, p) for p in known.position_world.T], axis=1)
    return Trajectory(
        time=time,
        world_from_body=turned.as_matrix(),
        position_world=position,
        velocity_world=np.gradient(position, time, axis=0),
    )


def _nearest(known: Array, time: Array) -> IntArray:
    after = np.clip(np.searchsorted(known, time), 1, len(known) - 1)
    later = known[after] - time < time - known[after - 1]
    return np.where(later, after, after - 1)


def _carried(start: Start, imu: ImuSamples, time_offset: float, time: Array) -> Start:
    nearest = _nearest(start.states.time, time)
    return replace(
        start,
        states=carried(start.states, imu, time_offset, time),
        phase=start.phase[nearest],
        chosen=start.chosen[nearest],
        determined=start.determined[nearest],
    )
