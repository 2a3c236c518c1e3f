"""Start of the smoother: chains of fixes, or gravity and the Earth field.

Where the chains are doubtful, by a jump, an unobservable direction or a mirrored rival, tracks of
the hypotheses through the inertial stream are added.
At epochs without any beacon the gyro propagates the attitude from those with one, as it does from
the fix of a cycle to its slots.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from magfusion.estimation.batch.chain import Start, choose_chains, start_of, start_phases
from magfusion.estimation.batch.search import can_search, search
from magfusion.estimation.demodulation.demodulation import fix_inputs
from magfusion.estimation.measurements.zero_rate import without_bias
from magfusion.estimation.snapshot.fix import Fixes
from magfusion.estimation.snapshot.fix_separation import separate_fixes
from magfusion.estimation.snapshot.likelihood import fix_epochs
from magfusion.model.one_axis import roll_is_open
from magfusion.model.parameters import Calibration
from magfusion.model.quaternion import inverse, matrices, of_matrices, product
from magfusion.model.samples import FieldSamples, ImuSamples, Log, StaticFields
from magfusion.model.site import Site
from magfusion.model.strapdown import (
    attitude_at,
    attitude_from_gyro,
    mean_about,
    resting,
    triad,
    turn_from_gyro_at,
)
from magfusion.model.trajectory import Trajectory
from magfusion.units import Array, IntArray

if TYPE_CHECKING:
    from magfusion.estimation.batch.search import FoundTrajectory

MIN_DETECTED = 10  # minimum number of epochs with a detected beacon for a start


class OfflineStart(NamedTuple):
    """A start with the calibration estimated from its drive phases."""

    start: Start  # of the fixes' hypotheses
    states: Trajectory  # initial estimate: those of the start, or from a track
    # unsynchronised drives have no declared phase: their prior is centred on the start
    declared: Calibration
    fixes: Fixes | None  # of the epochs at which a beacon is detected; None where there are too few


def begin(
    samples: FieldSamples, static: StaticFields | None, log: Log, calibration: Calibration
) -> list[OfflineStart]:
    """Return the starts between which the motion selects.

    `static`: at the same times; without it every epoch needs a beacon.
    """
    detected = np.asarray(samples.valid.any(axis=1))
    if static is not None and np.sum(detected) < MIN_DETECTED:
        start = _by_earth(samples, static, log.imu, calibration.site)
        return [OfflineStart(start, start.states, calibration, None)]
    # An epoch without a detection has no fix at all, and would end the chain somewhere.
    some = samples.rows(detected) if np.sum(detected) >= MIN_DETECTED else samples
    epochs, gravity = fix_inputs(some, log, calibration.site)
    fixes = fix_epochs(epochs, calibration, gravity=gravity)
    # A beacon that has stopped, or is false, would corrupt the chain.
    fixes = separate_fixes(epochs, calibration, fixes, gravity=gravity).fixes
    offset = calibration.time_offset
    imu = unbiased(log.imu, samples, offset)
    chains = choose_chains(fixes, imu, offset, calibration.site)
    everywhere = len(fixes) == len(samples)
    out = []
    for start in chains:
        declared = calibration
        if some.signed:  # amplitudes do not depend on the phase
            declared = start_phases(calibration, fixes.time, start.phase)
        whole = start if everywhere else _propagated_start(start, imu, offset, samples.time)
        out.append(OfflineStart(whole, whole.states, declared, fixes))
    tracked = epochs.signed and not roll_is_open(calibration.site)
    if not tracked or not _doubtful(chains):
        return out
    if can_search(epochs):
        still = replace(imu, gyro_body=imu.gyro_body - _rest_bias(imu, calibration))
        for result in search(epochs, fixes, still, calibration):
            out.append(_tracked(result, fixes, imu, calibration, samples.time))
    return out


def unbiased(imu: ImuSamples, samples: FieldSamples, time_offset: float) -> ImuSamples:
    """Return an inertial stream without the gyro bias measured in whole rests, if any."""
    if not samples.of_rests:
        return imu
    half, stamps = 0.5 * samples.window, samples.time - time_offset
    return without_bias(imu, stamps - half, stamps + half)


def _doubtful(chains: tuple[Start, ...]) -> bool:
    """Return whether single epochs and their links may have given a wrong chain."""
    best = chains[0]
    return len(chains) > 1 or best.leaps > 0 or not bool(np.all(best.determined))


def _tracked(
    result: FoundTrajectory, fixes: Fixes, imu: ImuSamples, calibration: Calibration, time: Array
) -> OfflineStart:
    """Return the trajectory of a track as a start, with the nearest hypotheses of the fixes."""
    offset = calibration.time_offset
    there = propagated_states(result.states, imu, offset, fixes.time)
    away = np.linalg.norm(fixes.position_world - there.position_world[:, None], axis=2)
    cross = np.einsum("nij,nhij->nh", there.world_from_body, fixes.world_from_body)
    separate = away**2 + (3.0 - cross) * np.median(away)
    chosen = np.argmin(np.where(np.isfinite(fixes.cost), separate, np.inf), axis=1)
    start = start_of(fixes, chosen, result.cost)
    whole = start if len(fixes) == len(time) else _propagated_start(start, imu, offset, time)
    return OfflineStart(
        whole,
        propagated_states(result.states, imu, offset, time),
        start_phases(calibration, result.states.time, result.phase),
        fixes,
    )


def with_rest_bias(states: Trajectory, imu: ImuSamples, calibration: Calibration) -> Trajectory:
    """Return states with the gyro bias of the rests, if any."""
    bias, shape = _rest_bias(imu, calibration), (len(states), 3)
    return replace(
        states, gyro_bias_body=np.broadcast_to(bias, shape).copy(), accel_bias_body=np.zeros(shape)
    )


def _rest_bias(imu: ImuSamples, calibration: Calibration) -> Array:
    """Return the mean rate at rest (rad/s); zero where there is none."""
    motion, time = calibration.site.platform.motion, imu.time + calibration.time_offset
    still = resting(time, imu.gyro_body, imu.accel_body, motion=motion)
    return np.mean(imu.gyro_body[still], axis=0) if np.any(still) else np.zeros(3)


def _by_earth(samples: FieldSamples, static: StaticFields, imu: ImuSamples, site: Site) -> Start:
    """Return attitudes from gravity and the Earth field, at rest amid the beacons.

    `samples`: only its times are used. `static`: at the same times.
    """
    assert site.earth_field_world is not None
    time, n = samples.time, len(samples)
    stamps = imu.time + site.platform.imu.time_offset
    attitude = attitude_from_gyro(stamps, imu.gyro_body)
    at_epochs = attitude_at(attitude, stamps, imu.gyro_body, time)
    rotated, span = attitude.apply(imu.accel_body), site.platform.motion.accel_span
    up_body = at_epochs.inv().apply(mean_about(stamps, rotated, time, span))
    sensor = site.platform.magnetometer
    field = (static.measured_sensor - sensor.offset) @ np.linalg.inv(sensor.matrix).T
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


def propagated_states(
    known: Trajectory, imu: ImuSamples, time_offset: float, time: Array
) -> Trajectory:
    """Return states at other epochs: from the nearest known one, rotated by the gyro.

    `time_offset` (s), `time` (n,) (s).
    """
    if np.array_equal(known.time, time):
        return known
    nearest = _nearest(known.time, time)
    stamps = imu.time + time_offset
    at_known, here = (turn_from_gyro_at(stamps, imu.gyro_body, at) for at in (known.time, time))
    before = product(of_matrices(known.world_from_body[nearest]), inverse(at_known[:, nearest]))
    position = np.stack([np.interp(time, known.time, p) for p in known.position_world.T], axis=1)
    return Trajectory(
        time=time,
        world_from_body=matrices(product(before, here)),
        position_world=position,
        velocity_world=np.gradient(position, time, axis=0),
    )


def _nearest(known: Array, time: Array) -> IntArray:
    after = np.clip(np.searchsorted(known, time), 1, len(known) - 1)
    later = known[after] - time < time - known[after - 1]
    return np.where(later, after, after - 1)


def _propagated_start(start: Start, imu: ImuSamples, time_offset: float, time: Array) -> Start:
    nearest = _nearest(start.states.time, time)
    return replace(
        start,
        states=propagated_states(start.states, imu, time_offset, time),
        phase=start.phase[nearest],
        chosen=start.chosen[nearest],
        determined=start.determined[nearest],
    )
